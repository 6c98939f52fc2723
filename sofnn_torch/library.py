"""A learner for an environment at hand: train, ask, evaluate, save and load it from Python.

import gymnasium
from sofnn_torch import QLearning

env = gymnasium.make("CartPole-v1")
agent = QLearning.for_env(env, seed=0)
agent.learn(env, trials=100)
"""

import dataclasses
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from tensorboard.compat.proto.summary_pb2 import Summary

from sofnn_torch.bounds import Count, Positive, Settings, Within, read
from sofnn_torch.evaluate import played
from sofnn_torch.learners import BUILT_IN, learner_class
from sofnn_torch.learners.learner import Learner, Task
from sofnn_torch.network.axes import Axis, named
from sofnn_torch.network.settings import NetworkConfig
from sofnn_torch.pictures.events import EventFile
from sofnn_torch.pictures.tensorboard import scalars
from sofnn_torch.progress import Progress
from sofnn_torch.runs import checkpoint, presets
from sofnn_torch.runs.checkpoint import CheckpointError
from sofnn_torch.runs.factory import assemble, least_width
from sofnn_torch.runs.seeding import stream
from sofnn_torch.runs.session import WINDOW, arithmetic
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.tasks.env import Spaces, TaskEnv, Translation, make, spaces
from sofnn_torch.tasks.survey import explored
from sofnn_torch.terminal import plural
from sofnn_torch.training import play, summary

Callback = Callable[[TrialRecord], object]


@dataclasses.dataclass(frozen=True)
class _Numbers(Settings):
    """Numbers that are given to an agent, checked as the flags are."""

    seed: Annotated[int, Within(least=0)] = 0
    trials: Count = 1
    reward_scale: Positive = 1.0


class Agent:
    """A learner and the spaces of its environment, as `QLearning.for_env` and others make it.

    It takes the environment's own observations, one or many, and gives the environment's own
    actions. What `learn` does is what ``train.py --env`` does, bit for bit.

    Attributes:
        learner: the learner, with its network in ``learner.net``.
        trials: that were learned from.
        total_steps: of these.

    Examples:
        >>> import gymnasium
        >>> from sofnn_torch import SGA
        >>> env = gymnasium.make("Pendulum-v1")
        >>> agent = SGA.for_env(env, seed=0)
        >>> observation, _ = env.reset(seed=0)
        >>> agent.start(observation) in env.action_space
        True
    """

    def __init__(self, learner: Learner, translation: Translation, config: dict[str, Any]):
        self.learner, self.translation, self.config = learner, translation, config
        self.trials = self.total_steps = 0
        self._recent: list[Any] = []
        self._reset = {"seed": stream("training", config["seed"]), "trial": 0}

    def __repr__(self) -> str:
        rules = plural(self.learner.net.n_rules, "rule")
        return f"Agent({self.config['agent']}, {plural(self.trials, 'trial')}, {rules})"

    # --------------------------------------------------------------------- learning in a loop

    def learn(
        self,
        env: Any,
        trials: int = 200,
        *,
        callback: Callback | None = None,
        tensorboard: str | os.PathLike[str] | None = None,
        quiet: bool = False,
    ) -> list[TrialRecord]:
        """Learn for some more trials; what each was like.

        Args:
            env: the environment, or its id.
            trials: to learn from.
            callback: called after each trial with its record; learning ends when it returns False.
            tensorboard: directory for curves; made if it is not there.
            quiet: no progress bar.

        Raises:
            ValueError: the environment has other spaces than the one that the agent was made for.
            Divergence: numbers diverged; train anew with smaller step sizes.
            OSError: the curves cannot be written.

        Examples:
            >>> from sofnn_torch import QLearning
            >>> agent = QLearning.for_env("CartPole-v1", seed=0)
            >>> records = agent.learn("CartPole-v1", trials=5, quiet=True)
            >>> [record.trial for record in records], agent.trials
            ([1, 2, 3, 4, 5], 5)
        """
        trials, task = _Numbers(trials=trials).trials, self._task(env)
        task.load_state_dict(self._reset)
        curves = None if tensorboard is None else _curves(Path(tensorboard), self.trials + 1)
        successes: deque[bool] = deque(maxlen=WINDOW)
        records: list[TrialRecord] = []
        progress = Progress("learning", trials, quiet=quiet)

        def seen(steps: int) -> None:
            progress.within(f"trial {self.trials + 1}: {steps:,} steps")

        try:
            with arithmetic():
                for _ in range(trials):
                    begin = time.perf_counter()
                    record, _ = play(task, self.learner, seen=seen)
                    seconds = time.perf_counter() - begin
                    record = self._advance(record, task.state_dict())
                    records.append(record)
                    speed = record.steps / seconds
                    progress.update(seconds=seconds, facts=summary(record, self._recent, speed))
                    if record.success is not None:
                        successes.append(record.success)
                    if curves:
                        values = scalars(record, successes, speed, self.learner.name)
                        curves.add(Summary(value=values), record.trial)
                        curves.flush()
                    if callback is not None and callback(record) is False:
                        break
        finally:
            progress.close()
            if curves:
                curves.close()
        return records

    def evaluate(
        self, env: Any, trials: int = 10, *, explore: bool = False, seed: int = 1000
    ) -> list[TrialRecord]:
        """Play trials without learning; the agent stays as it is.

        Args:
            env: the environment, or its id.
            trials: to play.
            explore: act as in learning, not by the mean or greedy action.
            seed: of the trials and of the policy's chance.

        Raises:
            ValueError: as `learn`, or nothing was learned yet.

        Examples:
            >>> from sofnn_torch import SGA
            >>> agent = SGA.for_env("CartPole-v1")
            >>> _ = agent.learn("CartPole-v1", trials=2, quiet=True)
            >>> [record.steps > 0 for record in agent.evaluate("CartPole-v1", trials=2)]
            [True, True]
        """
        given = _Numbers(trials=trials, seed=seed)
        self._check_learned()
        chance = self.learner.rng
        try:
            with arithmetic():
                task = self._task(env)
                return played(task, self.learner, given.trials, explore, given.seed, quiet=True)
        finally:
            self.learner.rng = chance

    # ------------------------------------------------------------------ in a loop of one's own

    def start(self, observation: Any) -> Any:
        """Begin a trial at an observation: the first action.

        Examples:
            >>> import gymnasium
            >>> from sofnn_torch import QLearning
            >>> env = gymnasium.make("CartPole-v1")
            >>> agent = QLearning.for_env(env)
            >>> observation, _ = env.reset(seed=0)
            >>> action = agent.start(observation)
            >>> while action is not None:
            ...     observation, reward, terminated, truncated, _ = env.step(action)
            ...     action = agent.step(reward, observation, terminated, truncated)
        """
        return self.translation.action(self.learner.start(self._one(observation)))

    def step(
        self, reward: float, observation: Any, terminated: bool, truncated: bool = False
    ) -> Any:
        """Learn from the reward of the last action; the next action, None at the end of a trial.

        Args:
            reward: of the last action.
            observation: to which it led.
            terminated: no state follows this one; its value is 0.
            truncated: the trial ends here, but the state has a future: its value counts.
        """
        state = self._one(observation)
        action = self.learner.step(float(reward), state, bool(terminated), bool(truncated))
        self.total_steps += 1
        if action is not None:
            return self.translation.action(action)
        self.trials += 1
        self.learner.statistics()  # those of the next trial start afresh, as in `learn`
        return None

    def act(self, observation: Any, explore: float = 0) -> Any:
        """What the learned policy does at an observation, or at each of many; learns nothing.

        Args:
            observation: as the environment gives it, or a batch of B. Shape: (B, ...).
            explore: 0 for the mean or greedy action, 1 as in learning, more for as many times more.

        Returns:
            An action for the environment, or B of them. Shape: (B,) for discrete actions, or
            (B, ...).

        Raises:
            ValueError: the observation has another shape or is not finite, or nothing was
                learned yet.

        Examples:
            >>> import numpy as np
            >>> from sofnn_torch import QLearning
            >>> agent = QLearning.for_env("CartPole-v1")
            >>> _ = agent.learn("CartPole-v1", trials=1, quiet=True)
            >>> int(agent.act(np.zeros(4))) in (0, 1), agent.act(np.zeros((3, 4))).shape
            (True, (3,))
            >>> agent.act(np.zeros(3))
            Traceback (most recent call last):
            ValueError: an observation of this agent has shape (4,), many have (B, 4), not (3,)
        """
        self._check_learned()
        states = self._states(observation)
        if states.ndim == 1:
            return self.translation.action(self.learner.act(states, explore))
        if explore:
            actions = [self.learner.act(state, explore) for state in states]
        else:
            actions = list(self.learner.plan(states).actions)
        acted = self.translation.acted
        shape = (len(actions), *(acted.shape or ()))
        chosen = [self.translation.action(action) for action in actions]
        return np.array(chosen, acted.dtype).reshape(shape)

    # --------------------------------------------------------------------------------- files

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all that the agent is to a file, in the format of checkpoints.

        The commands take the file as any checkpoint where the environment can be made by its id.

        Raises:
            OSError: it cannot be written; an older file of the name is as it was.

        Examples:
            >>> import tempfile
            >>> from sofnn_torch import SGA, Agent
            >>> agent = SGA.for_env("CartPole-v1")
            >>> _ = agent.learn("CartPole-v1", trials=1, quiet=True)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     agent.save(f"{folder}/pole.pt")
            ...     Agent.load(f"{folder}/pole.pt").trials
            1
        """
        state = {
            "config": self.config | {"trials": max(self.trials, 1)},
            "trial": self.trials,
            "total_steps": self.total_steps,
            "recent": self._recent,
            "best": [],
        }
        checkpoint.save(Path(path), state | checkpoint.snapshot(self.learner, self))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Agent":
        """The agent of a file that `save` wrote, or of a run in a task other than the maze.

        Args:
            path: the file, a run directory, or a checkpoint of one.

        Raises:
            CheckpointError: there is none that can be used; a ValueError of one line.
        """
        file = Path(path)
        if file.is_dir():
            file, state, _ = checkpoint.find_latest(file)
        else:
            state = checkpoint.load(file)
        config = state["config"]
        if config.get("env") == MAZE:
            raise CheckpointError(f"{path}: a run in the maze; sofnn_torch.load reads it")
        try:
            found, translation = _stored(config, state["env"])
            agent = cls(_made(config, found), translation, config)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise CheckpointError(f"{path}: not an agent of this version ({reason})") from None
        state["env"] = agent.state_dict() | state["env"]  # that of a run has no spaces
        checkpoint.restore(file, state, agent.learner, agent)
        agent.trials, agent.total_steps = state["trial"], state["total_steps"]
        agent._recent = state["recent"]
        return agent

    def state_dict(self) -> dict[str, Any]:
        """What is stored of the environment: its spaces, and the seed and number of the trial."""
        return self._reset | {"shape": list(self.translation.shape), "acted": self._acted()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Counterpart of `state_dict`; the spaces are those that the agent was made with."""
        self._reset = {name: int(state[name]) for name in ("seed", "trial")}

    # ------------------------------------------------------------------------------- the parts

    def _task(self, env: Any) -> TaskEnv:
        """The environment, if it is of the kind that the agent was made for."""
        axes = self.learner.task.axes
        task = make(env, axes) if isinstance(env, str) else TaskEnv(env, axes)
        ours, theirs = self.translation, task.translation
        for what, mine, other in (
            ("observations of shape", ours.shape, theirs.shape),
            ("actions in", ours.acted, theirs.acted),
        ):
            if mine != other:
                raise ValueError(f"this agent was made for {what} {mine}, not {other}")
        return task

    def _advance(self, record: TrialRecord, reset: dict[str, int]) -> TrialRecord:
        """Count a trial that was learned from; its record with these numbers."""
        self.trials, self.total_steps = self.trials + 1, self.total_steps + record.steps
        self._recent = [*self._recent, [record.outcome, record.steps]][-WINDOW:]
        self._reset = reset
        return dataclasses.replace(record, trial=self.trials, total_steps=self.total_steps)

    def _states(self, observation: Any) -> NDArray[np.float32]:
        """The states of an observation (n,) or of many (B, n)."""
        shape, given = self.translation.shape, np.shape(observation)
        if shape not in (given, given[1:]) or (given and len(given) > len(shape) + 1):
            many = f"({', '.join(['B', *map(str, shape)])})"
            raise ValueError(
                f"an observation of this agent has shape {shape}, many have {many}, not {given}"
            )
        states = self.translation.states(observation)
        if not np.isfinite(states).all():
            raise ValueError("an observation has numbers that are not finite")
        return states

    def _one(self, observation: Any) -> NDArray[np.float32]:
        states = self._states(observation)
        if states.ndim > 1:
            raise ValueError("learning takes one observation at a time, not a batch")
        return states

    def _acted(self) -> dict[str, Any]:
        """The space of the actions in plain data."""
        space = self.translation.acted
        names = {"names": list(self.learner.task.actions)}
        if isinstance(space, Discrete):
            return names | {"n": int(space.n), "start": int(space.start)}
        ends = {"low": space.low.tolist(), "high": space.high.tolist()}
        return names | ends | {"dtype": str(space.dtype)}

    def _check_learned(self) -> None:
        if self.learner.net.n_rules == 0:
            raise ValueError("no rule has been learned yet: learn for a trial first")


def for_env(
    learner: type[Learner],
    env: Any,
    seed: int = 0,
    *,
    network: str = "sofnn",
    axes: Sequence[Axis] = (),
    reward_scale: float | None = None,
    net: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Agent:
    """An agent of a class of learners, see `Learner.for_env`."""
    env = make(env).env if isinstance(env, str) else env
    name = next((n for n, c in BUILT_IN.items() if c is learner), "")
    name = name or f"{learner.__module__}:{learner.__qualname__}"
    given = _Numbers(seed=seed, reward_scale=1.0 if reward_scale is None else reward_scale)
    scale = None if reward_scale is None else given.reward_scale
    found = _found(env, given.seed, axes, scale)
    tables = presets.task_tables(name, network, found)
    tables["net"] = dataclasses.replace(tables["net"], **(net or {}))
    own: dict[str, Any] = {}
    if (table := learner.Settings.table) in tables:
        tables[table] = dataclasses.replace(tables[table], **settings)
    else:
        own = settings
    spec = getattr(env, "spec", None)
    values = {
        "env": spec.id if spec else f"{type(env).__module__}:{type(env).__qualname__}",
        "agent": name,
        "network": network,
        "seed": given.seed,
        "axes": [dataclasses.astuple(axis) for axis in found.axes],
        "reward_scale": found.reward_scale,
        "own": tuple(own.items()),
    }
    defaults = {field.name: field.default for field in dataclasses.fields(Config)}
    plain = {part: dataclasses.asdict(settings) for part, settings in tables.items()}
    config = defaults | plain | values
    translation = Translation(env.observation_space.shape, env.action_space, found.axes)
    return Agent(_made(config, found), translation, config)


def _found(env: Any, seed: int, axes: Sequence[Axis], scale: float | None) -> Spaces:
    """The spaces of an environment with all ends and a scale, if need be by random play."""
    found = spaces(env)
    if len(axes) not in (0, len(found.axes)):
        raise ValueError(f"{len(found.axes)} inputs need as many axes, got {len(axes)}")
    found = dataclasses.replace(found, axes=named(axes or found.axes))
    if scale is not None:
        found = dataclasses.replace(found, reward_scale=scale)
    if found.reward_scale is not None and all(axis.bounded for axis in found.axes):
        return found
    if not hasattr(env, "step"):
        raise ValueError("without an environment to play in, give axes with ends and reward_scale")
    seen = explored(TaskEnv(env), found, seed)
    return seen if scale is None else dataclasses.replace(seen, reward_scale=scale)


def _made(config: dict[str, Any], found: Spaces) -> Learner:
    """The learner of settings as plain data."""
    learner = learner_class(config["agent"])
    table = learner.Settings.table
    own = table not in presets.TABLES
    settings = read(dict(config["own"]) if own else config[table], learner.Settings, f"{table}.")
    net = read(config["net"], NetworkConfig, "net.")
    task = Task(
        named(found.axes),
        found.actions,
        found.discrete,
        reward_scale=config["reward_scale"],
    )
    inputs, _ = learner.layout(settings, task)
    acting = len(inputs) > len(task.axes)
    widths = net.task_widths(task.axes, acting)
    along = net.along(len(task.axes), acting) if config["network"] == "fixed" else None
    least = least_width(widths)
    return assemble(learner, task, settings, net, widths, along, config["seed"], least)


def _stored(config: dict[str, Any], env: dict[str, Any]) -> tuple[Spaces, Translation]:
    """Spaces from the file of an agent, or those of the environment by its id."""
    axes = tuple(Axis(*given) for given in config["axes"])
    if "acted" not in env:
        task = make(config["env"], axes)
        task.close()
        found = spaces(task.env)
        return dataclasses.replace(found, axes=axes), task.translation
    stored = env["acted"]
    acted: Box | Discrete
    if "n" in stored:
        acted = Discrete(stored["n"], start=stored["start"])
    else:
        dtype = np.dtype(stored["dtype"]).type
        acted = Box(np.array(stored["low"], dtype), np.array(stored["high"], dtype), dtype=dtype)
    found = Spaces(axes, tuple(stored["names"]), isinstance(acted, Discrete))
    return found, Translation(env["shape"], acted, axes)


def _curves(directory: Path, trial: int) -> EventFile:
    directory.mkdir(parents=True, exist_ok=True)
    return EventFile(directory, trial)
