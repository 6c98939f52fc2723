"""What a run consists of: typed settings.

Every field is a flag of ``train.py``; the string under a field is its help text. The presets are in
`sofnn_torch.presets`, what is made from the settings in `sofnn_torch.factory`.
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from sofnn_torch import validation
from sofnn_torch.qlearning import Coding
from sofnn_torch.sga import Actions
from sofnn_torch.sofnn import Growth


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

    def _check_together(self) -> None:
        """Raise ValueError on settings that exclude each other."""
        net, sga, q = self.net, self.sga, self.q
        if not sga.sigma_min <= sga.sigma_initial <= sga.sigma_max:
            raise ValueError("need --sga.sigma-min <= --sga.sigma-initial <= --sga.sigma-max")
        if sga.replays and sga.baseline == "constant":
            raise ValueError("--sga.replays needs --sga.baseline value: set --sga.replays 0")
        learner, reward = (q if self.agent == "q" else sga), self.maze.goal_reward
        if learner.value_limit is not None and learner.value_limit < reward:
            raise ValueError(
                f"--{self.agent}.value-limit {learner.value_limit:g} must be at least "
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
