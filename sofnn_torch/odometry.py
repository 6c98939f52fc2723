"""Motor noise and dead reckoning: where the robot believes it is (section 5.1 of the paper)."""

import math
from collections.abc import Sequence

STEP_SECONDS = 0.5
WHEEL_BASE = 0.050  # m, distance between the wheels
WHEEL_RADIUS = 0.008  # m

Pose = tuple[float, float, float]


def wrap_angle(angle: float) -> float:
    """Return the same direction in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def advance(pose: Pose, distance: float, turn: float) -> Pose:
    """Move a pose by `distance` [m] along the mean of its old and new heading, and turn it [rad].

    Section 5.1 of the paper, for which `distance` or `turn` is always zero. The printed
    `y - E(dis) cos(theta)` is read as a sine: otherwise the robot could not drive east.
    """
    x, y, heading = pose
    middle = heading + 0.5 * turn
    return (
        x + distance * math.cos(middle),
        y + distance * math.sin(middle),
        wrap_angle(heading + turn),
    )


def differential_drive(left: float, right: float, wheel_base: float) -> tuple[float, float]:
    """Return distance [m] and turn [rad] of a robot whose wheels rolled `left` and `right` [m]."""
    return 0.5 * (left + right), (right - left) / wheel_base


class MotorNoise:
    """Random slip between commanded and real wheel speeds, once per simulator step.

    With `kind="common"` the mean of both wheel speeds is multiplied by U(1-m, 1+m) and their
    difference by U(1-m/2, 1+m/2), as the Khepera Simulator 2.0 does with m = 0.1. With
    `kind="independent"` each wheel speed is multiplied by its own U(1-m, 1+m).
    """

    def __init__(self, magnitude: float = 0.1, kind: str = "common") -> None:
        """Check and keep the settings.

        Raises:
            ValueError: if `magnitude` is outside [0, 1) or `kind` is unknown.
        """
        if not 0.0 <= magnitude < 1.0:
            raise ValueError(f"motor_noise must be in [0, 1), not {magnitude}")
        if kind not in ("common", "independent"):
            raise ValueError(f'wheel_noise must be "common" or "independent", not {kind!r}')
        self.magnitude = magnitude
        self.kind = kind

    def apply(self, left: float, right: float, first: float, second: float) -> tuple[float, float]:
        """Return noisy speeds from commanded ones and two draws from U(0, 1)."""
        a = self.magnitude * (2.0 * first - 1.0)
        b = self.magnitude * (2.0 * second - 1.0)
        if self.kind == "independent":
            return left * (1.0 + a), right * (1.0 + b)
        forward = 0.5 * (left + right) * (1.0 + a)
        turning = 0.5 * (right - left) * (1.0 + 0.5 * b)
        return forward - turning, forward + turning


class DeadReckoning:
    """Pose estimate that adds up wheel movements, with fixes where the robot knows its place.

    `mode="guarded"` (default): a bumped step does not move the estimate, which also stays inside
    the arena, and the estimate is set to the truth whenever the robot passes a landmark (a
    sub-goal or the start). `mode="literal"`, as printed in the paper: it always moves, and is
    set to the truth only when a sub-goal is found for the first time in a trial.
    """

    def __init__(
        self, mode: str = "guarded", wheel_base: float = WHEEL_BASE, arena: Sequence[float] = (1, 1)
    ) -> None:
        """Start at the origin.

        Args:
            mode: "guarded" or "literal".
            wheel_base: distance between the wheels [m] that the robot believes it has.
            arena: width and height [m] of the area the estimate may not leave.

        Raises:
            ValueError: if `mode` is unknown or `wheel_base` is not positive.
        """
        if mode not in ("guarded", "literal"):
            raise ValueError(f'dead_reckoning must be "guarded" or "literal", not {mode!r}')
        if not wheel_base > 0.0:
            raise ValueError(f"wheel_base must be positive, not {wheel_base}")
        self.guarded = mode == "guarded"
        self.wheel_base = wheel_base
        self.width, self.height = arena
        self.pose: Pose = (0.0, 0.0, 0.0)

    def fix(self, pose: Pose) -> None:
        """Set the estimate to a known pose (x [m], y [m], heading [rad])."""
        self.pose = (pose[0], pose[1], wrap_angle(pose[2]))

    def update(self, left: float, right: float, bumped: bool) -> None:
        """Add one step in which the wheels rolled `left` and `right` [m]."""
        distance, turn = differential_drive(left, right, self.wheel_base)
        if not self.guarded:
            self.pose = advance(self.pose, distance, turn)
            return
        x, y, heading = advance(self.pose, 0.0 if bumped else distance, turn)
        self.pose = (min(max(x, 0.0), self.width), min(max(y, 0.0), self.height), heading)
