"""Shortest possible run through the maze, by search over a noise-free kinematic robot.

`python -m sofnn_torch.maze.optimum` prints it for actions held 10 steps and for free ones. Learned
policies are measured against it.
"""

import math
import signal
from dataclasses import dataclass

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.arguments import real, whole
from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT
from sofnn_torch.maze.odometry import STEP_LENGTH, STEP_TURN, Pose
from sofnn_torch.maze.robot import MazePlan, Physics
from sofnn_torch.terminal import command

MAX_TURN = 4.0  # rad to either side of the start heading; no sensible run winds up further
FREE_SPACE_CELL = 0.0005  # m, of the grid that says where a wall is
ACTIONS = np.array([RIGHT, STRAIGHT, LEFT], dtype=np.int8)


@dataclass(frozen=True)
class Optimum:
    """A shortest run: its length in simulator steps, its held actions and the poses between."""

    steps: int
    actions: list[int]  # of the environment's "three"
    path: list[Pose]  # before each action, and at the end


def optimal_steps(
    plan: MazePlan, hold: int = 10, resolution: float = 0.00125, skin: float = 0.001
) -> Optimum:
    """Find the fewest simulator steps from the start to the goal without touching a wall.

    Breadth-first search, one level per action. Headings are exact, as turns are multiples of
    `hold` x `STEP_TURN`; positions are exact along each path, but of all paths that reach the same
    cell of the floor at the same heading only the first is followed. So the result is a run that
    can be driven, and tends to the optimum as cells shrink.

    Args:
        plan: the maze.
        hold: steps for which an action is held.
        resolution: cell size [m].
        skin: distance [m] kept from walls.

    Raises:
        ValueError: if the goal cannot be reached, or an argument is out of range.
    """
    hold, resolution, skin = whole("hold", hold), real("resolution", resolution), real("skin", skin)
    if not (resolution > 0.0 and skin >= 0.0):
        raise ValueError(f"resolution must be positive and skin not negative: {resolution}, {skin}")
    free = _free_space(plan, skin)
    half = math.ceil(MAX_TURN / (hold * STEP_TURN))
    columns = math.ceil(plan.size[0] / resolution) + 1
    rows = math.ceil(plan.size[1] / resolution) + 1
    seen = np.zeros((columns, rows, 2 * half + 1), dtype=bool)

    x, y = np.array([plan.start[0]]), np.array([plan.start[1]])
    turns = np.zeros(1, dtype=np.int32)
    levels: list[tuple[NDArray, NDArray, NDArray, NDArray, NDArray]] = []
    parent, action = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.int8)
    while x.size:
        levels.append((x, y, turns, parent, action))
        heading = plan.start[2] + hold * STEP_TURN * turns
        dx, dy = STEP_LENGTH * np.cos(heading), STEP_LENGTH * np.sin(heading)
        clear = np.ones(x.size, dtype=bool)
        for step in range(1, hold + 1):
            ahead_x, ahead_y = x + step * dx, y + step * dy
            clear &= _look_up(free, ahead_x, ahead_y)
            arrived = clear & (
                np.hypot(ahead_x - plan.goal[0], ahead_y - plan.goal[1]) <= plan.goal_radius
            )
            if arrived.any():
                return _trace_back(levels, int(arrived.argmax()), step, plan.start[2], hold)

        index = np.arange(x.size, dtype=np.int32)
        parent = np.concatenate([index, index[clear], index])
        action = np.repeat(ACTIONS, [x.size, int(clear.sum()), x.size])
        straight = action == STRAIGHT
        x, y = x[parent], y[parent]
        x[straight] += hold * dx[clear]
        y[straight] += hold * dy[clear]
        turns = turns[parent] + action - STRAIGHT

        keep = np.flatnonzero(np.abs(turns) <= half)
        column, row = (x[keep] / resolution).astype(int), (y[keep] / resolution).astype(int)
        key = np.ravel_multi_index((column, row, turns[keep] + half), seen.shape)
        key, first = np.unique(key, return_index=True)
        new = ~seen.flat[key]
        seen.flat[key] = True
        keep = keep[first[new]]
        x, y, turns, parent, action = x[keep], y[keep], turns[keep], parent[keep], action[keep]
    raise ValueError("the goal of this maze cannot be reached")


def _free_space(plan: MazePlan, skin: float) -> NDArray[np.bool_]:
    """Return where the robot's centre may be, on a fine grid over the arena."""
    xs, ys = (np.arange(0.0, size + FREE_SPACE_CELL, FREE_SPACE_CELL) for size in plan.size)
    free = np.ones((xs.size, ys.size), dtype=bool)
    radius = plan.robot_radius + skin
    for x0, y0, x1, y1 in plan.walls:
        dx = np.maximum(np.maximum(x0 - xs, xs - x1), 0.0)
        dy = np.maximum(np.maximum(y0 - ys, ys - y1), 0.0)
        free &= dx[:, None] ** 2 + dy[None, :] ** 2 > radius * radius
    return free


def _look_up(free: NDArray[np.bool_], x: NDArray, y: NDArray) -> NDArray[np.bool_]:
    i = np.clip((x / FREE_SPACE_CELL + 0.5).astype(int), 0, free.shape[0] - 1)
    j = np.clip((y / FREE_SPACE_CELL + 0.5).astype(int), 0, free.shape[1] - 1)
    return free[i, j]


def _trace_back(levels: list, index: int, last: int, start_heading: float, hold: int) -> Optimum:
    """Follow the parents of a state, from which `last` straight steps lead into the goal."""
    actions, path = [STRAIGHT], []
    for x, y, turns, parent, action in reversed(levels):
        heading = start_heading + hold * STEP_TURN * turns[index]
        path.append((float(x[index]), float(y[index]), float(heading)))
        actions.append(int(action[index]))
        index = int(parent[index])
    x, y, heading = path[0]
    end = (x + last * STEP_LENGTH * math.cos(heading), y + last * STEP_LENGTH * math.sin(heading))
    return Optimum(
        steps=hold * (len(levels) - 1) + last,
        actions=actions[-2::-1],
        path=[*path[::-1], (*end, heading)],
    )


@dataclass(frozen=True)
class Options:
    """There are no flags."""


def run(_: Options) -> None:
    """Print the optimum of the standard maze at two resolutions."""
    plan = Physics().plan
    for hold, resolution in ((10, 0.0025), (10, 0.00125), (1, 0.0025), (1, 0.00125)):
        best = optimal_steps(plan, hold, resolution)
        print(
            f"actions held {hold:2d} steps, cells of {resolution * 1e3} mm: "
            f"{best.steps} steps, {len(best.actions)} decisions"
        )


def main() -> None:
    """Entry point of ``python -m sofnn_torch.maze.optimum``."""
    command(run, Options, __doc__)


if __name__ == "__main__":
    main()
