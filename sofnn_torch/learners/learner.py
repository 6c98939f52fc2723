"""What every learner is: one decision after another, on one network, for one task.

SGA and Q-learning differ in how they choose an action and in the error that they learn from. All
else stands here once: the order of a decision, memory, chance, state, and what evaluation, rules,
pictures and studies ask of a learner.
"""

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sofnn_torch.bounds import Settings
from sofnn_torch.learners.memory import BATCH, ReplayMemory
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN

if TYPE_CHECKING:
    from sofnn_torch.library import Agent

CHUNK = 512  # states at a time: memory stays near CHUNK x rules numbers

Action = int | NDArray[np.float32]
Layout = tuple[tuple[Axis, ...], tuple["Output", ...]]


@dataclass(frozen=True)
class Task:
    """What is learned: the axes of the state, and the actions.

    Args:
        axes: of the n numbers of a state.
        actions: names of the actions to choose among, or of the numbers that make an action.
        discrete: choose one of the actions; otherwise each is a number in [-1, 1].
        wheels: wheel speeds of a scalar action of a robot, over the fastest (for the coding
            ``wheels`` of Q-learning).
        reward_scale: factor of each reward before it is learned from; values are in its unit.
        patience: decisions in a row without a new state after which a policy that does not learn
            is taken to run in a circle; inf for never.

    Raises:
        ValueError: patience has an end and an axis has none: what is a new state then?

    Examples:
        >>> from sofnn_torch.network.axes import Axis
        >>> Task((Axis("speed", "m/s", 0, 2),), ("brake", "drive"), discrete=True).patience
        inf
    """

    axes: tuple[Axis, ...]
    actions: tuple[str, ...]
    discrete: bool
    wheels: Callable[[float], list[float]] | None = None
    reward_scale: float = 1.0
    patience: float = math.inf

    def __post_init__(self) -> None:
        """Check that states can be compared where they must be."""
        if self.patience < math.inf and not all(axis.bounded for axis in self.axes):
            raise ValueError("patience needs axes with a low and a high end")


@dataclass(frozen=True)
class Output:
    """One consequent of every rule.

    Args:
        name: as in words and rule files.
        initial: of a new rule.
        low: the least value that learning leaves it.
        high: the greatest.
        interpolates: a network that interpolates gives a new rule its present output instead.

    Examples:
        >>> Output("sigma", initial=0.3, low=0.1, high=1.0).name
        'sigma'
    """

    name: str
    initial: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    interpolates: bool = True


@dataclass(frozen=True)
class Plan:
    """What a learner would do at B states, without exploration.

    Attributes:
        actions: as `Learner.act` gives them: numbers of the actions (B,), or vectors (B, m).
        choice: number of the action among `Learner.choices`; None without choices. Shape: (B,).
        value: what the learner expects from there; None if it keeps no value. Shape: (B,).

    Examples:
        >>> import torch
        >>> from sofnn_torch import SGA, SGAConfig, SOFNN
        >>> task = Task((Axis("angle"),), ("push",), discrete=False)
        >>> net = SOFNN(1, 3, width=0.2, initial=[0.0, 0.3, 0.65])
        >>> agent = SGA(net, task, SGAConfig())
        >>> _ = agent.start(np.zeros(1))
        >>> agent.plan(np.zeros((5, 1))).actions.shape
        (5, 1)
    """

    actions: NDArray[Any]
    choice: NDArray[np.int64] | None
    value: NDArray[np.float64] | None


class Learner(ABC):
    """A learner on a fuzzy network.

    The calling loop, of a simulator or of a robot:

        action = learner.start(observation)
        while action is not None:
            observation, reward, terminated, truncated, _ = env.step(action)
            action = learner.step(reward, observation, terminated, truncated)

    A learner of one's own has settings, a `layout`, and the four methods `_choose`, `_error`,
    `_learn` and `_policy`, and `act`. Where ``agent`` is ``module:Class``, everything finds it.

    Attributes:
        name: what settings call it.
        greedy: what its actions without exploration are called.
        Settings: class of its settings.
        choices: names of the actions that it chooses among; none if actions are vectors.
        value: what it expected at the last decision.

    Args:
        net: the network, as `layout` says.
        task: what is learned.
        settings: an object of the class `Settings`.
        seed: of its chance.

    Raises:
        ValueError: the network has other inputs or outputs than the layout.

    Examples:
        >>> from sofnn_torch import SGA
        >>> learner = SGA.for_env("Pendulum-v1", seed=0).learner
        >>> action = learner.start(np.array([1.0, 0.0, 0.0]))
        >>> learner.step(-0.1, np.array([0.9, 0.4, 1.0]), terminated=False).shape
        (1,)
    """

    name: ClassVar[str]
    greedy: ClassVar[str] = "greedy"
    Settings: ClassVar[type[Settings]]

    def __init__(self, net: SOFNN, task: Task, settings: Any, seed: int = 0):
        self.inputs, self.outputs = self.layout(settings, task)
        wanted, found = (len(self.inputs), len(self.outputs)), (net.n_inputs, net.n_outputs)
        if wanted != found:
            raise ValueError(
                f"{type(self).__name__} needs a network with {wanted[0]} inputs and {wanted[1]} "
                f"outputs, this one has {found[0]} and {found[1]}"
            )
        self.net, self.task, self.settings = net, task, settings
        self.choices: tuple[str, ...] = task.actions if task.discrete else ()
        self.memory: ReplayMemory | None = None
        self.decision: list[float] = []  # what the memory keeps of the last decision
        self.value = 0.0
        self._log: dict[str, list[float]] = defaultdict(list)
        self.reseed(seed)

    @classmethod
    def for_env(cls, env: Any, seed: int = 0, **options: Any) -> "Agent":
        """A learner for an environment: sizes and scales come from its spaces.

        Args:
            env: a Gymnasium environment, its id, or anything that has its spaces.
            seed: of the agent's chance, and of the trials of `learn`.
            **options: settings of the learner by name, and ``network``: ``sofnn`` or ``fixed``;
                ``net``: settings of the network by name; ``axes``: of all inputs in their order;
                ``reward_scale``. Where axes have no ends, or nothing is known of the rewards, 2,000
                steps of random play in the environment say both.

        Raises:
            ValueError: spaces or settings that are not supported.

        Examples:
            >>> from sofnn_torch import QLearning
            >>> agent = QLearning.for_env("CartPole-v1", seed=0, temperature=0.01)
            >>> agent.learner.task.actions
            ('push left', 'push right')
        """
        from sofnn_torch.library import for_env

        return for_env(cls, env, seed, **options)

    # ------------------------------------------------------------------------------- learning

    def start(self, observation: NDArray[Any]) -> Action:
        """Begin a trial at the observation (n,): clear the traces, choose the first action."""
        self.net.traces.zero_()
        if self.memory:
            self._learn_again(self.settings.replays)
        x = self._tensor(observation)
        return self._choose(x, self._firing(x))

    def step(
        self,
        reward: float,
        observation: NDArray[Any],
        terminated: bool,
        truncated: bool = False,
    ) -> Action | None:
        """Learn from the reward of the last action, then choose the next (None at the end).

        Args:
            reward: reward of the last action.
            observation: the state that it led to. Shape: (n,).
            terminated: no state follows this one; its value is 0.
            truncated: the trial ends here, but not the robot's way: the value of the state counts.
        """
        reward = reward * self.task.reward_scale
        if self.memory is not None:
            self.memory.add([*self.decision, reward, not terminated, *observation.tolist()])
        x = None if terminated else self._tensor(observation)
        firing = None if x is None else self._firing(x)
        self._learn(self._error(reward, x, firing))
        if self.memory and (every := self.settings.replay_every):
            self._learn_again(int(self.memory.count % every == 0))
        if x is None or firing is None or truncated:
            return None
        return self._choose(x, firing)

    @abstractmethod
    def act(self, observation: NDArray[Any], explore: float = 0) -> Action:
        """What the learned policy does; learns nothing and adds no rule.

        Args:
            observation: the state. Shape: (n,).
            explore: 0 for none, 1 as in learning, more for as many times more.
        """

    @classmethod
    @abstractmethod
    def layout(cls, settings: Any, task: Task) -> Layout:
        """Axes of the network's inputs, the first of them those of the state, and its outputs.

        Raises:
            ValueError: the settings do not go with the task.
        """

    @abstractmethod
    def _choose(self, x: Tensor, firing: Tensor) -> Action:
        """Choose an action at the state x (n,) and prepare to learn from its reward."""

    @abstractmethod
    def _error(self, reward: float, x: Tensor | None = None, firing: Tensor | None = None) -> float:
        """The error of a decision: its reward and the state after it; no state at the end."""

    @abstractmethod
    def _learn(self, error: float) -> None:
        """Take a step for the error of the last decision."""

    @abstractmethod
    def _policy(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """At states (B, n): actions (B, m), or numbers among `choices` (B,), and values (B,)."""

    def _replay(self, memory: ReplayMemory, batches: int) -> None:  # noqa: B027, not all do
        """Learn again from batches of remembered decisions; the antecedents stay."""

    def _learn_again(self, batches: int) -> None:
        """Replay so many batches, and count what they hold."""
        if self.memory and batches:
            self._replay(self.memory, batches)
            self._log["replayed"].append(batches * BATCH)

    def _firing(self, x: Tensor) -> Tensor:
        """Let the network grow at a state (n,); its normalised firing there."""
        return self.net.observe(x)

    # ------------------------------------------------------------------------------ questions

    @torch.no_grad()
    def plan(self, states: NDArray[Any]) -> Plan:
        """What the learner would do at states (B, n); nothing is learned and nothing drawn."""
        x = self._tensor(np.asarray(states))
        actions, values = zip(*map(self._policy, x.tensor_split(1 + len(x) // CHUNK)), strict=True)
        found = torch.cat(actions).numpy()
        value = None if values[0] is None else torch.cat(values).double().numpy()
        return Plan(self._commands(found), found if self.choices else None, value)

    @torch.no_grad()
    def firing(self, observation: NDArray[Any]) -> Tensor:
        """Normalised firing at a state (n,): a row, or one for each action. Shape: (.., K)."""
        inputs = self.network_inputs(self._tensor(observation))
        return self.net.normalised_firing(inputs.reshape(-1, inputs.shape[-1]))

    def strongest_rule(self, observation: NDArray[Any]) -> int:
        """The rule that fires most at the state (n,)."""
        return int(self.firing(observation).argmax()) % self.net.n_rules

    @torch.no_grad()
    def usage(self, states: NDArray[Any]) -> NDArray[np.float64]:
        """Mean normalised firing of each rule (K,) along a trial, from its states (T, n)."""
        inputs = self.network_inputs(self._tensor(np.asarray(states))).reshape(-1, len(self.inputs))
        parts = inputs.split(CHUNK)
        none = inputs.new_zeros(self.net.n_rules)
        total = sum((self.net.normalised_firing(part).sum(0) for part in parts), none)
        return (total / len(inputs)).double().numpy()

    def conclusions(self, x: Tensor) -> tuple[list[str], NDArray[np.float64]]:
        """What each rule concludes by itself: names (c,) and numbers (K, c).

        Args:
            x: where, one state for all rules or the inputs of one each. Shape: (n,) or (K, n).
        """
        return [output.name for output in self.outputs], self.net.consequents.double().numpy()

    def alone(self, conclusions: NDArray[np.float64]) -> NDArray[np.int64] | None:
        """The action that each rule would choose by its `conclusions` (K, c) alone. Shape: (K,).

        None where actions are vectors, or each rule is about one action; -1 for a rule that is
        undecided.
        """
        return None

    def margins(self, conclusions: NDArray[np.float64], chosen: int) -> NDArray[np.float64]:
        """How far each rule by its `conclusions` (K, c) is from another choice. Shape: (K,).

        Above 0 a rule is for the chosen action: here by its value over that of the best other one.
        """
        return conclusions[:, chosen] - np.delete(conclusions, chosen, 1).max(1)

    def network_inputs(self, x: Tensor) -> Tensor:
        """Inputs of the network at states (.., n): these, or with every action (.., J, n + 1)."""
        return x

    def decoding(self) -> dict[str, Any]:
        """How outputs of the network become an action, as plain data (docs/export.md).

        Raises:
            ValueError: the learner does not say it, and its policy cannot leave Python.
        """
        raise ValueError(f"a policy of --agent {self.name} cannot be exported: it has no decoding")

    def statistics(self) -> dict[str, float]:
        """Means over the decisions since the last call (docs/metrics.md); starts afresh."""
        log, self._log = self._log, defaultdict(list)
        if not log["firing"]:
            return {}
        error = torch.tensor(log["error"] or [0.0])
        return (
            self._summary(log)
            | {"learning/error_rms": error.square().mean().sqrt().item()}
            | {"learning/replayed": sum(log["replayed"])}
            | self.net.statistics(log["firing"])
        )

    def _summary(self, log: dict[str, list[float]]) -> dict[str, float]:
        """The learner's own part of the `statistics`, from what it logged."""
        return {}

    # ------------------------------------------------------------------------- chance and state

    def reseed(self, seed: int | np.random.SeedSequence) -> None:
        """Begin the learner's chance anew."""
        self.rng = np.random.default_rng(seed)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future depends on, as tensors, numbers and text."""
        state = {
            "net": self.net.state_dict(),
            "rng": self.rng.bit_generator.state,
            "value": self.value,
        }
        return state if self.memory is None else state | {"memory": self.memory.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Counterpart of `state_dict`; a fresh learner takes the size of the stored network."""
        self.net.load_state_dict(state["net"])
        self.rng.bit_generator.state = state["rng"]
        self.value = state["value"]
        if self.memory is not None:
            self.memory.load_state_dict(state["memory"])

    def _remember(self, fields: dict[str, int], capacity: int) -> None:
        """Keep a memory of decisions with these fields, and what they led to.

        Settings ``replays`` and ``replay_every`` say when `_replay` learns from it.
        """
        dtype = self.net.default_width.cpu().numpy().dtype
        after = {"reward": 0, "continues": 0, "next_state": len(self.task.axes)}
        self.memory = ReplayMemory(fields | after, capacity, dtype)

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(values).to(self.net.default_width)

    def _commands(self, found: NDArray[Any]) -> NDArray[Any]:
        """Actions for the environment from what `_policy` found."""
        return found


def column(net: SOFNN, rates: list[float]) -> Tensor:
    """Learning rates, one for each row of the network's table. Shape: (rows, 1)."""
    return net.default_width.new_tensor(rates)[:, None]
