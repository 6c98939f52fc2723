"""Spaces of actions and observations, and what the kinds of actions make the robot do."""

import math
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from sofnn_torch.maze.arguments import show, vector
from sofnn_torch.maze.odometry import FORWARD_SPEED, TURN_SPEED
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.sensors import INFRARED_RANGE

RIGHT, STRAIGHT, LEFT = range(3)
ACTION_NAMES = {
    "three": ("right turn", "straight", "left turn"),
    "steer": ("steer",),
    "wheels": ("left wheel", "right wheel"),
}
TURN_SHARE = TURN_SPEED / FORWARD_SPEED  # wheel speed of a turn over that of going straight


def action_space(kind: str) -> Discrete | Box:
    """The space of the actions of a kind."""
    return Discrete(3) if kind == "three" else Box(-1.0, 1.0, (len(ACTION_NAMES[kind]),))


def observation_space(plan: MazePlan, reach: float, ranges: bool) -> Box:
    """The space of the observations: pose, goal where the robot is told, ranges and bumper.

    Args:
        plan: the maze.
        reach: how far [m] an estimated position may lie outside it.
        ranges: whether there are infrared ranges and the bumper.
    """
    low = [-reach, -reach, -math.pi]
    high = [plan.size[0] + reach, plan.size[1] + reach, math.pi]
    if plan.told:
        low, high = [*low, 0.0, 0.0], [*high, *plan.size]
    if ranges:
        low += [0.0] * 9
        high += [INFRARED_RANGE] * 8 + [1.0]
    return Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def commanded(kind: str, action: Any) -> tuple[float, float]:
    """Return the commanded speeds of the left and right wheel [m/s] for an action of a kind.

    Raises:
        ValueError: it is not in the action space.
    """
    if kind == "three":
        (number,) = vector("action", action, 1)
        if number not in (RIGHT, STRAIGHT, LEFT):
            names = f"{RIGHT} (right), {STRAIGHT} (straight), {LEFT} (left turn)"
            raise ValueError(f"action must be {names}, not {show(action)}")
        steer = number - 1.0
    else:
        values = vector("action", action, len(ACTION_NAMES[kind]), bound=1.0)
        if kind == "wheels":
            return values[0] * FORWARD_SPEED, values[1] * FORWARD_SPEED
        steer = values[0]
    forward, turn = FORWARD_SPEED * (1.0 - abs(steer)), TURN_SPEED * steer
    return forward - turn, forward + turn


def wheel_speeds(steer: float) -> list[float]:
    """Speeds of the left and right wheel over the fastest, of a steering from -1 to 1."""
    forward, turn = 1 - abs(steer), TURN_SHARE * steer
    return [forward - turn, forward + turn]


def motion(actions: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """How actions move a robot: forward and to the left, each over the fastest. Shapes: (B,).

    Args:
        actions: numbers of the three actions (B,), steering (B, 1) or wheel speeds (B, 2).
    """
    if actions.ndim == 2 and actions.shape[1] == 2:
        left, right = actions.T
        return (left + right) / 2, ((right - left) / (2 * TURN_SHARE)).clip(-1, 1)
    steer = actions - 1.0 if actions.ndim == 1 else actions[:, 0]
    return 1 - abs(steer), steer
