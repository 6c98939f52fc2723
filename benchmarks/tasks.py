"""What the presets learn on Gymnasium's classic tasks in a stated number of environment steps.

    python benchmarks/tasks.py --out docs/results/tasks.json
    python benchmarks/tasks.py --env MountainCar-v0 --agent q --seeds 5 --steps 40000
    python benchmarks/tasks.py --table docs/results/tasks.json    # the table of docs/tasks.md

Each seed trains with the preset ``default`` until the trial that completes the steps, with replay
and without, and plays 20 trials without learning or exploration; its return is their mean. Seconds
are processor time of the training. Runs stay in ``--runs`` and are not repeated.
"""

import dataclasses
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from sofnn_torch import Config, RunOptions, load
from sofnn_torch.evaluate import evaluate
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.studies.statistics import mean
from sofnn_torch.training import train

STEPS = {
    "MountainCar-v0": 40_000,
    "CartPole-v1": 50_000,
    "Acrobot-v1": 100_000,
    "MountainCarContinuous-v0": 20_000,
    "Pendulum-v1": 20_000,
}
EPISODES = 20  # trials that the learned policy plays
KEPT = "played.json"
REPLAY = {"with": True, "without": False}


@dataclasses.dataclass
class Options:
    """Train the presets on tasks and play what they learned."""

    env: tuple[str, ...] = tuple(STEPS)
    """Tasks."""
    agent: tuple[str, ...] = ("q",)
    """Learners."""
    replay: tuple[str, ...] = tuple(REPLAY)
    """With replay, without, or both."""
    seeds: int = 20
    """Seeds 0, 1, ... of each."""
    steps: int | None = None
    """Environment steps of training; by default those of the table, 50,000 for other tasks."""
    runs: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/tasks")
    """Where the runs go."""
    out: Path | None = None
    """Write what was measured as JSON; rows that are there already, but not measured now, stay."""
    table: Path | None = None
    """Measure nothing: print the table of this JSON."""


def settings(env: str, agent: str, seed: int, replay: bool) -> Config:
    """The preset for a task, as it is or without replay."""
    config = Config(env=env, agent=agent, seed=seed, trials=100_000)
    if replay:
        return config
    learner = dataclasses.replace(getattr(config, agent), replays=0, replay_every=0)
    return dataclasses.replace(config, **{agent: learner})


def learned(config: Config, steps: int, run: Path) -> dict[str, Any]:
    """Train a run to so many environment steps and play it: steps, rules, seconds, mean return."""
    found, records = trained(config, run, lambda record: record.total_steps >= steps)
    if records:
        found["return"] = float(np.mean([record.reward for record in records]))
        keep(found, run)
    return found


def trained(
    config: Config, run: Path, over: Callable[[TrialRecord], bool] | None = None
) -> tuple[dict[str, Any], list[TrialRecord]]:
    """Train a run until it is over and play it; of one that did, what was kept, without trials."""
    if (run / KEPT).exists():
        return json.loads((run / KEPT).read_text()), []
    shutil.rmtree(run, ignore_errors=True)  # it was cut short
    begin = time.process_time()
    train(config, RunOptions.silent(run), over)
    seconds = time.process_time() - begin
    config, agent, _, state = load(run)
    with arithmetic():
        records = evaluate(config, agent, EPISODES)
    rules = agent.net.n_rules
    found = {"seed": config.seed, "steps": state["total_steps"], "rules": rules}
    return found | {"seconds": round(seconds, 1)}, records


def keep(found: dict[str, Any], run: Path) -> None:
    """Keep what was found with the run."""
    (run / KEPT).write_text(json.dumps(found) + "\n")


def row(cell: dict[str, Any]) -> str:
    """A line of the table in Markdown."""
    seeds = cell["seeds"]
    returns = np.array([seed["return"] for seed in seeds])
    found, digits = mean(returns), 1
    interval = f"{found.low:.{digits}f} .. {found.high:.{digits}f}"
    if np.isnan(found.low):
        interval = "-"
    rules, worst = [seed["rules"] for seed in seeds], returns.min()
    seconds = np.median([seed["seconds"] for seed in seeds])
    return (
        f"| {cell['env']} | {cell['agent'].upper()} | {cell['replay']} | {cell['steps']:,} "
        f"| {len(seeds)} | {found.value:.{digits}f} | {interval} | {worst:.{digits}f} "
        f"| {min(rules)}-{max(rules)} | {seconds:.0f} |"
    )


def table(cells: list[dict[str, Any]]) -> str:
    """What was measured, in Markdown."""
    head = "Task|Learner|Replay|Steps|Seeds|Mean return|95 % interval|Worst seed|Rules|Seconds"
    names = head.split("|")
    ruler = ["---"] * 3 + ["---:"] * (len(names) - 3)
    lines = [f"| {' | '.join(names)} |", f"| {' | '.join(ruler)} |"]
    return "\n".join([*lines, *map(row, cells)])


def merged(cells: list[dict[str, Any]], out: Path) -> list[dict[str, Any]]:
    """The cells and those of the file that are of others, in the order of the tasks."""

    def name(cell: dict[str, Any]) -> tuple[Any, ...]:
        known = [*STEPS, cell["env"]].index(cell["env"])
        return known, cell["env"], cell["agent"], cell["replay"], cell["steps"]

    before = json.loads(out.read_text()) if out.exists() else []
    both = {name(cell): cell for cell in [*before, *cells]}
    return [both[key] for key in sorted(both)]


def main() -> None:
    """Print a line for each seed, then the table."""
    options = tyro.cli(Options, description=__doc__)
    if options.table:
        print(table(json.loads(options.table.read_text())))
        return
    cells: list[dict[str, Any]] = []
    for env in options.env:
        steps = options.steps or STEPS.get(env, 50_000)
        for agent in options.agent:
            for replay in options.replay:
                seeds: list[dict[str, float]] = []
                cell = {"env": env, "agent": agent, "replay": replay, "steps": steps}
                cells.append(cell | {"seeds": seeds})
                for seed in range(options.seeds):
                    run = options.runs / f"{env}-{agent}-{replay}-{steps}-s{seed}"
                    config = settings(env, agent, seed, REPLAY[replay])
                    seeds.append(learned(config, steps, run))
                    said = (f"{k} {v:,.4g}" for k, v in seeds[-1].items())
                    print(env, agent, replay, "replay:", *said, flush=True)
                    if options.out:
                        text = json.dumps(merged(cells, options.out), indent=1)
                        options.out.write_text(text + "\n")
    print(table(cells))


if __name__ == "__main__":
    main()
