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
from typing import Annotated, Any, Literal

import tyro

from sofnn_torch.bounds import Settings, Within, flag, read
from sofnn_torch.learners import learner_class
from sofnn_torch.learners.learner import Learner, Task
from sofnn_torch.learners.qlearning import QConfig
from sofnn_torch.learners.sga import SGAConfig
from sofnn_torch.maze.odometry import wheel_speeds
from sofnn_torch.maze.settings import ACTION_NAMES, POSE, MazeConfig
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.settings import NetworkConfig
from sofnn_torch.runs import presets

PRESET: Any = None  # as a default: the value of the preset


@dataclass(frozen=True)
class Config(Settings):
    """Train a robot to find its way with a self-organizing fuzzy neural network.

    Without flags: stochastic gradient ascent on a growing network. Watch with
    ``tensorboard --logdir runs``.

    Example:
        >>> Config(agent="q").maze.goal_reward
        100.0
    """

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
    net: NetworkConfig = PRESET
    sga: SGAConfig = PRESET
    q: QConfig = PRESET
    maze: MazeConfig = PRESET
    own: Annotated[tuple[tuple[str, float], ...], tyro.conf.arg(metavar="NAME NUMBER ...")] = ()
    """Settings of a learner of one's own: names and numbers."""

    def __post_init__(self) -> None:
        """Take what is not given from the preset; ValueError names the flag and what is allowed."""
        if isinstance(self.own, Mapping):
            object.__setattr__(self, "own", tuple(self.own.items()))
        missing = [name for name in presets.TABLES if getattr(self, name) is PRESET]
        if missing:
            tables = presets.tables(str(self.agent), self.network, self.preset)
            for name in missing:
                object.__setattr__(self, name, tables[name])
        super().__post_init__()
        self._check_together()

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
        """What the robot learns."""
        kind = self.maze.actions
        return Task(POSE, ACTION_NAMES[kind], kind == "three", wheel_speeds)

    def to_json(self) -> str:
        """The settings as readable JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    def idle(self) -> dict[str, str]:
        """Settings, or whole tables of them, that change nothing beside the others, and why."""
        used = self.learner.Settings.table
        tables = {"sga": SGAConfig.table, "q": QConfig.table}
        idle = {name: f"with --agent {self.agent}" for name in tables if tables[name] != used}
        if used in tables:
            idle |= {f"{used}.{name}": why for name, why in self.learner_settings.idle().items()}
            idle["own"] = f"with --agent {self.agent}"
        if self.maze.actions == "three":
            idle["q.segments"] = "with --maze.actions three"
        fixed, acting = self.network == "fixed", len(self._inputs) > len(POSE)
        reasons = (
            (not acting, "grid_action width_action", "without --q.coding antecedent"),
            (fixed, "theta growth interpolate", "with --network fixed"),
            (not fixed, "grid grid_action", "without --network fixed"),
        )
        for is_idle, names, why in reasons:
            idle |= {f"net.{name}": why for name in names.split() if is_idle}
        return idle

    @property
    def _inputs(self) -> tuple[Axis, ...]:
        return self.learner.layout(self.learner_settings, self.task)[0]

    def _check_together(self) -> None:
        """Raise ValueError on settings that exclude each other."""
        settings, reward = self.learner_settings, self.maze.goal_reward
        if self.own and "own" in self.idle():
            raise ValueError(f"--own is for a learner of one's own, not for --agent {self.agent}")
        limit = None if "value_limit" in settings.idle() else getattr(settings, "value_limit", None)
        if limit is not None and limit < reward:
            raise ValueError(
                f"{flag(settings.table, 'value_limit')} {limit:g} must be at least "
                f"--maze.goal-reward {reward:g}, or None"
            )
        inputs = self._inputs
        if self.network == "fixed":
            shape = (*self.net.grid, self.net.grid_action)[: len(inputs)]
            if math.prod(shape) > self.net.max_rules:
                raise ValueError(
                    f"--net.grid {shape} has more rules than --net.max-rules {self.net.max_rules}"
                )


def from_dict(data: Any) -> Config:
    """Settings from plain data, as JSON or a checkpoint holds them.

    Entries that are not given take their default, so that files of older versions can be read.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    return read(data, Config)
