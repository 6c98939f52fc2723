"""What a run consists of: typed settings.

Every field is a flag of ``train.py``; the string under a field is its help text. The settings of
the learners are beside them in `sofnn_torch.learners`, the presets in `sofnn_torch.runs.presets`,
and what is made from settings in `sofnn_torch.runs.factory`.
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from sofnn_torch.learners.qlearning import QConfig
from sofnn_torch.learners.sga import SGAConfig
from sofnn_torch.network.sofnn import Growth
from sofnn_torch.runs import validation


@dataclass(frozen=True)
class NetworkConfig:
    """Section 2: the fuzzy network."""

    theta: float = 0.4
    """Growth threshold theta_th of eq. 3: a rule is added where firing stays below it."""
    growth: Growth = "rule"
    """Reading of eq. 3; `frozen` never adds a rule."""
    width_position: float = 0.06
    """Width v of new membership functions on x and y, in metres."""
    width_heading: float = 0.45
    """Width v of new membership functions on the heading, in radians."""
    width_action: float = 0.3
    """Width v on the action, where the action is an antecedent (`--q.coding antecedent`)."""
    interpolate: bool = False
    """A new rule takes over the policy that the network had there (SGA), or the action values
    (Q-learning), instead of the initial ones."""
    grid: tuple[int, int, int] = (12, 12, 8)
    """Rules along x, y and heading of the fixed network (12 12 8 and 24 24 16 in the paper)."""
    grid_action: int = 8
    """Rules along the action of the fixed network, where the action is an antecedent."""
    max_rules: Annotated[int, tyro.conf.arg(aliases=["--max-rules"])] = 50_000
    """Hard limit; beyond it no rule is added and a warning is shown."""


@dataclass(frozen=True)
class MazeConfig:
    """Section 5: robot and maze."""

    hold: int = 10
    """Steps that an action is held unless the robot bumps."""
    max_steps: int = 20_000
    """Steps after which a trial ends without the goal."""
    motor_noise: float = 0.1
    """Motor noise; 0.1 multiplies the forward speed by U(0.9, 1.1) in each step."""
    wheel_noise: Literal["common", "independent"] = "common"
    """One factor for the forward and one for the turning part, or one for each wheel."""
    dead_reckoning: Literal["guarded", "still", "literal"] = "guarded"
    """`guarded`: slides along a wall on a bump, inside the arena, reset at every pass of a sub-goal
    or the start; `still`: the same, but no advance on a bump; `literal`: the paper's."""
    goal_reward: float = 1.0
    """Reward at the goal."""
    collision_reward: float = -1e-4
    """Reward of a bump."""
    subgoal_reward: float = 0.0
    """Reward of a sub-goal, once per trial."""
    step_reward: float = 0.0
    """Reward of every decision."""
    wheel_radius_scale: float = 1.0
    """Miscalibration: the wheel radius that the robot believes in over the true one."""
    wheel_base_scale: float = 1.0
    """Miscalibration: the wheel base that the robot believes in over the true one."""


@dataclass(frozen=True)
class Config:
    """Train a robot to find its way with a self-organizing fuzzy neural network.

    Without flags: stochastic gradient ascent on a growing network. Watch with
    ``tensorboard --logdir runs``.
    """

    agent: Literal["sga", "q"] = "sga"
    """Learner: stochastic gradient ascent (section 3) or Q-learning (section 4)."""
    network: Literal["sofnn", "fixed"] = "sofnn"
    """Network: growing (SOFNN) or a regular grid of fixed structure (FSFNN)."""
    pose: Literal["estimated", "true", "odometry"] = "estimated"
    """What the robot knows of its pose: dead reckoning from commands, the truth, or from its
    wheel encoders."""
    preset: Literal["default", "paper"] = "default"
    """Settings that the other flags change: what works best, or every number as printed."""
    seed: int = 0
    """Seed of every random number of the run."""
    trials: int = 200
    """Trials to learn for."""
    net: NetworkConfig = field(default_factory=NetworkConfig)
    sga: SGAConfig = field(default_factory=SGAConfig)
    q: QConfig = field(default_factory=QConfig)
    maze: MazeConfig = field(default_factory=MazeConfig)

    def __post_init__(self) -> None:
        """Check every number; ValueError names the flag and what is allowed."""
        validation.check(self)
        self._check_together()

    def to_json(self) -> str:
        """The settings as readable JSON."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    def idle(self) -> dict[str, str]:
        """Settings, or whole tables of them, that change nothing beside the others, and why."""
        sga, q, fixed = self.sga, self.q, self.network == "fixed"
        valued, acting = sga.baseline == "value", self.agent == "q" and q.coding == "antecedent"
        reasons = (
            (self.agent != "sga", "sga", "with --agent q"),
            (self.agent != "q", "q", "with --agent sga"),
            (not acting, "net.grid_action net.width_action", "without --q.coding antecedent"),
            (fixed, "net.theta net.growth net.interpolate", "with --network fixed"),
            (not fixed, "net.grid net.grid_action", "without --network fixed"),
            (valued, "sga.constant", "with --sga.baseline value"),
            (not valued, "sga.rate_value sga.initial_value", "without a learned baseline"),
            (not valued, "sga.value_limit", "without a learned baseline"),
            (not sga.replays, "sga.memory", "with --sga.replays 0"),
            (not q.replays, "q.memory", "with --q.replays 0"),
        )
        return {name: why for idle, names, why in reasons if idle for name in names.split()}

    def _check_together(self) -> None:
        """Raise ValueError on settings that exclude each other."""
        net, sga, q = self.net, self.sga, self.q
        if not sga.sigma_min <= sga.sigma_initial <= sga.sigma_max:
            raise ValueError("need --sga.sigma-min <= --sga.sigma-initial <= --sga.sigma-max")
        if sga.replays and sga.baseline == "constant":
            raise ValueError("--sga.replays needs --sga.baseline value: set --sga.replays 0")
        learner, reward = (q if self.agent == "q" else sga), self.maze.goal_reward
        limit = None if f"{self.agent}.value_limit" in self.idle() else learner.value_limit
        if limit is not None and limit < reward:
            raise ValueError(
                f"--{self.agent}.value-limit {limit:g} must be at least "
                f"--maze.goal-reward {reward:g}, or None"
            )
        if q.actions == "three" and q.segments != 3:
            raise ValueError("--q.actions three needs --q.segments 3")
        if self.network == "fixed":
            shape = net.grid
            if self.agent == "q" and q.coding == "antecedent":
                shape = (*shape, net.grid_action)
            if math.prod(shape) > net.max_rules:
                raise ValueError(
                    f"--net.grid {shape} has more rules than --net.max-rules {net.max_rules}"
                )


def from_dict(data: Any) -> Config:
    """Settings from plain data, as JSON or a checkpoint holds them.

    Entries that are not given take their default, so that files of older versions can be read.

    Raises:
        ValueError: one line on an unknown entry, a wrong type or a value out of range.
    """
    return validation.read(data, Config)
