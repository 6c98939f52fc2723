"""Stochastic gradient ascent on a fuzzy network (section 3 of the paper, equations 4-8).

The network concludes the mean and the standard deviation of each action, and, for the learned
baseline, the value of the state. One decision of the learner:

    mu_j, sigma_j = network(x)                                             (eq. 4)
    a_j ~ N(mu_j, sigma_j)                                                 (eq. 5)
    e = d ln pi(a | x) / dW,   E <- e + gamma lambda E                     (eq. 6; lambda = 1)
    W <- W + alpha (1 - gamma) (r - b) E                                   (eqs 7, 8)

The gradient e comes from autograd for every w in W = {u, v, mu, sigma}. The baseline b is a
constant, as in the paper, or the change of a value V learned on the same rules by TD(lambda)
(Kimura & Kobayashi, ICML 1998): b = V(x_t) - gamma V(x_t+1) makes r - b the TD error.
"""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sofnn_torch.bounds import Count, NotNegative, Positive, Settings, Share, Within
from sofnn_torch.learners.learner import Action, Layout, Learner, Output, Task, column
from sofnn_torch.learners.memory import ReplayMemory
from sofnn_torch.network.sofnn import SOFNN

# Bounds of mu and sigma would hide a rate that makes a typical step longer than their range.
PolicyRate = Annotated[NotNegative, Within(most=500)]


@dataclass(frozen=True)
class SGAConfig(Settings, table="sga"):
    """Section 3: stochastic gradient ascent.

    Examples:
        >>> SGAConfig(replays=0).idle()
        {'constant': 'with --sga.baseline value', 'memory': 'without replay'}
    """

    gamma: Share = 0.99
    """Discount per decision."""
    trace_decay: Share = 0.8
    """Lambda of the eligibility traces; 1 in the paper."""
    baseline: Literal["constant", "value"] = "value"
    """Reinforcement baseline b of eq. 7: the paper's constant, or a value learned by TD."""
    constant: float = 0.0
    """The constant baseline."""
    rate_mean: PolicyRate = 30.0
    """Learning rate of the consequents mu."""
    rate_deviation: PolicyRate = 10.0
    """Learning rate of the consequents sigma."""
    action_range: Positive = 1.0
    """Greatest action in the unit for which the rates of mu and sigma are meant; their steps grow
    with 1 / its square. Mu, sigma and their bounds are shares of it. The paper prints no range."""
    rate_centre: NotNegative = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: NotNegative = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    rate_value: NotNegative = 1.0
    """Learning rate of the value consequents (baseline `value`)."""
    one_minus_gamma: bool = False
    """Multiply the policy's learning rates by (1 - gamma), as eq. 8 prints."""
    variance_scaled: bool = True
    """Multiply eligibilities by sigma squared, which keeps steps bounded as sigma shrinks."""
    initial_value: float = 0.65
    """Value of an unknown state (baseline `value`); optimistic at the start of the maze."""
    sigma_initial: Positive = 0.3
    """Standard deviation of the first rule, and of new rules without interpolation."""
    sigma_min: Positive = 0.1
    """Lower bound of sigma."""
    sigma_max: Positive = 1.0
    """Upper bound of sigma."""
    mean_limit: Positive = 1.0
    """Bound of |mu|."""
    value_limit: float | None = 2.0
    """Bound of |value| of the next state in the TD error, twice the goal's reward; None for no
    bound."""
    replays: Annotated[int, Within(least=0)] = 100
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none. Needs baseline `value`."""
    replay_every: Annotated[int, Within(least=0)] = 0
    """Decisions after each of which one more batch is learned from, in the trial; 0 for none. Needs
    baseline `value`."""
    memory: Annotated[Count, Within(most=10_000_000)] = 20_000
    """Decisions that are remembered."""

    def __post_init__(self) -> None:
        """Check the numbers, and the bounds against each other."""
        super().__post_init__()
        if not self.sigma_min <= self.sigma_initial <= self.sigma_max:
            raise ValueError("need --sga.sigma-min <= --sga.sigma-initial <= --sga.sigma-max")
        for name in ("replays", "replay_every"):
            if getattr(self, name) and self.baseline == "constant":
                flag = f"--sga.{name.replace('_', '-')}"
                raise ValueError(f"{flag} needs --sga.baseline value: set {flag} 0")

    def idle(self) -> dict[str, str]:
        """Settings that change nothing beside the others, and why."""
        valued = "with --sga.baseline value"
        constant = dict.fromkeys(
            ("rate_value", "initial_value", "value_limit"), "without a learned baseline"
        )
        idle = {"constant": valued} if self.baseline == "value" else constant
        if self.replays or self.replay_every:
            return idle
        return idle | {"memory": "without replay"}


def negative_log_likelihood(action: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """Minus the logarithm of equation 5, but for its constant. Shape: that of the arguments."""
    z = (action - mean) / deviation
    return torch.addcmul(deviation.log(), z, z, value=0.5)


class SGA(Learner):
    """The learner of section 3. Rows of the consequents: mu (m), sigma (m), value (1 if learned).

    Of discrete actions one is taken for each of as many equal parts of the range [-1, 1] of a
    single normal action; other tasks have one normal action for each number of their actions.

    Args:
        net: network with ``2 m`` outputs, ``2 m + 1`` with a learned baseline.
        task: what is learned.
        settings: of the learner; their initial values are those of the network.
        seed: seed of the action sampling.

    Raises:
        ValueError: the network has another number of inputs or outputs.

    Examples:
        >>> from sofnn_torch.network.axes import named
        >>> task = Task(named(2), ("left", "right"), discrete=True)
        >>> agent = SGA(SOFNN(2, 3, width=0.2, initial=[0.0, 0.3, 0.65]), task, SGAConfig())
        >>> agent.start(np.array([0.1, 0.2])) in (0, 1)
        True
    """

    name = "sga"
    greedy = "mean"
    Settings = SGAConfig

    def __init__(self, net: SOFNN, task: Task, settings: SGAConfig, seed: int = 0):
        super().__init__(net, task, settings, seed)
        m, learned = _numbers(task), settings.baseline == "value"
        self.m, self.learned = m, learned
        self.gamma, self.decay = settings.gamma, settings.gamma * settings.trace_decay
        self.value_limit = math.inf if settings.value_limit is None else settings.value_limit
        self.antecedents = settings.rate_centre > 0 or settings.rate_width > 0
        scale = 1 - settings.gamma if settings.one_minus_gamma else 1.0
        # d/d(s mu) is 1/s d/d mu, and a step of s mu one of mu over s.
        share = scale / settings.action_range**2
        rates = [settings.rate_mean * share] * m + [settings.rate_deviation * share] * m
        rates += [settings.rate_value] * learned
        if self.antecedents:
            n = net.n_inputs
            rates = [settings.rate_centre * scale] * n + [settings.rate_width * scale] * n + rates
        self.rates = column(net, rates)
        self.one = self.rates.new_ones(1)
        self.parts = (m, m, 1) if learned else (m, m)  # outputs mu, sigma and value
        self.replay_rates = self.rates[-net.n_outputs :]
        # Between them lie the parts of the range that stand for discrete actions.
        parts = len(task.actions)
        self.edges = [(2 * j - parts) / parts for j in range(1, parts)]
        if settings.replays or settings.replay_every:
            fields = {"state": net.n_inputs, "action": m, "negative_log_likelihood": 0}
            self._remember(fields, settings.memory)

    @classmethod
    def layout(cls, settings: SGAConfig, task: Task) -> Layout:
        """The state, and mean and deviation of each action, and the value if it is learned."""
        of = [f" {name}" for name in task.actions] if _numbers(task) > 1 else [""]
        limit, low, high = settings.mean_limit, settings.sigma_min, settings.sigma_max
        outputs = [Output(f"mu{name}", 0.0, -limit, limit) for name in of]
        outputs += [Output(f"sigma{name}", settings.sigma_initial, low, high) for name in of]
        if settings.baseline == "value":
            # An unknown state keeps its initial value: optimism is what makes a robot explore.
            outputs.append(Output("value", settings.initial_value, interpolates=False))
        return task.axes, tuple(outputs)

    def act(self, observation: NDArray[Any], explore: float = 0) -> Action:
        """The mean action, or a sampled one; learns nothing and adds no rule.

        Args:
            observation: the state. Shape: (n,).
            explore: 0 for the mean action, 1 for a sample of equation 5, more for one with a
                standard deviation that is as many times larger.
        """
        with torch.no_grad():
            outputs = self.net(self._tensor(observation)[None])[0].tolist()
        mean, sigma = np.array(outputs[: self.m]), np.array(outputs[self.m : 2 * self.m])
        return self._command(self.rng.normal(mean, explore * sigma) if explore else mean)

    def alone(self, conclusions: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """The action that each mean stands for. Shape: (K,)."""
        return np.searchsorted(self.edges, conclusions[:, 0]) if self.choices else None

    def margins(self, conclusions: NDArray[np.float64], chosen: int) -> NDArray[np.float64]:
        """How far each mean is inside the part of the range of the chosen action. Shape: (K,)."""
        ends = [-math.inf, *self.edges, math.inf]
        return np.minimum(conclusions[:, 0] - ends[chosen], ends[chosen + 1] - conclusions[:, 0])

    def decoding(self) -> dict[str, Any]:
        """The first m outputs are means, the next m deviations; edges part discrete actions."""
        return {"kind": "normal", "numbers": self.m, "edges": self.edges if self.choices else None}

    def _policy(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        outputs = self.net(x)
        value = outputs[:, -1] if self.learned else None
        actions = outputs[:, : self.m].clamp(-1, 1)
        if self.choices:
            return torch.bucketize(actions[:, 0], actions.new_tensor(self.edges)), value
        return actions, value

    def _choose(self, x: Tensor, firing: Tensor) -> Action:
        """Sample an action (eq. 5) and add its eligibility to the traces (eq. 6)."""
        net, m = self.net, self.m
        parameters = consequents = net.learnable(self.antecedents)
        if self.antecedents:
            *antecedents, consequents = parameters.split_with_sizes(net.parts)
            firing = net.normalised_firing(x, antecedents)
        outputs = consequents @ firing
        numbers = outputs.tolist()
        mu, sigma = numbers[:m], numbers[m : 2 * m]
        noise = [self.rng.standard_normal() for _ in range(m)]
        action = [u + s * z for u, s, z in zip(mu, sigma, noise, strict=True)]
        scale = [-s * s for s in sigma] if self.settings.variance_scaled else [-1.0] * m
        taken, weights = x.new_tensor([action, scale])
        mean, deviation, *value = outputs.split_with_sizes(self.parts)
        likelihood = negative_log_likelihood(taken, mean, deviation)
        if self.learned:  # the gradient of V is the trace of TD(lambda); it moves no antecedents
            self.value = numbers[-1]
            # With fixed antecedents the last output has the same gradient, and a cheaper graph.
            values = [consequents[-1:] @ firing.detach()] if self.antecedents else value
            gradient = torch.autograd.grad((likelihood, *values), parameters, (weights, self.one))
        else:
            gradient = torch.autograd.grad(likelihood, parameters, weights)
        net.accumulate(gradient[0], self.decay)
        if self.memory is not None:
            then = sum(math.log(s) + z * z / 2 for s, z in zip(sigma, noise, strict=True))
            self.decision = [*x.tolist(), *action, then]
        self._log["mu"] += mu
        self._log["sigma"] += sigma
        self._log["firing"].append(net.max_firing)
        return self._command(action)

    def _error(self, reward: float, x: Tensor | None = None, firing: Tensor | None = None) -> float:
        """The reinforcement r - b of equation 7; with a learned baseline the TD error."""
        if not self.learned:
            return reward - self.settings.constant
        if firing is None:
            return reward - self.value
        ahead, limit = self.net.conclude(firing).tolist()[-1], self.value_limit
        return reward + self.gamma * min(max(ahead, -limit), limit) - self.value

    def _learn(self, error: float) -> None:
        """Equations 7 and 8 for the reinforcement r - b, then the bounds of mu and sigma."""
        self._log["error"].append(error)
        self.net.adapt(self.rates, error)
        self._bound()

    def _bound(self) -> None:
        m, settings = self.m, self.settings
        self.net.clamp_consequents(0, m, -settings.mean_limit, settings.mean_limit)
        self.net.clamp_consequents(m, 2 * m, settings.sigma_min, settings.sigma_max)

    def _replay(self, memory: ReplayMemory, batches: int) -> None:
        """Equations 5-8 without traces for batches of remembered decisions; the antecedents stay.

        Another policy took them: each counts min(1, pi(a | x) now / then) (Wawrzynski, Neural
        Networks 22, 2009; Espeholt et al., ICML 2018).
        """
        net, (features, firing_at) = self.net, self.net.firing_functions()
        seen = memory.sample(batches, self.rng, self.rates)
        states, next_states = features(seen.pop("state")), features(seen.pop("next_state"))
        for x, next_x, *row in zip(states, next_states, *seen.values(), strict=True):
            action, then, reward, continues = row
            firing = firing_at(x)
            ahead = firing_at(next_x) @ net.consequents[:, -1]
            ahead.clamp_(-self.value_limit, self.value_limit)
            consequents = net.learnable(antecedents=False)
            mean, deviation, value = (consequents @ firing.T).split_with_sizes(self.parts)
            now = negative_log_likelihood(action.T, mean, deviation)
            ratio = (then - now.detach().sum(0)).exp_().clamp_(max=1.0)
            error = reward + self.gamma * continues * ahead - value.detach()
            weights, spread = ratio * error, deviation.detach()
            scale = spread.square() if self.settings.variance_scaled else torch.ones_like(spread)
            (gradient,) = torch.autograd.grad(
                (value, now), consequents, (weights, -weights * scale)
            )
            net.adapt_batch(self.replay_rates, gradient, ratio @ firing)
            self._bound()

    def _summary(self, log: dict[str, list[float]]) -> dict[str, float]:
        mu, sigma = self.rates.new_tensor(log["mu"]), self.rates.new_tensor(log["sigma"])
        return {
            "policy/mu_mean": mu.mean().item(),
            "policy/mu_deviation": mu.std(unbiased=False).item(),
            "policy/sigma_mean": sigma.mean().item(),
            "policy/sigma_min": sigma.min().item(),
        }

    def _command(self, action: Sequence[float] | NDArray[np.float64]) -> Action:
        if self.choices:
            return bisect.bisect_left(self.edges, action[0])
        return np.clip(action, -1, 1).astype(np.float32)


def _numbers(task: Task) -> int:
    """Length m of the action vector a."""
    return 1 if task.discrete else len(task.actions)
