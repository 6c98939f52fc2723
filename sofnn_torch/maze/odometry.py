"""Motor noise and dead reckoning: where the robot believes it is (section 5.1 of the paper)."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.arguments import choice, real

STEP_SECONDS = 0.5
FORWARD_SPEED = 0.010  # m/s of both wheels: the paper's (10, 10) mm/s
TURN_SPEED = 0.004  # m/s of each wheel, in opposite directions: the paper's (-4, 4) mm/s
WHEEL_BASE = 0.050  # m, distance between the wheels
WHEEL_RADIUS = 0.008  # m
STEP_LENGTH = FORWARD_SPEED * STEP_SECONDS  # m, one step straight on: 5 mm
STEP_TURN = 2.0 * TURN_SPEED * STEP_SECONDS / WHEEL_BASE  # rad, one turning step: 0.08 rad
DRAG = 1.7  # sideways drag of the tyres over that of the drive, of the simulated robot
ROBOT_RADIUS = 0.0275  # m
TRUST = 0.3  # share of a heading's error that one felt wall corrects

Pose = tuple[float, float, float]


def wrap_angle(angle: float) -> float:
    """Return the same direction in [-pi, pi)."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi  # the remainder may round up to the divisor


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
        self.magnitude = real("motor_noise", magnitude)
        if not 0.0 <= self.magnitude < 1.0:
            raise ValueError(f"motor_noise must be in [0, 1), not {magnitude}")
        self.kind = choice("wheel_noise", kind, ("common", "independent"))

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
    """Pose estimate that adds up wheel movements, and is set right where the robot knows its place.

    `mode="slide"` (default): in a bumped step the estimate slides along the wall that the robot
    feels, as the robot does, and it stays inside the arena. `mode="still"`: the same, but a bumped
    step does not move it. `mode="literal"`, as printed in the paper: it always moves.

    Examples:
        >>> estimator = DeadReckoning()
        >>> estimator.fix((0.15, 0.25, 0.0))
        >>> estimator.update(0.005, 0.005)
        >>> estimator.pose
        (0.155, 0.25, 0.0)
    """

    def __init__(
        self,
        mode: str = "slide",
        wheel_base: float = WHEEL_BASE,
        arena: Sequence[float] = (1, 1),
        right_angles: bool = False,
    ) -> None:
        """Start at the origin.

        Args:
            mode: "slide", "still" or "literal".
            wheel_base: distance between the wheels [m] that the robot believes it has.
            arena: width and height [m] of the area that the robot does not leave.
            right_angles: whether walls are known to run along x or y: then the direction of a felt
                wall tells the heading.

        Raises:
            ValueError: if `mode` is unknown or `wheel_base` is not positive.
        """
        mode = choice("dead_reckoning", mode, ("slide", "still", "literal"))
        self.wheel_base = real("wheel_base", wheel_base)
        if not self.wheel_base > 0.0:
            raise ValueError(f"wheel_base must be positive, not {wheel_base}")
        self.guarded, self.slides = mode != "literal", mode == "slide"
        self.width, self.height = arena
        self.right_angles = right_angles
        self.pose: Pose = (0.0, 0.0, 0.0)

    def fix(self, pose: Pose) -> None:
        """Set the estimate to a known pose (x [m], y [m], heading [rad])."""
        self.pose = (pose[0], pose[1], wrap_angle(pose[2]))

    def update(self, left: float, right: float, walls: Sequence[float] = ()) -> None:
        """Add one step in which the wheels rolled `left` and `right` [m].

        Args:
            left: way of the left wheel.
            right: way of the right wheel.
            walls: directions of the touched walls, seen from the robot's heading [rad].
        """
        distance, turn = differential_drive(left, right, self.wheel_base)
        if not self.guarded:
            self.pose = advance(self.pose, distance, turn)
            return
        x, y, heading = self.pose
        if not walls:
            x, y, heading = advance(self.pose, distance, turn)
        else:
            if self.slides:
                along, aside = slide(distance, walls)
                x += along * math.cos(heading) - aside * math.sin(heading)
                y += along * math.sin(heading) + aside * math.cos(heading)
            heading = wrap_angle(heading + turn)
            if self.right_angles:
                heading = squared(heading, walls[0])
        r = ROBOT_RADIUS  # its centre comes no nearer to the walls around the arena
        x, y = min(max(x, r), self.width - r), min(max(y, r), self.height - r)
        self.pose = (x, y, heading)


def slide(distance: float, walls: Sequence[float]) -> tuple[float, float]:
    """Return the way [m], forward and to the left, of a robot that drives against walls.

    At an angle `b` to a wall the robot slides by `cos b / (cos^2 b + DRAG sin^2 b)` of the way that
    it drives: along its heading the drive gives way, across it the tyres do, `DRAG` times as hard.

    Args:
        distance: way [m] that the wheels would drive it.
        walls: directions of the walls, seen from the robot's heading [rad].
    """
    along, aside = distance, 0.0
    for bearing in walls:
        c, s = math.cos(bearing), math.sin(bearing)
        against = along * c + aside * s
        if against > 1e-9:  # m; the second contact with the same wall changes nothing
            along, aside = along - against * c, aside - against * s
            tangent = math.hypot(along, aside)
            share = (tangent / distance) ** 2
            resistance = share + DRAG * (1.0 - share)
            along, aside = along / resistance, aside / resistance
    return along, aside


def squared(heading: float, wall: float) -> float:
    """Return a heading [rad] corrected by a wall along x or y that is felt in a direction [rad].

    A share of the difference, so that the noise of one reading weighs little; what is off by more
    than 10 degrees is the edge of a wall.
    """
    quarter = 0.5 * math.pi
    error = (heading + wall + 0.5 * quarter) % quarter - 0.5 * quarter
    return wrap_angle(heading - TRUST * error) if abs(error) < math.radians(10.0) else heading


def pose_errors(true: NDArray[np.float64], estimated: NDArray[np.float64]) -> dict[str, float]:
    """Return how far estimates were from the truth over a trial, at whose start they are equal.

    Args:
        true: poses (x [m], y [m], heading [rad]) at the start and after every decision.
            Shape: (T, 3).
        estimated: where the robot believed to be. Shape: (T, 3).

    Returns:
        `pose_error` and `pose_error_max`, the mean and the largest distance [m], and
        `heading_error`, the mean absolute difference of the headings [rad].
    """
    difference = (true - estimated)[1:]
    distance = np.hypot(difference[:, 0], difference[:, 1])
    turn = np.abs((difference[:, 2] + math.pi) % (2 * math.pi) - math.pi)
    return {
        "pose_error": float(distance.mean()),
        "pose_error_max": float(distance.max()),
        "heading_error": float(turn.mean()),
    }
