"""Q-learning on a fuzzy network (section 4 of the paper, equations 9-15).

Each rule concludes a linear function of the state and the action, and the network weighs them:

    f_k(x, a) = c_x^k . x + c_a^k . a + c_k                                (eq. 9)
    Q(x, a)   = sum_k S_k f_k(x, a)                                        (eq. 10)
    P(j | x)  = exp(Q(x, a_j) / T) / sum_i exp(Q(x, a_i) / T)              (eq. 11)
    dQ        = r + gamma max_j Q(x', a_j) - Q(x, a)                       (eqs 12, 13)
    W <- W + epsilon dQ E,   E <- dQ(x, a)/dW + gamma lambda E             (eqs 14, 15; lambda = 0)

The range [-1, 1] of the scalar action is cut into J equal segments; one is drawn by roulette
(eq. 11) and the action uniformly inside it. The gradient comes from autograd for antecedents and
consequents; as usual the target is held constant (semi-gradient).
"""

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sofnn_torch.learners.memory import ReplayMemory
from sofnn_torch.network.sofnn import SOFNN

Coding = Literal["scalar", "wheels", "onehot", "antecedent"]
TURN = 0.4  # wheel speed of a turn over that of going straight: 4 mm/s of 10 mm/s


@dataclass(frozen=True)
class QConfig:
    """Section 4: Q-learning."""

    actions: Literal["three", "steer"] = "three"
    """`three`: right turn, straight, left turn; `steer`: one continuous action in J segments."""
    coding: Coding = "onehot"
    """Action vector of eq. 9: `scalar`, `wheels` (wheel speeds), `onehot`, or `antecedent` (the
    action also enters the rules' antecedents: the paper's fuzzy net - a)."""
    segments: int = 3
    """Number J of segments of the action range."""
    temperature: float = 0.05
    """Temperature T of the Boltzmann roulette, eq. 11."""
    gamma: float = 0.99
    """Discount per decision."""
    trace_decay: float = 0.8
    """Lambda of the eligibility traces; 0 in the paper."""
    trace_cut: bool = True
    """Clear the traces at an action that is not greedy (Watkins)."""
    trace_limit: float | None = 1.0
    """Bound of the consequents' traces; None for no bound."""
    value_limit: float | None = 100.0
    """Bound of the value of the following state in the TD error, the goal's reward; None for no
    bound."""
    rate_state: float = 0.0
    """Learning rate of c_x."""
    rate_action: float = 1.0
    """Learning rate of c_a."""
    rate_constant: float = 0.0
    """Learning rate of c."""
    rate_centre: float = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: float = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    initial: float = 65.0
    """Initial c of a rule, the value of an unknown state; optimistic at the start of the maze."""
    replays: int = 100
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none."""
    memory: int = 20_000
    """Decisions that are remembered."""


def code_length(coding: Coding, segments: int) -> int:
    """Length of the action vector in equation 9."""
    return {"scalar": 1, "wheels": 2, "onehot": segments, "antecedent": 1}[coding]


class QLearning:
    """The learner of section 4. Rows of the consequents: c_x (n), c_a, c (1).

    Args:
        net: network over the state, or over state and action with the coding ``antecedent``.
        n_states: length n of the state.
        config: the settings; their initial value is that of the network.
        seed: seed of the roulette and of the action inside a segment.

    Raises:
        ValueError: the network has another number of inputs or outputs, or a setting is out of
            range.
    """

    def __init__(self, net: SOFNN, n_states: int, config: QConfig, seed: int = 0):
        coding, segments = config.coding, config.segments
        length = code_length(coding, segments)
        inputs = n_states + (coding == "antecedent")
        if (net.n_inputs, net.n_outputs) != (inputs, n_states + length + 1):
            raise ValueError(
                f"coding {coding} needs {inputs} inputs and {n_states + length + 1} outputs, "
                f"the network has {net.n_inputs} and {net.n_outputs}"
            )
        if config.actions == "three" and segments != 3:
            raise ValueError(f"the three actions need 3 segments, got {segments}")
        if not config.temperature > 0:
            raise ValueError(f"the temperature must be positive, got {config.temperature}")
        self.net, self.n, self.config = net, n_states, config
        self.coding, self.segments = coding, segments
        self.gamma, self.decay = config.gamma, config.gamma * config.trace_decay
        self.value_limit = math.inf if config.value_limit is None else config.value_limit
        self.rng = np.random.default_rng(seed)
        self.antecedents = config.rate_centre > 0 or config.rate_width > 0
        rates = [config.rate_state] * n_states + [config.rate_action] * length
        rates += [config.rate_constant]
        if self.antecedents:
            n = net.n_inputs
            rates = [config.rate_centre] * n + [config.rate_width] * n + rates
        self.rates = net.default_width.new_tensor(rates)[:, None]
        self.replay_rates = self.rates[-net.n_outputs :]
        if config.replays:
            fields = {"features": net.n_outputs, "reward": 0, "goes_on": 0, "following": n_states}
            dtype = net.default_width.cpu().numpy().dtype
            self.memory = ReplayMemory(fields, config.memory, dtype)
        self.features: list[float] = []  # (x, a, 1) of the last decision
        ends = [-1 + 2 * j / segments for j in range(segments + 1)]
        self.edges = list(pairwise(ends))
        middles = [(low + high) / 2 for low, high in self.edges]
        # The three actions are the ends and the middle of the steering range themselves.
        self.representatives = [-1.0, 0.0, 1.0] if config.actions == "three" else middles
        codes = [self._code(j, a) for j, a in enumerate(self.representatives)]
        self.codes = self.rates.new_tensor(codes)  # (J, length)
        self.tails = torch.cat([self.codes, self.codes.new_ones(segments, 1)], 1)
        self.value = 0.0
        self._log = {"value": [], "error": [], "greedy": [], "firing": []}

    def start(self, observation: np.ndarray) -> int | np.ndarray:
        """Begin a trial at the observation (n,): clear the traces, choose the first action."""
        self.net.traces.zero_()
        if self.config.replays and len(self.memory):
            self._replay()
        x = self._tensor(observation)
        return self._choose(x, self._firing(x))

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
            self.memory.add([*self.features, reward, not terminated, *observation.tolist()])
        if terminated:
            self._learn(reward - self.value)
            return None
        x = self._tensor(observation)
        firing = self._firing(x)
        following = min(max(self.action_values(x, firing).tolist()), self.value_limit)
        self._learn(reward + self.gamma * following - self.value)
        if truncated:
            return None
        if self.antecedents:  # they have moved
            with torch.no_grad():
                firing = self.net.normalised_firing(self.inputs(x))
        return self._choose(x, firing)

    def act(self, observation: np.ndarray, explore: float = 0) -> int | np.ndarray:
        """The greedy action, or one by roulette; learns nothing and adds no rule.

        Args:
            observation: the state. Shape: (n,).
            explore: 0 for the greedy action, 1 for the roulette, more for one that is as many
                times hotter.
        """
        x = self._tensor(observation)
        with torch.no_grad():
            values = self.action_values(x, self.net.normalised_firing(self.inputs(x)))
        if explore:
            return self._command(*self._draw(values.tolist(), explore))
        segment = int(values.argmax())
        return self._command(segment, self.representatives[segment])

    def strongest_rule(self, observation: np.ndarray) -> int:
        """The rule that fires most at the state (n,)."""
        with torch.no_grad():
            firing = self.net.normalised_firing(self.inputs(self._tensor(observation)))
        return int(firing.argmax()) % self.net.n_rules

    def statistics(self) -> dict[str, float]:
        """Means over the decisions since the last call (docs/metrics.md); starts afresh."""
        log, self._log = self._log, {name: [] for name in self._log}
        if not log["value"]:
            return {}
        value, error = torch.tensor(log["value"]), torch.tensor(log["error"] or [0.0])
        return {
            "policy/value_mean": value.mean().item(),
            "policy/value_max": value.max().item(),
            "policy/greedy_share": sum(log["greedy"]) / len(log["greedy"]),
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

    def action_values(self, x: Tensor, firing: Tensor) -> Tensor:
        """Q(x, a_j) of every segment (eq. 10).

        Args:
            x: state, or many. Shape: (n,) or (B, n).
            firing: normalised firing at ``inputs(x)``.

        Returns:
            Shape: (J,) or (B, J).
        """
        conclusions = firing @ self.net.consequents
        if self.coding != "antecedent":
            conclusions = conclusions.unsqueeze(-2)  # the same for every action
        features = torch.cat(self._beside(x, self.tails), -1)
        return (features * conclusions).sum(-1)

    def inputs(self, x: Tensor) -> Tensor:
        """Network inputs at states (.., n): the same, or with every action (.., J, n + 1)."""
        if self.coding != "antecedent":
            return x
        return torch.cat(self._beside(x, self.codes), -1)

    def _firing(self, x: Tensor) -> Tensor:
        """Normalised firing at x: (K,), or (J, K) if the action is an antecedent."""
        if self.coding != "antecedent":
            return self.net.observe(x)
        inputs = self.inputs(x)
        if self.net.n_rules == 0:
            self.net.grow(inputs[self.segments // 2])
        with torch.no_grad():
            return self.net.normalised_firing(inputs)

    def _choose(self, x: Tensor, firing: Tensor) -> int | np.ndarray:
        """Draw an action (eq. 11) and add the gradient of its value to the traces."""
        net = self.net
        values = self.action_values(x, firing).tolist()
        segment, inside = self._draw(values)
        scalar = self.representatives[segment] if self.config.actions == "three" else inside
        # The paper draws the action inside the segment also where the robot only has three.
        code = self._code(segment, inside if self.coding == "scalar" else scalar)
        self.features = [*x.tolist(), *code, 1.0]
        features = x.new_tensor(self.features)
        if self.coding == "antecedent":
            x = features[: self.n + 1]
            firing = net.observe(x)
        parameters = consequents = net.learnable(self.antecedents)
        if self.antecedents:
            *antecedents, consequents = parameters.split_with_sizes(net.parts)
            firing = net.normalised_firing(x, antecedents)
        outputs = consequents @ firing
        self.value = (features @ outputs.detach()).item()
        greedy = values[segment] == max(values)
        decay = self.decay if greedy or not self.config.trace_cut else 0.0
        gradient = torch.autograd.grad(outputs, parameters, features)[0]  # of features . outputs
        net.accumulate(gradient, decay, self.config.trace_limit)
        self._log["value"].append(self.value)
        self._log["greedy"].append(greedy)
        self._log["firing"].append(net.max_firing)
        return self._command(segment, scalar)

    def _learn(self, error: float) -> None:
        """Equations 14 and 15 for the temporal-difference error."""
        self._log["error"].append(error)
        self.net.adapt(self.rates, error)

    def _replay(self) -> None:
        """Equations 12-15 for batches of remembered decisions; the antecedents stay."""
        net, (features_of, firing_at) = self.net, self.net.firing_functions()
        seen = self.memory.sample(self.config.replays, self.rng, self.rates)
        here = features_of(seen["features"][..., : net.n_inputs])
        there = features_of(self.inputs(seen["following"]))
        for x, ahead, *row in zip(here, there, *seen.values(), strict=True):
            features, reward, goes_on, following = row
            best = self.action_values(following, firing_at(ahead)).amax(-1)
            firing, consequents = firing_at(x), net.learnable(antecedents=False)
            value = (features.T * (consequents @ firing.T)).sum(0)
            target = reward + self.gamma * goes_on * best.clamp_(max=self.value_limit)
            (gradient,) = torch.autograd.grad(value, consequents, target - value.detach())
            net.adapt_batch(self.replay_rates, gradient, features.T.abs() @ firing)

    def _roulette(self, values: list[float], hotter: float = 1) -> int:
        """A segment drawn with the probabilities of equation 11."""
        best, temperature = max(values), self.config.temperature * hotter
        wheel = list(accumulate(math.exp((v - best) / temperature) for v in values))
        ball = self.rng.random() * wheel[-1]
        return next(j for j, edge in enumerate(wheel) if ball < edge)

    def _draw(self, values: list[float], hotter: float = 1) -> tuple[int, float]:
        """A segment by the roulette, and a number drawn uniformly inside it."""
        segment = self._roulette(values, hotter)
        low, high = self.edges[segment]
        return segment, low + (high - low) * self.rng.random()

    def _code(self, segment: int, scalar: float) -> list[float]:
        """The action vector a of equation 9."""
        if self.coding == "onehot":
            return [float(j == segment) for j in range(self.segments)]
        if self.coding == "wheels":
            forward, turn = 1 - abs(scalar), TURN * scalar
            return [forward - turn, forward + turn]
        return [scalar]

    def _beside(self, x: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """States (.., n) and codes (J, c), repeated so that each stands beside each."""
        shape = (*x.shape[:-1], self.segments, -1)
        return x.unsqueeze(-2).expand(shape), codes.expand(shape)

    def _tensor(self, observation: np.ndarray) -> Tensor:
        return torch.from_numpy(observation).to(self.rates)

    def _command(self, segment: int, scalar: float) -> int | np.ndarray:
        return segment if self.config.actions == "three" else np.array([scalar], np.float32)
