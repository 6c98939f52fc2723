"""The maze as seen from above: read from the model, the only source of geometry, and checked."""

import functools
import math
import re
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sofnn_torch.maze.odometry import Pose, wrap_angle

Place = tuple[float, float]
Box = tuple[float, float, float, float]
ZONE = re.compile(r"(start|goal|subgoal)((?:_[1-9]\d*)?)(_ring|_centre)?")
SPOT = 0.0025  # m, of the grid on which ways are looked for
TIGHT = 0.0025  # m; a gap that leaves the robot less on either side counts as closed
LARGEST = 20.0  # m
ROOM = 0.01  # m that a start anywhere keeps from walls
TRIES = 10_000  # to draw such a start


def heading_of(w: float, x: float, y: float, z: float) -> float:
    """Return the yaw [rad, in [-pi, pi)] of a unit quaternion."""
    return wrap_angle(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


@dataclass(frozen=True)
class MazePlan:
    """Walls and zones of a maze, in metres.

    Examples:
        >>> from sofnn_torch.runs.factory import make_plan
        >>> from sofnn_torch.runs.settings import Config
        >>> make_plan(Config()).size
        (1.0, 1.0)
    """

    size: Place
    walls: list[Box]  # x0, y0, x1, y1, outer walls included
    starts: list[Pose]
    goals: list[Place]
    goal_radius: float
    subgoals: list[Place]
    subgoal_radius: float
    start_radius: float  # 0 if starts are no landmarks
    robot_radius: float
    anywhere: bool = False  # trials begin at any pose with room around it
    told: bool = False  # each trial has one of the goals, and the robot is told where it is

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "MazePlan":
        """Read walls, zones, robot size and start poses from named geoms, sites and keyframes.

        Raises:
            KeyError: an element is missing.
            ValueError: what is there is not a maze, in one line.
        """
        walls = _walls(model)
        starts, goals, subgoals = (_zones(model, kind) for kind in ("start", "goal", "subgoal"))
        if not goals:
            raise KeyError("a site called goal")
        poses = []
        for name in _start_keys(model):
            x, y, _, *quaternion = model.key(name).qpos[:7].tolist()
            poses.append((x, y, heading_of(*quaternion)))
        begin, end = (
            _word(model, "start", ("vary", "anywhere")),
            _word(model, "goal", ("any", "vary")),
        )
        for what, places, word in (("start", poses, begin), ("goal", goals, end)):
            if len(places) > 1 and not word:
                raise ValueError(
                    f"there are {len(places)} {what}s and no word on which one is meant"
                )
        plan = cls(
            # The outer walls begin where the arena ends.
            size=(
                round(max(wall[0] for wall in walls), 9),
                round(max(wall[1] for wall in walls), 9),
            ),
            walls=walls,
            starts=poses,
            goals=[place for place, _ in goals],
            goal_radius=_radius("goal", goals),
            subgoals=[place for place, _ in subgoals],
            subgoal_radius=_radius("subgoal", subgoals),
            start_radius=_radius("start", starts),
            robot_radius=model.geom("rim").size.item(0),
            anywhere=begin == "anywhere",
            told=end == "vary",
        )
        plan.check()
        return plan

    @property
    def start(self) -> Pose:
        """The start, or the first of them."""
        return self.starts[0]

    @property
    def goal(self) -> Place:
        """The goal, or the first of them."""
        return self.goals[0]

    def clearance(self, x: float, y: float) -> float:
        """Return the free distance [m] between a robot centred at (x, y) and the nearest wall."""
        return (
            min(
                math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1))
                for x0, y0, x1, y1 in self.walls
            )
            - self.robot_radius
        )

    def has_room(self, x: float, y: float) -> bool:
        """Return whether a robot can stand at (x, y), inside the maze and in no wall."""
        inside = 0.0 < x < self.size[0] and 0.0 < y < self.size[1]
        return inside and self.clearance(x, y) >= 0.0

    def free(self, cell: float, skin: float) -> NDArray[np.bool_]:
        """Return where the robot's centre may be, on a grid over the arena.

        Args:
            cell: distance [m] of the points of the grid, of which the first is at (0, 0).
            skin: distance [m] kept from walls.
        """
        xs, ys = (np.arange(0.0, size + cell, cell) for size in self.size)
        free = np.ones((xs.size, ys.size), dtype=bool)
        radius = self.robot_radius + skin
        for x0, y0, x1, y1 in self.walls:
            dx = np.maximum(np.maximum(x0 - xs, xs - x1), 0.0)
            dy = np.maximum(np.maximum(y0 - ys, ys - y1), 0.0)
            free &= dx[:, None] ** 2 + dy[None, :] ** 2 > radius * radius
        return free

    @functools.cached_property
    def reached(self) -> NDArray[np.bool_]:
        """Where the robot can come from its first start, on a grid of `SPOT`."""
        free = self.free(SPOT, TIGHT)
        i, j = round(self.start[0] / SPOT), round(self.start[1] / SPOT)
        free[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2] = True  # it stands there
        parts, _ = ndimage.label(free)
        return parts == parts[i, j]

    def draw_start(self, rng: np.random.Generator) -> Pose:
        """Return where a trial begins; a single start draws nothing."""
        if not self.anywhere:
            return (
                self.starts[int(rng.integers(len(self.starts)))] if self.starts[1:] else self.start
            )
        for _ in range(TRIES):
            x, y, heading = (rng.random(3) * (*self.size, 2 * math.pi)).tolist()
            inside = self.reached[round(x / SPOT), round(y / SPOT)]
            away = min(math.dist((x, y), goal) for goal in self.goals) > self.goal_radius
            if inside and away and self.clearance(x, y) > ROOM:
                return x, y, wrap_angle(heading)
        return self.start  # of a maze without any such place

    def check(self) -> None:
        """Raise ValueError, one line, if no robot could drive in this maze from start to goal."""
        low = min(wall[2] for wall in self.walls), min(wall[3] for wall in self.walls)
        if max(map(abs, low)) > 1e-6:
            raise ValueError(f"the floor must begin at (0, 0), not at ({low[0]:g}, {low[1]:g}) m")
        if not 0.0 < max(self.size) <= LARGEST:
            raise ValueError(
                f"the floor must be at most {LARGEST:g} m long, not {max(self.size):g}"
            )
        places = [("start", pose[:2]) for pose in self.starts]
        places += [("goal", place) for place in self.goals]
        for what, (x, y) in places:
            if not self.has_room(x, y):
                raise ValueError(f"the {what} at ({x:g}, {y:g}) m is in a wall or close to one")
        reached = self.reached
        if reached[0].any() or reached[-1].any() or reached[:, 0].any() or reached[:, -1].any():
            raise ValueError("the robot could leave the maze: walls must surround its floor")
        i, j = (np.arange(n) * SPOT for n in reached.shape)
        for x, y in self.goals:
            near = (i[:, None] - x) ** 2 + (j[None, :] - y) ** 2 <= self.goal_radius**2
            if not (reached & near).any():
                gap = 1e3 * 2 * (self.robot_radius + TIGHT)
                raise ValueError(
                    f"the goal at ({x:g}, {y:g}) m cannot be reached from the start: "
                    f"a way must be {gap:.0f} mm wide"
                )
        for x, y, _ in self.starts[1:]:
            if not reached[round(x / SPOT), round(y / SPOT)]:
                raise ValueError(
                    f"from the start at ({x:g}, {y:g}) m no way leads to the first one"
                )


def _walls(model: mujoco.MjModel) -> list[Box]:
    """The boxes of all geoms that stop the robot."""
    walls = []
    for geom in (model.geom(i) for i in range(model.ngeom)):
        if geom.bodyid.item() == 0 and geom.name != "floor":
            stops = (geom.contype.item() | geom.conaffinity.item()) != 0
            if stops and not geom.name.startswith("wall"):
                raise ValueError(
                    f"the geom {geom.name!r} stops the robot: its name must be wall..."
                )
        if geom.name.startswith("wall"):
            turned = np.abs(geom.quat[1:]).max() > 1e-6 or geom.bodyid.item() != 0
            if geom.type.item() != mujoco.mjtGeom.mjGEOM_BOX or turned:
                raise ValueError(f"{geom.name} is no box along the axes of the maze")
            (x, y, _), (a, b, _) = geom.pos.tolist(), geom.size.tolist()
            walls.append((x - a, y - b, x + a, y + b))
    if not walls:
        raise KeyError("a geom whose name begins with wall")
    return walls


def _zones(model: mujoco.MjModel, kind: str) -> list[tuple[Place, float]]:
    """Places and radii of the zones of a kind, by their numbers."""
    found: dict[int, tuple[Place, float]] = {}
    for site in (model.site(i) for i in range(model.nsite)):
        if site.bodyid.item() != 0 or not site.name:
            continue
        name = ZONE.fullmatch(site.name)
        if name is None:
            raise ValueError(
                f"the site {site.name!r} is not understood: start, goal and subgoal_1, subgoal_2, "
                "... are; decoration has no name"
            )
        if name[1] == kind and not name[3]:
            place: Any = tuple(site.pos[:2].tolist())
            found[int(name[2][1:] or 1)] = place, site.size.item(0)
    return [found[number] for number in sorted(found)]


def _radius(kind: str, zones: list[tuple[Place, float]]) -> float:
    radii = {radius for _, radius in zones}
    if len(radii) > 1:
        raise ValueError(f"all {kind}s must have one radius, not {sorted(radii)}")
    return radii.pop() if radii else 0.0


def _start_keys(model: mujoco.MjModel) -> list[str]:
    """Names of the keyframes of starts, by their numbers."""
    names = [model.key(i).name for i in range(model.nkey)]
    more = [name for name in names if re.fullmatch(r"start_[1-9]\d*", name)]
    return ["start", *sorted(more, key=lambda name: int(name[6:]))]


def _word(model: mujoco.MjModel, name: str, words: tuple[str, ...]) -> str:
    """What the model says of several starts or goals; empty if nothing."""
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, name)
    if number < 0:
        return ""
    begin, size = model.text_adr[number], model.text_size[number]
    word = bytes(model.text_data[begin : begin + size]).rstrip(b"\0").decode(errors="replace")
    if word not in words:
        raise ValueError(f"the text {name} must be {' or '.join(words)}, not {word[:20]!r}")
    return word
