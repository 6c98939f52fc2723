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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sofnn_torch.learners.memory import ReplayMemory
from sofnn_torch.network.sofnn import SOFNN

Actions = Literal["three", "steer", "wheels"]
RIGHT, STRAIGHT, LEFT = 0, 1, 2


@dataclass(frozen=True)
class SGAConfig:
    """Section 3: stochastic gradient ascent."""

    actions: Actions = "three"
    """`three`: right turn, straight, left turn; `steer`: one continuous action that blends them;
    `wheels`: two wheel speeds."""
    gamma: float = 0.99
    """Discount per decision."""
    trace_decay: float = 0.8
    """Lambda of the eligibility traces; 1 in the paper."""
    baseline: Literal["constant", "value"] = "value"
    """Reinforcement baseline b of eq. 7: the paper's constant, or a value learned by TD."""
    constant: float = 0.0
    """The constant baseline."""
    rate_mean: float = 30.0
    """Learning rate of the consequents mu."""
    rate_deviation: float = 10.0
    """Learning rate of the consequents sigma."""
    rate_centre: float = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: float = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    rate_value: float = 1.0
    """Learning rate of the value consequents (baseline `value`)."""
    one_minus_gamma: bool = False
    """Multiply the policy's learning rates by (1 - gamma), as eq. 8 prints."""
    variance_scaled: bool = True
    """Multiply eligibilities by sigma squared, which keeps steps bounded as sigma shrinks."""
    initial_value: float = 0.65
    """Value of an unknown state (baseline `value`); optimistic at the start of the maze."""
    sigma_initial: float = 0.3
    """Standard deviation of the first rule, and of new rules without interpolation."""
    sigma_min: float = 0.1
    """Lower bound of sigma."""
    sigma_max: float = 1.0
    """Upper bound of sigma."""
    mean_limit: float = 1.0
    """Bound of |mu|."""
    value_limit: float | None = 2.0
    """Bound of |value| of the following state in the TD error, twice the goal's reward; None for
    no bound."""
    replays: int = 100
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none. Needs baseline `value`."""
    memory: int = 20_000
    """Decisions that are remembered."""


def surprise(action: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """Minus the logarithm of equation 5, but for its constant. Shape: that of the arguments."""
    z = (action - mean) / deviation
    return torch.addcmul(deviation.log(), z, z, value=0.5)


def log_likelihood(action: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """Logarithm of equation 5, with sigma outside the root. Shape: that of the arguments."""
    return -surprise(action, mean, deviation) - 0.5 * math.log(2 * math.pi)


def n_actions(actions: Actions) -> int:
    """Length of the action vector a: 2 for wheel speeds, 1 otherwise."""
    return 2 if actions == "wheels" else 1


class SGA:
    """The learner of section 3. Rows of the consequents: mu (m), sigma (m), value (1 if learned).

    Args:
        net: network with ``2 m`` outputs, ``2 m + 1`` with a learned baseline.
        config: the settings; their initial values are those of the network.
        seed: seed of the action sampling.

    Raises:
        ValueError: the network has another number of outputs, the bounds are not ordered, or
            replays lack the learned baseline.
    """

    def __init__(self, net: SOFNN, config: SGAConfig, seed: int = 0):
        m, learned = n_actions(config.actions), config.baseline == "value"
        if net.n_outputs != 2 * m + learned:
            raise ValueError(
                f"SGA needs {2 * m + learned} outputs, the network has {net.n_outputs}"
            )
        if not 0 < config.sigma_min <= config.sigma_max:
            bounds = f"{config.sigma_min} and {config.sigma_max}"
            raise ValueError(f"need 0 < sigma_min <= sigma_max, got {bounds}")
        if config.replays and not learned:
            raise ValueError("replays need the learned baseline: without it set replays to 0")
        self.net, self.config, self.m, self.learned = net, config, m, learned
        self.gamma, self.decay = config.gamma, config.gamma * config.trace_decay
        self.value_limit = math.inf if config.value_limit is None else config.value_limit
        self.rng = np.random.default_rng(seed)
        self.antecedents = config.rate_centre > 0 or config.rate_width > 0
        scale = 1 - config.gamma if config.one_minus_gamma else 1.0
        rates = [config.rate_mean * scale] * m + [config.rate_deviation * scale] * m
        rates += [config.rate_value] * learned
        if self.antecedents:
            n = net.n_inputs
            rates = [config.rate_centre * scale] * n + [config.rate_width * scale] * n + rates
        self.rates = net.default_width.new_tensor(rates)[:, None]
        self.one = self.rates.new_ones(1)
        self.parts = (m, m, 1) if learned else (m, m)  # outputs mu, sigma and value
        self.replay_rates = self.rates[-net.n_outputs :]
        if config.replays:
            n = net.n_inputs
            fields = {"state": n, "action": m, "surprise": 0}
            fields |= {"reward": 0, "goes_on": 0, "following": n}
            dtype = net.default_width.cpu().numpy().dtype
            self.memory = ReplayMemory(fields, config.memory, dtype)
        self.decision: list[float] = []  # state, action and its surprise
        self.value = 0.0
        self._log = {"mu": [], "sigma": [], "error": [], "firing": []}

    def start(self, observation: np.ndarray) -> int | np.ndarray:
        """Begin a trial at the observation (n,): clear the traces, choose the first action."""
        self.net.traces.zero_()
        if self.config.replays and len(self.memory):
            self._replay()
        x = self._tensor(observation)
        return self._choose(x, self.net.observe(x))

    def step(
        self, reward: float, observation: np.ndarray, terminated: bool, truncated: bool = False
    ) -> int | np.ndarray | None:
        """Learn from the reward of the last action, then choose the next (None at the end).

        Args:
            reward: reward of the last action.
            observation: the state that it led to. Shape: (n,).
            terminated: no state follows this one; its value is 0.
            truncated: the trial ends here, but not the robot's way: the value of the state counts.
        """
        if self.config.replays:
            self.memory.add([*self.decision, reward, not terminated, *observation.tolist()])
        if terminated:
            self._learn(reward - self.value if self.learned else reward - self.config.constant)
            return None
        x = self._tensor(observation)
        firing = self.net.observe(x)
        error = reward - self.config.constant
        if self.learned:
            ahead, limit = self.net.conclude(firing).tolist()[-1], self.value_limit
            error = reward + self.gamma * min(max(ahead, -limit), limit) - self.value
        self._learn(error)
        return None if truncated else self._choose(x, firing)

    def act(self, observation: np.ndarray, explore: float = 0) -> int | np.ndarray:
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

    def strongest_rule(self, observation: np.ndarray) -> int:
        """The rule that fires most at the state (n,)."""
        with torch.no_grad():
            return int(self.net.normalised_firing(self._tensor(observation)).argmax())

    def statistics(self) -> dict[str, float]:
        """Means over the decisions since the last call (docs/metrics.md); starts afresh."""
        log, self._log = self._log, {name: [] for name in self._log}
        if not log["mu"]:
            return {}
        mu, sigma = self.rates.new_tensor(log["mu"]), self.rates.new_tensor(log["sigma"])
        error = torch.tensor(log["error"] or [0.0])
        return {
            "policy/mu_mean": mu.mean().item(),
            "policy/mu_deviation": mu.std(unbiased=False).item(),
            "policy/sigma_mean": sigma.mean().item(),
            "policy/sigma_min": sigma.min().item(),
            "learning/error_rms": error.square().mean().sqrt().item(),
        } | self.net.statistics(log["firing"])

    def state_dict(self) -> dict:
        """Everything that the future depends on, as tensors, numbers and text."""
        rng = self.rng.bit_generator.state
        state = {"net": self.net.state_dict(), "rng": rng, "value": self.value}
        return state | ({"memory": self.memory.state_dict()} if self.config.replays else {})

    def load_state_dict(self, state: dict) -> None:
        """Counterpart of `state_dict`; a fresh learner takes the size of the stored network."""
        self.net.load_state_dict(state["net"])
        self.rng.bit_generator.state = state["rng"]
        self.value = state["value"]
        if self.config.replays:
            self.memory.load_state_dict(state["memory"])

    def _choose(self, x: Tensor, firing: Tensor) -> int | np.ndarray:
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
        scale = [-s * s for s in sigma] if self.config.variance_scaled else [-1.0] * m
        taken, weights = x.new_tensor([action, scale])
        mean, deviation, *value = outputs.split_with_sizes(self.parts)
        unexpected = surprise(taken, mean, deviation)
        if self.learned:  # the gradient of V is the trace of TD(lambda); it moves no antecedents
            self.value = numbers[-1]
            # With fixed antecedents the last output has the same gradient, and a cheaper graph.
            values = [consequents[-1:] @ firing.detach()] if self.antecedents else value
            gradient = torch.autograd.grad((unexpected, *values), parameters, (weights, self.one))
        else:
            gradient = torch.autograd.grad(unexpected, parameters, weights)
        net.accumulate(gradient[0], self.decay)
        if self.config.replays:
            unlikely = sum(math.log(s) + z * z / 2 for s, z in zip(sigma, noise, strict=True))
            self.decision = [*x.tolist(), *action, unlikely]
        self._log["mu"] += mu
        self._log["sigma"] += sigma
        self._log["firing"].append(net.max_firing)
        return self._command(action)

    def _learn(self, error: float) -> None:
        """Equations 7 and 8 for the reinforcement error r - b, then the bounds of mu and sigma."""
        self._log["error"].append(error)
        self.net.adapt(self.rates, error)
        self._bound()

    def _bound(self) -> None:
        self.net.clamp_consequents(0, self.m, -self.config.mean_limit, self.config.mean_limit)
        self.net.clamp_consequents(self.m, 2 * self.m, self.config.sigma_min, self.config.sigma_max)

    def _replay(self) -> None:
        """Equations 5-8 without traces for batches of remembered decisions; the antecedents stay.

        Another policy took them: each counts min(1, pi(a | x) now / then) (Wawrzynski, Neural
        Networks 22, 2009; Espeholt et al., ICML 2018).
        """
        net, (features, firing_at) = self.net, self.net.firing_functions()
        seen = self.memory.sample(self.config.replays, self.rng, self.rates)
        here, there = features(seen.pop("state")), features(seen.pop("following"))
        for x, following, *row in zip(here, there, *seen.values(), strict=True):
            action, then, reward, goes_on = row
            firing = firing_at(x)
            ahead = firing_at(following) @ net.consequents[:, -1]
            ahead.clamp_(-self.value_limit, self.value_limit)
            consequents = net.learnable(antecedents=False)
            mean, deviation, value = (consequents @ firing.T).split_with_sizes(self.parts)
            unexpected = surprise(action.T, mean, deviation)
            ratio = (then - unexpected.detach().sum(0)).exp_().clamp_(max=1.0)
            error = reward + self.gamma * goes_on * ahead - value.detach()
            weights, spread = ratio * error, deviation.detach()
            scale = spread.square() if self.config.variance_scaled else torch.ones_like(spread)
            (gradient,) = torch.autograd.grad(
                (value, unexpected), consequents, (weights, -weights * scale)
            )
            net.adapt_batch(self.replay_rates, gradient, ratio @ firing)
            self._bound()

    def _tensor(self, observation: np.ndarray) -> Tensor:
        return torch.from_numpy(observation).to(self.rates)

    def _command(self, action: Sequence[float] | np.ndarray) -> int | np.ndarray:
        if self.config.actions != "three":
            return np.clip(action, -1, 1).astype(np.float32)
        return RIGHT if action[0] < -1 / 3 else LEFT if action[0] > 1 / 3 else STRAIGHT
