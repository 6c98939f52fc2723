"""What the infrared sensors feel: bumps, and the direction of the wall that the robot drives at."""

import math
from collections.abc import Sequence

from sofnn_torch.maze.odometry import ROBOT_RADIUS, wrap_angle

INFRARED: dict[str, tuple[float, float, float]] = {  # x, y [m], direction [degrees]; x is ahead
    "ir_left_90": (0.0095, 0.023, 90.0),
    "ir_left_45": (0.018, 0.0175, 45.0),
    "ir_left_0": (0.0245, 0.0055, 0.0),
    "ir_right_0": (0.0245, -0.0055, 0.0),
    "ir_right_45": (0.018, -0.0175, -45.0),
    "ir_right_90": (0.0095, -0.023, -90.0),
    "ir_back_right": (-0.023, -0.0095, 180.0),
    "ir_back_left": (-0.023, 0.0095, 180.0),
}
INFRARED_RANGE = 0.05  # m, beyond which a sensor sees nothing
TOUCH = 0.001  # m between body and wall, below which the robot feels a bump
CORNER = 0.25 * math.pi  # rad between the directions of two walls
BESIDE = 0.05  # cosine of the angle to a wall along which the robot drives

_BEAMS = [
    (x, y, math.cos(math.radians(angle)), math.sin(math.radians(angle)))
    for x, y, angle in INFRARED.values()
]


def readings(ranges: Sequence[float], noise: float, draws: Sequence[float]) -> list[float]:
    """Return what the sensors report of free distances [m]: each times U(1 - noise, 1 + noise).

    Args:
        ranges: the free distance before each sensor.
        noise: 0.1 in the Khepera Simulator 2.0.
        draws: one number from U(0, 1) for each sensor.
    """
    return [
        min(r * (1.0 + noise * (2.0 * d - 1.0)), INFRARED_RANGE) if r < INFRARED_RANGE else r
        for r, d in zip(ranges, draws, strict=True)
    ]


def felt_walls(seen: Sequence[float], forward: float = 1.0) -> list[float]:
    """Return the directions of the walls that the robot drives at, seen from its heading [rad].

    Two neighbouring sensors that see a wall see two points of it, and the line through them is the
    wall: a wall nearer to the body than `TOUCH` is felt. Sensors that see the nearest points come
    first; a second wall is one of another direction, as in a corner. Without noise a flat wall is
    where it is; at the edge of a wall, which two beams straddle, it may be missed.

    Args:
        seen: what the eight sensors report [m].
        forward: the way [m] that the wheels drive, negative for backwards.
    """
    near = [i for i, distance in enumerate(seen) if distance < INFRARED_RANGE]
    pairs = [(i, (i + 1) % len(seen)) for i in near if seen[(i + 1) % len(seen)] < INFRARED_RANGE]
    walls: list[float] = []
    for first, second in sorted(pairs, key=lambda pair: seen[pair[0]] + seen[pair[1]]):
        gap, bearing = _wall(first, second, seen)
        ahead = math.copysign(1.0, forward) * math.cos(bearing) > BESIDE
        if gap < TOUCH and ahead and all(apart(bearing, other) > CORNER for other in walls):
            walls.append(bearing)
    return walls


def apart(first: float, second: float) -> float:
    """Return the angle between two directions [rad, 0 to pi]."""
    return abs(wrap_angle(first - second))


def _wall(first: int, second: int, seen: Sequence[float]) -> tuple[float, float]:
    """Gap to the body [m] and direction [rad] of the line through what two sensors see."""
    (ax, ay), (bx, by) = _point(first, seen[first]), _point(second, seen[second])
    across_x, across_y = by - ay, ax - bx
    length = math.hypot(across_x, across_y)
    distance = (across_x * ax + across_y * ay) / length
    side = math.copysign(1.0, distance)
    return abs(distance) - ROBOT_RADIUS, math.atan2(side * across_y, side * across_x)


def _point(sensor: int, distance: float) -> tuple[float, float]:
    x, y, along, aside = _BEAMS[sensor]
    return x + distance * along, y + distance * aside
