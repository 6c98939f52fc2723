"""Cost of learning: one decision's, adding a rule, how both grow with the number of rules.

One decision's learning is everything that a learner does between two decisions: growth test,
firing, temporal-difference error, update of the parameters, choice of the next action, gradient by
autograd and eligibility traces, without replay. It is set against the least that any network of
this kind needs in torch: one forward pass and one backward pass, written by hand for single tensors
u, v (K, n) and c (K, m), without growth, traces, update, angles or actions.

    python benchmarks/learning.py --out learning.json --plot docs/images/cost.png
"""

import dataclasses
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import arguments, interleaved, median, ratio, report
from torch import Tensor

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.settings import POSE
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.pictures import figures
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config

SIZES = (1_000, 10_000)
GROWTH = (10, 30, 100, 300, 1_000, 3_000, 10_000, 30_000, 100_000)


def states(count: int, seed: int) -> np.ndarray:
    """Return poses spread evenly over the maze. Shape: (count, 3)."""
    rng = np.random.default_rng(seed)
    low, high = (0.0, 0.0, -np.pi), (1.0, 1.0, np.pi)
    return rng.uniform(low, high, (count, 3)).astype(np.float32)


def fill(net: SOFNN, rules: int) -> None:
    """Add rules up to a number."""
    for centre in torch.from_numpy(states(rules - net.n_rules, seed=0)):
        net.add_rule(centre, consequents=net.initial)


def learner(name: str, rules: int, adapting: bool = False) -> Learner:
    """Return a learner with the default settings, without replay, and rules that stay."""
    config = Config(agent=name, network="sofnn")
    part = dataclasses.replace(getattr(config, name), replays=0, replay_every=0)
    if adapting:
        part = dataclasses.replace(part, rate_centre=1e-6, rate_width=1e-6)
    net = dataclasses.replace(config.net, max_rules=max(SIZES[-1], rules))
    agent = make_agent(dataclasses.replace(config, net=net, **{name: part}))
    fill(agent.net, rules)
    agent.net.max_rules = rules
    return agent


def decide(agent: Learner) -> Callable[[], Any]:
    """Return a function that learns from one decision."""
    observations = cycle(list(states(5_000, seed=1)))
    agent.start(next(observations))
    return lambda: agent.step(0.0, next(observations), False)


def minimal(rules: int, outputs: int) -> Callable[[], Any]:
    """Return the hand-written forward and backward pass."""
    u = torch.from_numpy(states(rules, seed=0)).requires_grad_()
    v = torch.tensor([0.06, 0.06, 0.45]).repeat(rules, 1).requires_grad_()
    c = torch.zeros(rules, outputs, requires_grad=True)
    xs = cycle(list(torch.from_numpy(states(5_000, seed=1))))

    def run():
        z = (next(xs) - u) / v
        firing = torch.exp(-0.5 * (z * z).sum(1))
        y = (firing / firing.sum()) @ c
        return torch.autograd.grad(y.sum(), (u, v, c))

    return run


def both_passes(
    net: torch.nn.Module, batch: int, forward: Callable[[Tensor], Tensor] | None = None
) -> Callable[[], Any]:
    """Return a function that runs a forward pass, by default the network's, and the backward."""
    x, forward = torch.from_numpy(states(batch, seed=1)), forward or net

    def run() -> None:
        net.zero_grad()
        forward(x).sum().backward()

    return run


def decisions(repeats: int) -> list[dict[str, Any]]:
    """One decision's learning over the minimal passes, at 1,000 and 10,000 rules."""
    rows = []
    for rules in SIZES:
        for name in ("sga", "q"):
            agents = {a: learner(name, rules, a == "adapting") for a in ("fixed", "adapting")}
            baseline = minimal(rules, agents["fixed"].net.n_outputs)
            functions = {a: decide(agent) for a, agent in agents.items()} | {"minimal": baseline}
            times = interleaved(functions, repeats)
            rows += [
                {
                    "learner": f"{name}, antecedents {antecedents}",
                    "rules": rules,
                    "us": median(times[antecedents]),
                    "minimal us": median(times["minimal"]),
                    "ratio": ratio(times[antecedents], times["minimal"]),
                }
                for antecedents in agents
            ]
    return rows


def additions(repeats: int) -> list[dict[str, Any]]:
    """How much longer a decision takes that adds a rule, on average from 10,000 to 20,000 rules."""
    rows = []
    for consequents, interpolate in (("as configured", False), ("the present output", True)):
        means = []
        for _ in range(max(3, repeats // 5)):
            # So narrow that every state is new; so the capacity of the table doubles once.
            net = SOFNN(POSE, 3, width=1e-3, interpolate=interpolate)
            fill(net, SIZES[-1])
            differences = []
            for x in torch.from_numpy(states(SIZES[-1], seed=2)):
                net.max_rules = net.n_rules
                begin = time.perf_counter()
                net.observe(x)
                middle = time.perf_counter()
                net.max_rules += 1
                net.observe(x)
                differences.append(time.perf_counter() - middle - (middle - begin))
            means.append(np.mean(differences) * 1e6)
        rows.append({"its consequents": consequents, "us": median(np.array(means))})
    return rows


def threads(repeats: int) -> list[dict[str, Any]]:
    """One decision's learning with one and with two threads of torch."""
    rows = []
    for rules in (*SIZES, GROWTH[-1]):
        step = decide(learner("sga", rules))

        def run(count: int, step: Callable[[], Any] = step) -> Callable[[], Any]:
            def timed() -> None:
                torch.set_num_threads(count)
                for _ in range(20):
                    step()

            return timed

        times = interleaved({1: run(1), 2: run(2)}, repeats)
        row = {"rules": rules, "us with one": median(times[1]) / 20}
        rows.append(row | {"two over one": ratio(times[2], times[1])})
    torch.set_num_threads(1)
    return rows


def growth(repeats: int) -> list[dict[str, Any]]:
    """Time of one decision and memory for 10 to 100,000 rules."""
    rows = []
    for rules in GROWTH:
        agents = {name: learner(name, rules) for name in ("sga", "q")}
        functions = {name: decide(agent) for name, agent in agents.items()}
        times = interleaved(functions | {"minimal": minimal(rules, 3)}, repeats)
        net = agents["sga"].net
        held = sum(t.untyped_storage().nbytes() for t in net.state_dict().values())
        row = {"rules": rules, "sga KiB": held / 1024}
        rows.append(row | {f"{name} us": median(values) for name, values in times.items()})
    return rows


@figures.styled
def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw time and memory over the number of rules."""
    figure, (left, right) = figures.canvas(2, 4.2, 3.2)
    sizes = [row["rules"] for row in rows]
    labels = {"sga us": "SGA", "q us": "Q-learning", "minimal us": "minimal forward + backward"}
    for (name, label), (colour, line), mark in zip(
        labels.items(), figures.SERIES, "os^", strict=False
    ):
        style: dict[str, Any] = {"color": colour, "linestyle": line, "marker": mark}
        left.loglog(sizes, [row[name] for row in rows], markersize=4, label=label, **style)
    left.set(xlabel="rules", ylabel="µs per decision", title="time")
    left.legend()
    memory = [row["sga KiB"] for row in rows]
    right.loglog(sizes, memory, "o-", color=figures.BLUE, markersize=4)
    right.set(xlabel="rules", ylabel="KiB", title="parameters, traces and counters of SGA")
    path.write_bytes(figures.png(figure, dpi=110))


@arithmetic()
def main() -> None:
    """Measure, print tables, and write them as JSON."""
    options = arguments(__doc__, repeats=15, plot="PNG file to write")
    growing = growth(options.repeats)
    if options.plot:
        plot(options.plot, growing)
    report(
        options,
        decision=decisions(options.repeats),
        adding_a_rule=additions(options.repeats),
        two_threads=threads(options.repeats),
        growing=growing,
    )


if __name__ == "__main__":
    main()
