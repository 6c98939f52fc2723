"""Shortest possible run through the maze, by search over a noise-free kinematic robot.

`python -m sofnn_torch.maze.optimum` prints it for actions held 10 steps and for free ones, and with
`--layout` that of another maze. Learned policies are measured against it.
"""

import math
import signal
from dataclasses import dataclass, replace

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from sofnn_torch.maze.arguments import real, whole
from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT
from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.maze.odometry import STEP_LENGTH, STEP_TURN, Pose
from sofnn_torch.maze.plan import SPOT, MazePlan
from sofnn_torch.maze.robot import checked, plan_of
from sofnn_torch.terminal import command

MAX_TURN = 4.0  # rad to either side of the start heading
SPARE_TURN = 1.6  # rad that a run may wind further than the shortest way of a point
TRIALS = 20  # drawn in a maze that begins anywhere
WAY_CELL = 4  # points of the plan's grid along a cell of the way of a point
LOOK_AHEAD = 6  # such cells over which its direction is taken
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
    """Find the fewest simulator steps from the (first) start to a goal without touching a wall.

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
    free = plan.free(FREE_SPACE_CELL, skin)
    half = math.ceil(max(MAX_TURN, _winding(plan) + SPARE_TURN) / (hold * STEP_TURN))
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
            away = [np.hypot(ahead_x - gx, ahead_y - gy) for gx, gy in plan.goals]
            arrived = clear & (np.min(away, axis=0) <= plan.goal_radius)
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


def mean_optimum(
    plan: MazePlan, hold: int = 10, resolution: float | None = None, seed: int = 0
) -> float:
    """The mean of the fewest steps over the starts and goals that trials draw.

    Starts anywhere are `TRIALS` that are drawn from a seed.

    Args:
        plan: the maze.
        hold: steps for which an action is held.
        resolution: cell size [m]; by default that of `optimal_steps`, and four times as much for
            several ways or floors beyond a square metre or so.
        seed: of the starts.

    Raises:
        ValueError: as `optimal_steps`.
    """
    starts = plan.starts
    if plan.anywhere:
        rng = np.random.default_rng(seed)
        starts = [plan.draw_start(rng) for _ in range(TRIALS)]
    sets = [[goal] for goal in plan.goals] if plan.told else [plan.goals]
    ways = [replace(plan, starts=[start], goals=goals) for start in starts for goals in sets]
    if resolution is None:
        resolution = 0.005 if len(ways) > 1 or max(plan.size) > 1.2 else 0.00125
    return sum(optimal_steps(way, hold, resolution).steps for way in ways) / len(ways)


def _winding(plan: MazePlan) -> float:
    """How far [rad] the shortest way of a point turns from the heading at the start."""
    free = plan.reached[::WAY_CELL, ::WAY_CELL]
    shape, (x, y, heading) = free.shape, plan.start
    cell = WAY_CELL * SPOT
    number = np.arange(free.size).reshape(shape)
    pairs = []
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        here = number[: shape[0] - i, max(0, -j) : shape[1] - max(0, j)]
        there = number[i:, max(0, j) : shape[1] + min(0, j)]
        open_ = free.flat[here] & free.flat[there]
        pairs.append((here[open_], there[open_], np.full(int(open_.sum()), math.hypot(i, j))))
    here, there, far = (np.concatenate(part) for part in zip(*pairs, strict=True))
    graph = sparse.csr_array((far, (here, there)), (free.size, free.size))
    xs, ys = (np.arange(n) * cell for n in shape)
    goals = [
        int(np.argmin((xs[:, None] - gx) ** 2 + (ys - gy) ** 2 + 1e3 * ~free))
        for gx, gy in plan.goals
    ]
    start = int(np.argmin((xs[:, None] - x) ** 2 + (ys - y) ** 2 + 1e3 * ~free))
    _, before, _ = csgraph.dijkstra(
        graph, directed=False, indices=goals, min_only=True, return_predecessors=True
    )
    way = [start]
    while before[way[-1]] >= 0:
        way.append(before[way[-1]])
    points = np.column_stack(np.unravel_index(way, shape))[::LOOK_AHEAD]
    steps = np.diff(points, axis=0)
    if not len(steps):
        return math.pi
    turned = np.unwrap([heading, *np.arctan2(steps[:, 1], steps[:, 0])]) - heading
    return float(np.abs(turned).max())


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
    """The shortest run through a maze."""

    layout: str = STANDARD
    """Maze that is built in, or a file with a map or an MJCF (docs/mazes.md)."""


def run(options: Options) -> None:
    """Print the optimum of a maze at two resolutions; the mean where starts or goals vary."""
    plan = plan_of(checked("--layout", options.layout))
    if len(plan.starts) > 1 or plan.anywhere or plan.told:
        print(f"actions held 10 steps: {mean_optimum(plan):.0f} steps in the mean of the trials")
        return
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
