"""Any Gymnasium environment as the package's loop needs it."""

import difflib
import functools
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs import registration
from gymnasium.spaces import Box, Discrete, Space
from numpy.typing import NDArray

from sofnn_torch.network.axes import Axis
from sofnn_torch.tasks.known import KNOWN, TUNED

MOST_INPUTS = 64  # rules that cover more inputs than this are as many as the states
MOST_ACTIONS = 1_000
ENDLESS = 1e6  # ends beyond are no ends: spaces say inf in many ways
LONGEST = 20_000  # steps of a trial, also where the environment sets no limit


@dataclass(frozen=True)
class Spaces:
    """What a learner must know of an environment.

    Attributes:
        axes: of the observation; without ends where its space has none.
        actions: names of the actions, or of the numbers that make one.
        discrete: one of the actions is chosen.
        reward_scale: so that values are about 1; None if the task is not known.
        best: the most, so scaled, that a state can be worth as far as is known.
        tuned: settings of Q-learning that differ from those for unknown tasks, by table.
    """

    axes: tuple[Axis, ...]
    actions: tuple[str, ...]
    discrete: bool
    reward_scale: float | None = None
    best: float = 1.0
    tuned: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


class Translation:
    """Observations of an environment as a learner takes them, and its actions for the environment.

    Args:
        shape: of an observation.
        acted: the space of the actions.
        axes: of the numbers of an observation, in their order.
    """

    def __init__(self, shape: Sequence[int], acted: Box | Discrete, axes: Sequence[Axis]):
        self.shape, self.acted = tuple(shape), acted
        free = [axis.period > 0 for axis in axes]
        self.low = np.where(free, -np.inf, [axis.low for axis in axes])
        self.high = np.where(free, np.inf, [axis.high for axis in axes])

    def states(self, observations: Any) -> NDArray[np.float32]:
        """The numbers of observations, at most at the ends of their axes. Shape: (.., n).

        Args:
            observations: one of the shape of the space, or many. Shape: (.., *shape).
        """
        numbers = np.asarray(observations, np.float64)
        many = numbers.shape[: numbers.ndim - len(self.shape)]
        return np.clip(numbers.reshape(*many, -1), self.low, self.high).astype(np.float32)

    def action(self, action: Any) -> Any:
        """The action of the environment that an action of a learner stands for."""
        space = self.acted
        if isinstance(space, Discrete):
            return space.start + space.dtype.type(action)
        share = (np.asarray(action, np.float64).reshape(space.shape) + 1) / 2
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        return np.clip(low + share * (high - low), low, high).astype(space.dtype)


class TaskEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """An environment with a vector as observation and actions in [-1, 1] or from 0 on.

    Observation, float32 (n,): the numbers of the inner one in their order, at most at the ends of
    their axes. Actions: Discrete(n) counts from 0; each number of a vector goes from -1 at the low
    end of its range to 1 at the high end. Rewards are those of the inner environment.

    Each trial begins from a seed of its own, made from that of the last seeded `reset` and the
    number of the trial since then: the state between two trials is these two numbers.

    Args:
        env: the environment to wrap.
        axes: of the observation, if not those of its space.

    Raises:
        ValueError: the observation or the action is of a kind that is not supported.

    Examples:
        >>> env = TaskEnv(gymnasium.make("Pendulum-v1"))
        >>> env.action_space, [axis.name for axis in env.axes][2]
        (Box(-1.0, 1.0, (1,), float32), 'angular velocity')
    """

    def __init__(self, env: gymnasium.Env, axes: Sequence[Axis] | None = None):
        found = spaces(env)
        self.env, self.metadata, self.render_mode = env, env.metadata, env.render_mode
        self.axes = tuple(axes or found.axes)
        self.action_names = found.actions
        if len(self.axes) != len(found.axes):
            raise ValueError(f"{len(found.axes)} inputs need as many axes, got {len(self.axes)}")
        shape = env.observation_space.shape or ()
        self.translation = Translation(shape, _actions(env.action_space), self.axes)
        low, high = self.translation.low, self.translation.high
        self.observation_space = Box(np.float32(low), np.float32(high))
        count = len(found.actions)
        self.action_space = Discrete(count) if found.discrete else Box(-1.0, 1.0, (count,))
        self.seed = int(np.random.SeedSequence().generate_state(1)[0])
        self.trial = self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next trial, or with a seed the first of a series."""
        self.seed, self.trial = (self.seed, self.trial + 1) if seed is None else (int(seed), 0)
        own = np.random.SeedSequence([self.seed, self.trial]).generate_state(1)[0]
        observation, info = self.env.reset(seed=int(own), options=options)
        self.steps = 0
        return self.translation.states(observation).ravel(), self._info(info)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take an action; return observation, reward, terminated, truncated, info.

        The info has ``total_steps``, and ``success`` where the environment says whether it was one.
        """
        chosen = self.translation.action(action)
        observation, reward, terminated, truncated, info = self.env.step(chosen)
        self.steps += 1
        truncated = bool(truncated) or (self.steps >= LONGEST and not terminated)
        state = self.translation.states(observation).ravel()
        return state, float(reward), bool(terminated), truncated, self._info(info)

    def measure(self, infos: Sequence[dict[str, Any]]) -> dict[str, float]:
        """What else is measured in a trial: nothing."""
        return {}

    def render(self) -> Any:
        """What the inner environment shows.

        Raises:
            ValueError: it needs a package for it that is not there.
        """
        try:
            return self.env.render()
        except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
            raise ValueError(f"pictures of this task need a package: {_line(error)}") from None

    def close(self) -> None:
        """Close the inner environment."""
        self.env.close()

    def state_dict(self) -> dict[str, Any]:
        """All that the next trials depend on."""
        return {"seed": self.seed, "trial": self.trial}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Counterpart of `state_dict`."""
        self.seed, self.trial = state["seed"], state["trial"]

    def _info(self, info: dict[str, Any]) -> dict[str, Any]:
        said = info.get("is_success", info.get("success"))
        more = {} if said is None else {"success": bool(said)}
        return info | more | {"total_steps": self.steps}


def make(
    env_id: str, axes: Sequence[Axis] | None = None, render_mode: str | None = None
) -> TaskEnv:
    """The environment of an id, wrapped.

    Args:
        env_id: as in `gymnasium.make`, also ``module:Id``.
        axes: of the observation, if not those of its space.
        render_mode: as in `gymnasium.make`.

    Raises:
        ValueError: there is none, it cannot be made here, or it is not supported.
    """
    try:
        env = gymnasium.make(env_id, render_mode=render_mode, disable_env_checker=True)
    except Exception as error:  # of the registry, of a missing package, or of the task itself
        reason = _line(error)
        if isinstance(error, gymnasium.error.UnregisteredEnv):
            near = difflib.get_close_matches(env_id, gymnasium.registry, 1)
            reason = "it is not registered" + (f"; did you mean {near[0]}?" if near else "")
        raise ValueError(f"{env_id!r} cannot be made: {reason}") from None
    return TaskEnv(env, axes)


@functools.cache
def versioned(env_id: str) -> str:
    """The id with its newest version where it names none, so that a run keeps its task.

    Ids that are not registered, or whose module cannot be imported, stay: `make` says why.
    """
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        namespace, plain, version = registration.parse_env_id(name)
        newest = registration.find_highest_version(namespace, plain)
    except Exception:  # of the registry, or of the module
        return env_id
    return env_id if version is not None or newest is None else f"{env_id}-v{newest}"


@functools.cache
def look(env_id: str) -> Spaces:
    """The spaces of an environment by its id; it is made for a moment, once.

    Raises:
        ValueError: as `make`.
    """
    env = make(env_id)
    env.close()
    return spaces(env.env)


def spaces(env: gymnasium.Env) -> Spaces:
    """The spaces of an environment, with the names of a known task.

    Raises:
        ValueError: one line on a kind of observation or action that is not supported.
    """
    observed, acted = _observations(env.observation_space), _actions(env.action_space)
    discrete = isinstance(acted, Discrete)
    number = int(acted.n) if isinstance(acted, Discrete) else acted.low.size
    spec = getattr(env, "spec", None)
    known = KNOWN.get(spec.name) if spec else None
    if spec and known and (len(known.axes), len(known.actions)) == (observed.low.size, number):
        own = known.reward_scale, known.best, TUNED.get(spec.name, {})
        return Spaces(known.axes, known.actions, discrete, *own)
    names = tuple(f"action {j + 1}" for j in range(number)) if number > 1 else ("action",)
    ends = zip(observed.low.ravel(), observed.high.ravel(), strict=True)
    pairs = [_ends(float(low), float(high)) for low, high in ends]
    axes = tuple(Axis(f"obs {i + 1}", "", low, high) for i, (low, high) in enumerate(pairs))
    return Spaces(axes, names, discrete)


def _observations(space: Space) -> Box:
    """The space of the observations, of a kind that is supported."""
    if not isinstance(space, Box):
        raise ValueError(f"observations must be a Box of numbers, not {type(space).__name__}")
    count = int(np.prod(space.shape))
    if space.dtype == np.uint8 or count > MOST_INPUTS:
        raise ValueError(
            f"observations of shape {space.shape} and type {space.dtype} are too many numbers for "
            f"fuzzy rules, which take 1 to {MOST_INPUTS}: reduce pictures to a few features first"
        )
    if count == 0:
        raise ValueError("observations have no numbers")
    return space


def _actions(space: Space) -> Box | Discrete:
    """The space of the actions, of a kind that is supported."""
    if isinstance(space, Discrete):
        if not 1 <= space.n <= MOST_ACTIONS:
            raise ValueError(
                f"at most {MOST_ACTIONS} discrete actions are supported, not {space.n}"
            )
        return space
    if not isinstance(space, Box) or np.prod(space.shape) == 0:
        raise ValueError(f"actions must be Discrete or a Box of numbers, not {space}")
    if not (space.is_bounded() and np.abs([space.low, space.high]).max() < ENDLESS):
        raise ValueError(f"actions must have a low and a high end, not {space}: bound them first")
    return space


def _ends(low: float, high: float) -> tuple[float, float]:
    return (low if abs(low) < ENDLESS else -np.inf), (high if abs(high) < ENDLESS else np.inf)


def _line(error: Exception) -> str:
    """What an exception says, as one line."""
    return " ".join(str(error).split()) or type(error).__name__
