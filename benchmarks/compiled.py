"""A decision or a batch compiled as a whole, tried and not kept.

The learning of one decision of SGA (`learning.py`) is written once more as two pure functions of
tensors, growth test and all else, and compiled by torch.compile for any number of rules. It needs a
C++ compiler. The gradient is that of torch.func.grad, which compiles into the same loops. A forward
and backward pass for 64 states is compiled from the equations as they stand.

    python benchmarks/compiled.py --out compiled.json
"""

import time
from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np
import torch
from learning import SIZES, both_passes, decide, fill, learner, states
from timing import arguments, interleaved, median, ratio, report
from torch import Tensor

from sofnn_torch.learners.sga import SGA, negative_log_likelihood
from sofnn_torch.network.sofnn import SOFNN
from sofnn_torch.runs.session import arithmetic


class Decision:
    """Equations 1-8 of a learner with fixed antecedents and the learned baseline.

    Args:
        agent: whose network, traces and settings are taken; it must not grow.
    """

    def __init__(self, agent: SGA):
        self.agent, self.net = agent, agent.net
        self.periods = self.net.periods
        self.value = torch.zeros(())
        self.covers: Callable[..., Any] = self._covers
        self.learn: Callable[..., Any] = self._learn

    def compile(self) -> None:
        """Compile both functions."""
        self.covers = torch.compile(self._covers, dynamic=True)
        self.learn = torch.compile(self._learn, dynamic=True)

    @torch.no_grad()
    def step(self, reward: Tensor, x: Tensor, noise: Tensor) -> list[float]:
        """Learn from a reward (), then draw the action that the noise (1,) stands for.

        Returns:
            mean, deviation, value and action.
        """
        net = self.net
        log_firing, best = self.covers(x, net._centres, net._widths)
        assert best.item() > net.criterion.log_theta or net.n_rules == net.max_rules
        numbers = self.learn(
            log_firing,
            reward,
            self.value,
            noise,
            net._consequents,
            net._consequent_traces,
            net.usage,
        )
        self.value = numbers[2]
        return numbers.tolist()

    def _covers(self, x: Tensor, centres: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
        difference = x[:, None] - centres
        turns = torch.where(self.periods > 0, (difference / self.periods).round(), 0.0)
        squares = ((difference - turns * self.periods) / widths).square()
        log_firing = -0.5 * squares.sum(0)
        return log_firing, log_firing.amax()

    def _learn(
        self,
        log_firing: Tensor,
        reward: Tensor,
        value: Tensor,
        noise: Tensor,
        consequents: Tensor,
        traces: Tensor,
        usage: Tensor,
    ) -> Tensor:
        agent = self.agent
        firing = log_firing.softmax(0)
        usage.add_(firing)
        error = reward + agent.gamma * (consequents[-1] @ firing) - value
        mean, deviation, values = (consequents + error * agent.rates * traces).unbind()
        mean = mean.clamp(-agent.settings.mean_limit, agent.settings.mean_limit)
        deviation = deviation.clamp(agent.settings.sigma_min, agent.settings.sigma_max)
        updated = torch.stack([mean, deviation, values])

        def objective(consequents: Tensor) -> tuple[Tensor, Tensor]:
            mean, deviation, value = (consequents @ firing).split(1)
            action = (mean + deviation * noise).detach()
            likely = -negative_log_likelihood(action, mean, deviation) * deviation.detach().square()
            return (likely + value).sum(), torch.cat([mean, deviation, value, action])

        eligibility, numbers = torch.func.grad(objective, has_aux=True)(updated)
        consequents.copy_(updated)
        traces.mul_(agent.decay).add_(eligibility)
        return numbers


def compiled_decide(agent: SGA) -> Callable[[], Any]:
    """Return a function that learns from one decision, compiled."""
    decision, rng = Decision(agent), np.random.default_rng(0)
    decision.compile()
    xs, reward = cycle(list(torch.from_numpy(states(5_000, seed=1)))), torch.zeros(())

    def run() -> list[float]:
        return decision.step(reward, next(xs), torch.tensor([rng.standard_normal()]).float())

    return run


def conclude(table: Tensor, x: Tensor) -> Tensor:
    """Equations 1, 2 and 4 as they stand, for inputs that do not wrap. Shape: (B, m)."""
    centres, widths, consequents = table.split([3, 3, len(table) - 6])
    squares = ((x[:, :, None] - centres) / widths).square()
    return (-0.5 * squares.sum(1)).softmax(-1) @ consequents.T


def batch(rules: int, repeats: int) -> dict[str, Any]:
    """Forward and backward pass for 64 states, by the network and compiled."""
    net = SOFNN(3, 4, width=(0.06, 0.06, 0.45), interpolate=False)
    fill(net, rules)
    together = torch.compile(conclude)
    functions = {
        "eager": both_passes(net, 64),
        "compiled": both_passes(net, 64, lambda x: together(net.table(), x)),
    }
    times = interleaved(functions, repeats, seconds=0.2)
    row: dict[str, Any] = {"rules": f"{rules:,}"}
    row |= {f"{name} us": median(values) for name, values in times.items()}
    return row | {"compiled over eager": ratio(times["compiled"], times["eager"])}


@arithmetic()
def main() -> None:
    """Measure, print a table, and write it as JSON."""
    options = arguments(__doc__, repeats=15)
    numbers = torch.zeros(3)
    smallest = torch.compile(lambda x: x + 1)
    rows = []
    for rules in SIZES:
        agent, step = learner("sga", rules), compiled_decide(learner("sga", rules))
        begin = time.perf_counter()
        step()
        seconds = time.perf_counter() - begin
        functions = {"eager": decide(agent), "compiled": step, "x + 1": lambda: smallest(numbers)}
        times = interleaved(functions, options.repeats)
        row: dict[str, Any] = {"rules": f"{rules:,}", "compiling s": seconds}
        row |= {f"{name} us": median(values) for name, values in times.items()}
        rows.append(row | {"compiled over eager": ratio(times["compiled"], times["eager"])})
    batches = [batch(rules, options.repeats) for rules in SIZES]
    report(options, a_decision=rows, a_batch_of_64=batches)


if __name__ == "__main__":
    main()
