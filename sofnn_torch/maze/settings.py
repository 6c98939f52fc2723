"""Settings of robot and maze; those of the environment by itself are the same."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from sofnn_torch.bounds import Positive, Settings, Within
from sofnn_torch.network.axes import Axis

Actions = Literal["three", "steer", "wheels"]
Whole = Annotated[int, Within(above=0)]

POSE = (
    Axis("x", "m", 0.0, 1.0),
    Axis("y", "m", 0.0, 1.0),
    Axis("heading", "rad", -math.pi, math.pi, period=2 * math.pi),
)
ACTION_NAMES = {
    "three": ("right turn", "straight", "left turn"),
    "steer": ("steer",),
    "wheels": ("left wheel", "right wheel"),
}


@dataclass(frozen=True)
class MazeConfig(Settings, table="maze"):
    """Section 5: robot and maze."""

    actions: Actions = "three"
    """`three`: right turn, straight, left turn; `steer`: one number that blends them; `wheels`: two
    wheel speeds (SGA only)."""
    hold: Annotated[Whole, Within(most=10_000)] = 10
    """Steps that an action is held unless the robot bumps."""
    max_steps: Whole = 20_000
    """Steps after which a trial ends without the goal."""
    motor_noise: Annotated[float, Within(least=0, below=1)] = 0.1
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
    wheel_radius_scale: Positive = 1.0
    """Miscalibration: the wheel radius that the robot believes in over the true one."""
    wheel_base_scale: Positive = 1.0
    """Miscalibration: the wheel base that the robot believes in over the true one."""
