"""What a run consists of: typed settings.

Every field is a flag of ``train.py``; the string under a field is its help text. The settings of
each part stand beside it: `sofnn_torch.network.settings`, `sofnn_torch.learners`,
`sofnn_torch.maze.settings`. Their values, where none are given, are those of a preset
(`sofnn_torch.runs.presets`), and `sofnn_torch.runs.factory` makes what they describe.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from sofnn_torch.bounds import NotNegative, Positive, Settings, Within, flag, read
from sofnn_torch.learners import learner_class
from sofnn_torch.learners.learner import Learner, Task
from sofnn_torch.learners.qlearning import QConfig
from sofnn_torch.learners.sga import SGAConfig
from sofnn_torch.maze.settings import MazeConfig
from sofnn_torch.maze.spaces import ACTION_NAMES, wheel_speeds
from sofnn_torch.network.axes import Axis, named
from sofnn_torch.network.settings import NetworkConfig
from sofnn_torch.runs import presets, rule_files
from sofnn_torch.tasks.env import look, versioned
from sofnn_torch.tasks.survey import survey

PRESET: Any = None  # as a default: the value of the preset
MAZE = "maze"
PATIENCE = 15  # decisions in the maze without a new state, after which a policy circles
BASIC = ("env", "agent", "network", "preset", "seed", "rules")  # on them all others depend
LARGEST_RULES = 2**19  # bytes; they are kept in config.json and in every checkpoint
Input = tuple[str, str, float, float, float]


@dataclass(frozen=True)
class Config(Settings):
    """Train a robot to find its way with a self-organizing fuzzy neural network.

    Without flags: stochastic gradient ascent on a growing network. Watch with
    ``tensorboard --logdir runs``.

    Examples:
        >>> Config(agent="q").maze.goal_reward
        100.0
    """

    env: str = MAZE
    """Task: `maze`, or the id of any environment that Gymnasium can make, as in `MountainCar-v0` or
    `module:Id`."""
    agent: str = "sga"
    """Learner: `sga`, stochastic gradient ascent (section 3), `q`, Q-learning (section 4), or
    `module:Class` of one's own."""
    network: Literal["sofnn", "fixed"] = "sofnn"
    """Network: growing (SOFNN) or a regular grid of fixed structure (FSFNN)."""
    pose: Literal["estimated", "true", "odometry"] = "estimated"
    """What the robot knows of its pose: dead reckoning from commands, the truth, or from its
    wheel encoders."""
    preset: Literal["default", "paper"] = "default"
    """Settings that the other flags change: what works best, or every number as printed."""
    seed: Annotated[int, Within(least=0)] = 0
    """Seed of every random number of the run."""
    trials: Annotated[int, Within(above=0)] = 200
    """Trials to learn for."""
    rules: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """Begin with the rules in this .json or .csv file, which are kept with the run; new rules then
    begin with what these conclude where they are made (docs/rules.md)."""
    rules_rate: NotNegative = 0.01
    """Factor of the learning rates of the rules that `--rules` gave; 0 keeps them as they are."""
    net: NetworkConfig = PRESET
    sga: SGAConfig = PRESET
    q: QConfig = PRESET
    maze: MazeConfig = PRESET
    axes: Annotated[tuple[Input, ...], tyro.conf.arg(metavar="NAME UNIT LOW HIGH PERIOD ...")] = ()
    """Inputs of a task other than the maze, all of them in their order: name, unit, both ends, and
    the period of one that wraps, or 0. By default those of its space; ends that it lacks are found
    by random play."""
    reward_scale: Positive = PRESET
    """Factor of the rewards of a task other than the maze before they are learned from; by default
    such that values are about 1."""
    own: Annotated[tuple[tuple[str, float], ...], tyro.conf.arg(metavar="NAME NUMBER ...")] = ()
    """Settings of a learner of one's own: names and numbers."""

    def __post_init__(self) -> None:
        """Take what is not given from the preset; ValueError names the flag and what is allowed."""
        if isinstance(self.own, Mapping):
            object.__setattr__(self, "own", tuple(self.own.items()))
        if isinstance(self.rules, Path):
            object.__setattr__(self, "rules", str(self.rules))
        if isinstance(self.rules, str) and self.rules and "\n" not in self.rules:
            object.__setattr__(self, "rules", _text(Path(self.rules)))
        if isinstance(self.env, str) and self.env != MAZE:
            object.__setattr__(self, "env", versioned(self.env))
        for name, value in self._preset().items():
            given = getattr(self, name)
            if given is PRESET or (name == "axes" and len(given) == 0):
                object.__setattr__(self, name, value)
        super().__post_init__()
        self._check_together()

    @classmethod
    def from_file(cls, path: Path | str, **changes: Any) -> "Config":
        """The settings in a file for ``train.py --settings`` (`sofnn_torch.runs.preset_files`).

        Raises:
            ValueError: one line on what is wrong in it.
        """
        from sofnn_torch.runs import preset_files  # which needs this class

        return preset_files.from_file(path, **changes)

    @property
    def learner(self) -> type[Learner]:
        """The class of the learner."""
        return learner_class(self.agent)

    @property
    def learner_settings(self) -> Any:
        """The settings of the learner."""
        table = self.learner.Settings.table
        if table in presets.TABLES:
            return getattr(self, table)
        return read(dict(self.own), self.learner.Settings, "own.")

    @property
    def task(self) -> Task:
        """What is learned."""
        if self.env == MAZE:
            kind = self.maze.actions
            names, discrete = ACTION_NAMES[kind], kind == "three"
            return Task(self.maze.axes, names, discrete, wheel_speeds, patience=PATIENCE)
        found, axes = look(self.env), named([Axis(*given) for given in self.axes])
        scale = self.reward_scale
        return Task(axes, found.actions, found.discrete, reward_scale=scale)

    def to_json(self) -> str:
        """The settings as readable JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    def idle(self) -> dict[str, str]:
        """Settings, or whole tables of them, that change nothing beside the others, and why."""
        used, elsewhere = self.learner.Settings.table, f"with --env {self.env}"
        tables = {"sga": SGAConfig.table, "q": QConfig.table}
        idle = {name: f"with --agent {self.agent}" for name in tables if tables[name] != used}
        if used in tables:
            idle |= {f"{used}.{name}": why for name, why in self.learner_settings.idle().items()}
            idle["own"] = f"with --agent {self.agent}"
        if not self.rules:
            idle["rules_rate"] = "without --rules"
        if self.task.discrete:
            why = "with --maze.actions three" if self.env == MAZE else elsewhere
            idle |= {"q.segments": why, "q.points": why}
        fixed, acting = self.network == "fixed", self._acting
        idle |= dict.fromkeys(
            ("axes", "reward_scale") if self.env == MAZE else ("maze", "pose"), elsewhere
        )
        reasons = (
            (self.env == MAZE, "width", elsewhere),
            (self.env != MAZE, "width_position width_heading", elsewhere),
            (not acting, "grid_action width_action", "without --q.coding antecedent"),
            (fixed, "theta growth interpolate", "with --network fixed"),
            (not fixed, "grid grid_action", "without --network fixed"),
        )
        for is_idle, names, why in reasons:
            idle |= {f"net.{name}": why for name in names.split() if is_idle}
        return idle

    @property
    def widths(self) -> list[float]:
        """Width of new membership functions on each input of the network, in its unit."""
        net, axes = self.net, self.task.axes
        if self.env != MAZE:
            return net.task_widths(axes, self._acting)
        widths = [net.width_heading if a.period else net.width_position for a in axes]
        return [*widths, net.width_action] if self._acting else widths

    @property
    def grid(self) -> tuple[int, ...]:
        """Rules along each input of the fixed network."""
        return self.net.along(len(self.task.axes), self._acting)

    def _preset(self) -> dict[str, Any]:
        """The values of what is not given."""
        agent, seed = str(self.agent), self.seed if np.issubdtype(type(self.seed), int) else 0
        if self.env == MAZE or not isinstance(self.env, str):
            tables = presets.tables(agent, self.network, self.preset)
            return (presets.careful(tables) if self.rules else tables) | {"reward_scale": 1.0}
        if self.preset == "paper":
            raise ValueError("--preset paper is for --env maze")
        try:
            found = (
                look(self.env)
                if self.axes and self.reward_scale
                else survey(self.env, abs(int(seed)))
            )
        except ValueError as error:
            raise ValueError(f"--env {error}") from None
        tables = presets.task_tables(agent, self.network, found)
        tables = presets.careful(tables) if self.rules else tables
        axes = tuple((a.name, a.unit, a.low, a.high, a.period) for a in found.axes)
        return tables | {"axes": axes, "reward_scale": found.reward_scale}

    @property
    def _acting(self) -> bool:
        """The action is one more input of the network."""
        inputs, _ = self.learner.layout(self.learner_settings, self.task)
        return len(inputs) > len(self.task.axes)

    def _check_axes(self) -> None:
        """Raise ValueError on axes that are none, or not those of the environment."""
        needed = len(look(self.env).axes)
        if len(self.axes) != needed:
            raise ValueError(
                f"--axes must name all {needed} inputs of {self.env}, got {len(self.axes)}"
            )
        try:
            named([Axis(*given) for given in self.axes])
        except ValueError as error:
            raise ValueError(f"--axes: {error}") from None

    def _check_together(self) -> None:
        """Raise ValueError on settings that exclude each other."""
        if self.env != MAZE:
            self._check_axes()
        settings = self.learner_settings
        reward = self.maze.goal_reward if self.env == MAZE else -math.inf
        if self.own and "own" in self.idle():
            raise ValueError(f"--own is for a learner of one's own, not for --agent {self.agent}")
        limit = None if "value_limit" in settings.idle() else getattr(settings, "value_limit", None)
        if limit is not None and limit < reward:
            raise ValueError(
                f"{flag(settings.table, 'value_limit')} {limit:g} must be at least "
                f"--maze.goal-reward {reward:g}, or None"
            )
        self.net.task_widths(self.task.axes)
        self._acting  # noqa: B018 - checks that the learner can do the task
        shape = self.grid if self.network == "fixed" else ()
        if math.prod(shape) > self.net.max_rules:
            raise ValueError(
                f"--net.grid {shape} has more rules than --net.max-rules {self.net.max_rules}"
            )


def why_idle(idle: Mapping[str, str], name: str) -> str | None:
    """Why a setting changes nothing, itself or all of its table; None if it does.

    Args:
        idle: as `Config.idle` says.
        name: of the setting, with that of its table.
    """
    return idle.get(name) or idle.get(name.partition(".")[0])


def _text(path: Path) -> str:
    """The text of a rule file, of several lines as a path never is.

    Raises:
        ValueError: naming the flag.
    """
    try:
        return rule_files.text(path, LARGEST_RULES).rstrip("\n") + "\n"
    except ValueError as error:
        raise ValueError(f"--rules {path}: {error}") from None


def from_dict(data: Any) -> Config:
    """Settings from plain data, as JSON or a checkpoint holds them.

    Entries that are not given take their default, so that files of older versions can be read.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    return read(data, Config)
