"""Q-learning on a fuzzy network (section 4 of the paper, equations 9-15).

Each rule concludes a linear function of the state and the action, and the network weighs them:

    f_k(x, a) = c_x^k . x + c_a^k . a + c_k                                (eq. 9)
    Q(x, a)   = sum_k S_k f_k(x, a)                                        (eq. 10)
    P(j | x)  = exp(Q(x, a_j) / T) / sum_i exp(Q(x, a_i) / T)              (eq. 11)
    dQ        = r + gamma max_j Q(x', a_j) - Q(x, a)                       (eqs 12, 13)
    W <- W + epsilon dQ E,   E <- dQ(x, a)/dW + gamma lambda E             (eqs 14, 15; lambda = 0)

The range [-1, 1] of the scalar action is cut into J equal segments; one is drawn by roulette
(eq. 11) and the action uniformly inside it. The gradient comes from autograd for antecedents and
consequents; as usual the target is held constant (semi-gradient). Of what an action is worth less
than the best of its state, dQ takes off a share more: actions whose values lie close together, as
they do where decisions are frequent, move apart and the best of them stays the best (advantage
learning: Bellemare et al., Increasing the action gap, AAAI 2016).
"""

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sofnn_torch.bounds import Count, NotNegative, Positive, Settings, Share, Within
from sofnn_torch.learners.learner import Action, Layout, Learner, Output, Task, column
from sofnn_torch.learners.memory import ReplayMemory
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN

ACTION = Axis("action", "", -1.0, 1.0)


@dataclass(frozen=True)
class QConfig(Settings, table="q"):
    """Section 4: Q-learning.

    Examples:
        >>> QConfig(temperature=0.1).value_limit
        100.0
    """

    coding: Literal["scalar", "wheels", "onehot", "antecedent"] = "onehot"
    """Action vector of eq. 9: `scalar`, `wheels` (wheel speeds), `onehot`, or `antecedent` (the
    action also enters the rules' antecedents: the paper's fuzzy net - a)."""
    segments: Annotated[int, Within(above=0), Within(most=1_000)] = 3
    """Number J of segments of a continuous range; of discrete actions J is their number."""
    points: bool = False
    """Actions in a continuous range are J points from one end to the other, instead of drawn in
    segments."""
    temperature: Positive = 0.05
    """Temperature T of the Boltzmann roulette, eq. 11."""
    gamma: Share = 0.99
    """Discount per decision."""
    trace_decay: Share = 0.8
    """Lambda of the eligibility traces; 0 in the paper."""
    trace_cut: bool = True
    """Clear the traces at an action that is not greedy (Watkins)."""
    trace_limit: Positive | None = 1.0
    """Bound of the consequents' traces; None for no bound."""
    value_limit: float | None = 100.0
    """Bound of the value of the next state in the TD error, the goal's reward; None for no
    bound."""
    action_gap: Share = 0.5
    """Share of what an action is worth less than the best that is taken off its value in the TD
    error: values of actions move apart; 0 in the paper."""
    rate_state: NotNegative = 0.0
    """Learning rate of c_x."""
    rate_action: NotNegative = 1.0
    """Learning rate of c_a."""
    rate_constant: NotNegative = 0.0
    """Learning rate of c."""
    rate_centre: NotNegative = 0.0
    """Learning rate of the centres u; 0 leaves them where they were put."""
    rate_width: NotNegative = 0.0
    """Learning rate of the widths v; 0 leaves them as they are."""
    initial: float = 65.0
    """Initial c of a rule, the value of an unknown state; optimistic at the start of the maze."""
    replays: Annotated[int, Within(least=0)] = 50
    """Batches of remembered decisions to learn from again at the beginning of each trial; 0 for
    none."""
    replay_every: Annotated[int, Within(least=0)] = 1
    """Decisions after each of which one more batch is learned from, in the trial; 0 for none."""
    memory: Annotated[Count, Within(most=10_000_000)] = 20_000
    """Decisions that are remembered."""

    def idle(self) -> dict[str, str]:
        """Settings that change nothing beside the others, and why."""
        return {} if self.replays or self.replay_every else {"memory": "without replay"}


class QLearning(Learner):
    """The learner of section 4. Rows of the consequents: c_x (n), c_a, c (1).

    Args:
        net: network over the state, or over state and action with the coding ``antecedent``.
        task: what is learned; a vector of actions may have one number.
        settings: of the learner; their initial value is that of the network.
        seed: seed of the roulette and of the action inside a segment.

    Raises:
        ValueError: the network has another number of inputs or outputs, or the settings do not go
            with the task.

    Examples:
        >>> from sofnn_torch.network.axes import named
        >>> task = Task(named(2), ("left", "right"), discrete=True)
        >>> agent = QLearning(SOFNN(2, 5, width=0.2), task, QConfig())
        >>> agent.start(np.array([0.1, 0.2])) in (0, 1)
        True
    """

    name = "q"
    Settings = QConfig

    def __init__(self, net: SOFNN, task: Task, settings: QConfig, seed: int = 0):
        super().__init__(net, task, settings, seed)
        self.n, self.coding = len(task.axes), settings.coding
        self.segments = segments = len(task.actions) if task.discrete else settings.segments
        self.gamma, self.decay = settings.gamma, settings.gamma * settings.trace_decay
        self.behind = 0.0  # what the last action was taken off
        self.value_limit = math.inf if settings.value_limit is None else settings.value_limit
        self.antecedents = settings.rate_centre > 0 or settings.rate_width > 0
        length = net.n_outputs - self.n - 1  # of the action vector
        rates = [settings.rate_state] * self.n + [settings.rate_action] * length
        rates += [settings.rate_constant]
        if self.antecedents:
            n = net.n_inputs
            rates = [settings.rate_centre] * n + [settings.rate_width] * n + rates
        self.rates = column(net, rates)
        self.replay_rates = self.rates[-net.n_outputs :]
        ends = [-1 + 2 * j / segments for j in range(segments + 1)]
        self.edges = list(pairwise(ends))
        middles = [(low + high) / 2 for low, high in self.edges]
        # Discrete actions and points begin and end at the ends of the range themselves.
        spread = [2 * j / max(segments - 1, 1) - 1.0 for j in range(segments)]
        self.representatives = spread if task.discrete or settings.points else middles
        if settings.points and not task.discrete:  # nothing is left to draw in a segment
            self.edges = [(a, a) for a in spread]
        self.choices = self.choices or tuple(f"{a:+.2f}" for a in self.representatives)
        codes = [self._code(j, a) for j, a in enumerate(self.representatives)]
        self.codes = self.rates.new_tensor(codes)  # (J, length)
        self.tails = torch.cat([self.codes, self.codes.new_ones(segments, 1)], 1)
        if settings.replays or settings.replay_every:
            self._remember({"features": net.n_outputs}, settings.memory)

    @classmethod
    def layout(cls, settings: QConfig, task: Task) -> Layout:
        """The state, for ``antecedent`` the action too; c_x, c_a and c of equation 9."""
        if not task.discrete and len(task.actions) != 1:
            raise ValueError(
                "Q-learning chooses among discrete actions or on one axis, "
                f"not {len(task.actions)} at once: use SGA"
            )
        if settings.coding == "wheels" and task.wheels is None:
            raise ValueError("--q.coding wheels is for a robot with two wheels")
        segments = [f"segment {j + 1}" for j in range(settings.segments)]
        actions = {
            "onehot": list(task.actions) if task.discrete else segments,
            "wheels": ["wheel left", "wheel right"],
        }.get(settings.coding, ["action"])
        names = [f"c {name}" for name in [*(axis.name for axis in task.axes), *actions]]
        outputs = [*map(Output, names), Output("c", settings.initial)]
        acting = settings.coding == "antecedent"
        return (*task.axes, *[ACTION] * acting), tuple(outputs)

    def act(self, observation: NDArray[Any], explore: float = 0) -> Action:
        """The greedy action, or one by roulette; learns nothing and adds no rule.

        Args:
            observation: the state. Shape: (n,).
            explore: 0 for the greedy action, 1 for the roulette, more for one that is as many
                times hotter.
        """
        x = self._tensor(observation)
        with torch.no_grad():
            values = self.action_values(x, self.net.normalised_firing(self.network_inputs(x)))
        if explore:
            return self._command(*self._draw(values.tolist(), explore))
        segment = int(values.argmax())
        return self._command(segment, self.representatives[segment])

    def conclusions(self, x: Tensor) -> tuple[list[str], NDArray[np.float64]]:
        """The value that each rule gives to each action (eq. 9): names (J,) and numbers (K, J).

        Args:
            x: where, one state for all rules or the inputs of one each. Inputs with an action have
                but one value, of that action. Shape: (n,), (K, n) or (K, n + 1).
        """
        consequents, n = self.net.consequents.double(), self.n
        if x.shape[-1] > n:
            features = torch.cat([x, x.new_ones(len(x), 1)], 1)
            return ["Q"], (self.net.consequents * features).sum(1, keepdim=True).double().numpy()
        of_state = (consequents[:, :n] * x).sum(1, keepdim=True)
        values = of_state + consequents[:, n:] @ self.tails.double().T
        return [f"Q {name}" for name in self.choices], values.numpy()

    def alone(self, conclusions: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """The action to which each rule gives the greatest value; -1 where several. Shape: (K,)."""
        if conclusions.shape[1] != self.segments:
            return None
        best = conclusions == conclusions.max(1, keepdims=True)
        return np.where(best.sum(1) > 1, -1, best.argmax(1))

    def action_values(self, x: Tensor, firing: Tensor) -> Tensor:
        """Q(x, a_j) of every segment (eq. 10).

        Args:
            x: state, or many. Shape: (n,) or (B, n).
            firing: normalised firing at ``network_inputs(x)``.

        Returns:
            Shape: (J,) or (B, J).
        """
        conclusions = firing @ self.net.consequents
        if self.coding != "antecedent":
            conclusions = conclusions.unsqueeze(-2)  # the same for every action
        features = torch.cat(self._beside(x, self.tails), -1)
        return (features * conclusions).sum(-1)

    def network_inputs(self, x: Tensor) -> Tensor:
        """Inputs of the network at states (.., n): these, or with every action (.., J, n + 1)."""
        if self.coding != "antecedent":
            return x
        return torch.cat(self._beside(x, self.codes), -1)

    def decoding(self) -> dict[str, Any]:
        """The outputs are c_x, c_a and c of equation 9; the greatest value chooses."""
        return {
            "kind": "values",
            "codes": self.codes.tolist(),
            "edges": [list(edge) for edge in self.edges],
            "representatives": self.representatives,
            "temperature": self.settings.temperature,
            "action_input": self.coding == "antecedent",
        }

    def _policy(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        inputs = self.network_inputs(x)
        firing = self.net.normalised_firing(inputs.reshape(-1, inputs.shape[-1]))
        values = self.action_values(x, firing.reshape(*inputs.shape[:-1], -1))
        value, best = values.max(1)
        return best, value

    def _firing(self, x: Tensor) -> Tensor:
        """Normalised firing at x: (K,), or (J, K) if the action is an antecedent."""
        if self.coding != "antecedent":
            return self.net.observe(x)
        inputs = self.network_inputs(x)
        if self.net.n_rules == 0:
            self.net.grow(inputs[self.segments // 2])
        with torch.no_grad():
            return self.net.normalised_firing(inputs)

    def _choose(self, x: Tensor, firing: Tensor) -> Action:
        """Draw an action (eq. 11) and add the gradient of its value to the traces."""
        net = self.net
        if self.antecedents:  # they may have moved since the firing was computed
            with torch.no_grad():
                firing = net.normalised_firing(self.network_inputs(x))
        values = self.action_values(x, firing).tolist()
        segment, inside = self._draw(values)
        scalar = self.representatives[segment] if self.task.discrete else inside
        # The paper draws the action inside the segment also where the robot only has three (step
        # 4.3): rules are about the number that was drawn.
        code = self._code(segment, inside if self.coding in ("scalar", "antecedent") else scalar)
        self.decision = [*x.tolist(), *code, 1.0]
        features = x.new_tensor(self.decision)
        if self.coding == "antecedent":
            x = features[: self.n + 1]
            firing = net.observe(x)
        parameters = consequents = net.learnable(self.antecedents)
        if self.antecedents:
            *antecedents, consequents = parameters.split_with_sizes(net.parts)
            firing = net.normalised_firing(x, antecedents)
        outputs = consequents @ firing
        self.value = (features @ outputs.detach()).item()
        best = max(values)
        self.behind = self.settings.action_gap * max(best - self.value, 0.0)
        greedy = values[segment] == best
        decay = self.decay if greedy or not self.settings.trace_cut else 0.0
        gradient = torch.autograd.grad(outputs, parameters, features)[0]  # of features . outputs
        net.accumulate(gradient, decay, self.settings.trace_limit)
        self._log["value"].append(self.value)
        self._log["greedy"].append(greedy)
        self._log["firing"].append(net.max_firing)
        return self._command(segment, scalar)

    def _error(self, reward: float, x: Tensor | None = None, firing: Tensor | None = None) -> float:
        """The temporal-difference error (eqs 12, 13)."""
        if x is None or firing is None:
            return reward - self.value - self.behind
        ahead = min(max(self.action_values(x, firing).tolist()), self.value_limit)
        return reward + self.gamma * ahead - self.value - self.behind

    def _learn(self, error: float) -> None:
        """Equations 14 and 15 for the temporal-difference error."""
        self._log["error"].append(error)
        self.net.adapt(self.rates, error)

    def _replay(self, memory: ReplayMemory, batches: int) -> None:
        """Equations 12-15 for batches of remembered decisions; the antecedents stay."""
        net, (features_of, firing_at) = self.net, self.net.firing_functions()
        gap, acting = self.settings.action_gap, self.coding == "antecedent"
        seen = memory.sample(batches, self.rng, self.rates)
        states = features_of(seen["features"][..., : net.n_inputs])
        next_states = features_of(self.network_inputs(seen["next_state"]))
        for x, next_x, *row in zip(states, next_states, *seen.values(), strict=True):
            features, reward, continues, next_state = row
            best = self.action_values(next_state, firing_at(next_x)).amax(-1)
            firing, consequents = firing_at(x), net.learnable(antecedents=False)
            value = (features.T * (consequents @ firing.T)).sum(0)
            target = reward + self.gamma * continues * best.clamp_(max=self.value_limit)
            if gap:
                state = features[:, : self.n]
                at = firing_at(features_of(self.network_inputs(state))) if acting else firing
                behind = self.action_values(state, at).amax(-1) - value.detach()
                target -= gap * behind.clamp_(min=0.0)
            (gradient,) = torch.autograd.grad(value, consequents, target - value.detach())
            net.adapt_batch(self.replay_rates, gradient, features.T.abs() @ firing)

    def _roulette(self, values: list[float], hotter: float = 1) -> int:
        """A segment drawn with the probabilities of equation 11."""
        best, temperature = max(values), self.settings.temperature * hotter
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
        if self.coding == "wheels" and self.task.wheels:
            return self.task.wheels(scalar)
        return [scalar]

    def _beside(self, x: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """States (.., n) and codes (J, c), repeated so that each stands beside each."""
        shape = (*x.shape[:-1], self.segments, -1)
        return x.unsqueeze(-2).expand(shape), codes.expand(shape)

    def _summary(self, log: dict[str, list[float]]) -> dict[str, float]:
        value = torch.tensor(log["value"])
        return {
            "policy/value_mean": value.mean().item(),
            "policy/value_max": value.max().item(),
            "policy/greedy_share": sum(log["greedy"]) / len(log["greedy"]),
        }

    def _command(self, segment: int, scalar: float) -> Action:
        return segment if self.task.discrete else np.array([scalar], np.float32)

    def _commands(self, found: NDArray[Any]) -> NDArray[Any]:
        if self.task.discrete:
            return found
        return np.array(self.representatives, np.float32)[found, None]
