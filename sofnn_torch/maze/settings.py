"""Settings of robot and maze; those of the environment by itself are the same."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from sofnn_torch.bounds import Positive, Settings, Within, flag
from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.robot import checked, plan_of
from sofnn_torch.network.axes import Axis

Actions = Literal["three", "steer", "wheels"]
Whole = Annotated[int, Within(above=0)]

POSE = (
    Axis("x", "m", 0.0, 1.0),
    Axis("y", "m", 0.0, 1.0),
    Axis("heading", "rad", -math.pi, math.pi, period=2 * math.pi),
)
GOAL = Axis("goal x", "m", 0.0, 1.0), Axis("goal y", "m", 0.0, 1.0)


@dataclass(frozen=True)
class MazeConfig(Settings, table="maze"):
    """Section 5: robot and maze.

    Examples:
        >>> MazeConfig(layout="rooms", motor_noise=0).hold
        10
    """

    layout: str = STANDARD
    """Maze: a file with a map or an MJCF, of which the content is kept with the run, or one that is
    built in: `s`, `open`, `rooms`, `spiral`, `large`, `starts`, `anywhere`, `goals`, `random:SEED`
    (docs/mazes.md)."""
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
    bumps: Literal["infrared", "contact"] = "infrared"
    """Where bumps and the direction of the wall come from: `infrared`, the robot's eight sensors;
    `contact`, the contacts of the simulation, exact."""
    infrared_noise: Annotated[float, Within(least=0, below=1)] = 0.1
    """Noise of the infrared sensors; 0.1 multiplies each reading by U(0.9, 1.1)."""
    landmarks: Literal["pose", "position", "inside", "first"] = "pose"
    """What the robot learns at a sub-goal: `pose`, where it is and how it heads, on entry;
    `position`, where it is, on entry; `inside`, its pose at every step there and near the start;
    `first`, its pose the first time in a trial, as in the paper."""
    dead_reckoning: Literal["slide", "still", "literal"] = "slide"
    """What a bump does to the estimated pose: `slide`, it slides along the wall; `still`, it stays;
    `literal`, it advances as without, also out of the arena, as printed in the paper."""
    right_angles: bool = True
    """The robot knows that walls run along x or y: each that it feels corrects its heading."""
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

    def __post_init__(self) -> None:
        """Check the fields and read the layout; ValueError names the flag and what is wrong."""
        if isinstance(self.layout, Path):
            object.__setattr__(self, "layout", str(self.layout))
        super().__post_init__()
        text = checked(flag(self.table, "layout"), self.layout)
        object.__setattr__(self, "layout", text)  # the dataclass is frozen

    @classmethod
    def upgraded(cls, data: dict[str, Any]) -> dict[str, Any]:
        """Settings of a run that was told its contacts and, inside every landmark, its pose."""
        mode = data.get("dead_reckoning")
        if "bumps" in data or "hold" not in data or mode not in ("guarded", "still", "literal"):
            return data
        mode, landmarks = {
            "guarded": ("slide", "inside"),
            "still": ("still", "inside"),
            "literal": ("literal", "first"),
        }[mode]
        known = {"bumps": "contact", "landmarks": landmarks, "right_angles": False}
        return data | known | {"dead_reckoning": mode}

    @property
    def axes(self) -> tuple[Axis, ...]:
        """What the robot is told: its pose, and where the goal is if that varies."""
        return axes(plan_of(self.layout))


def axes(plan: MazePlan) -> tuple[Axis, ...]:
    """The axes of the pose in a maze, and of its goal where the robot is told."""
    ends = dict(zip("xy", plan.size, strict=True))
    names = POSE + GOAL * plan.told
    return tuple(replace(a, high=ends.get(a.name[-1], a.high)) for a in names)
