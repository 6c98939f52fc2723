"""Mazes as text: maps of one character for each cell, MJCF files, and the mazes that are built in.

A map is what a newcomer draws; north is up, and lines before it say what it cannot show:

    ; a comment
    cell 0.1
    ..........
    .>....1...
    #######...
    .G....2...
    ..........

`#` is wall and `.` floor. `>`, `^`, `<` and `v` are a start with its heading, `G` is a goal, and
`1` to `9` are sub-goals, each at the middle of its cell of `cell` metres (0.05 if not given). An
outer wall is put around all. `start vary` allows several starts, of which each trial draws one;
with `start anywhere` it begins at any pose with room around it. `goal any` allows several goals, of
which the first that is reached ends the trial; with `goal vary` each trial draws one, and the robot
is told where it is.

All behind this module reads the MJCF that `mjcf` makes of a map: the robot, the light and the
cameras of the standard maze, with other walls and zones. A maze that is built in is a file in
`assets/mazes`.
"""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

STANDARD = "s"  # the maze of the paper's section 5, as far as it is known
RANDOM = re.compile(r"random:(\d{1,9})")
LARGEST = 2**20  # characters of a layout
MOST_CELLS = 200  # along a side
MOST_METRES = 10.0
CELL = 0.05  # m
HEADINGS = {">": 0.0, "^": 0.5 * np.pi, "<": np.pi, "v": -0.5 * np.pi}
MARKS = "#.G123456789" + "".join(HEADINGS)
WORDS = {"start": ("vary", "anywhere"), "goal": ("any", "vary")}
KNOWN = "cell METRES, start vary, start anywhere, goal any, goal vary, ; COMMENT"
LEGEND = "# is wall, . floor, > ^ < v a start, G a goal and 1 to 9 a sub-goal"
WALL = 0.01  # m, half the thickness of the outer walls and half the height of all
SUBGOAL_RADIUS, START_RADIUS, GOAL_RADIUS = 0.08, 0.08, 0.06  # m

Place = tuple[float, float]
Box = tuple[float, float, float, float]


@dataclass
class Map:
    """A maze as it was drawn, in metres from the south-western corner of its floor."""

    size: Place
    walls: list[Box]  # x0, y0, x1, y1; without the outer ones
    starts: list[tuple[float, float, float]]
    goals: list[Place]
    subgoals: list[Place]
    words: dict[str, str] = field(default_factory=dict)  # of `WORDS`


def assets() -> Path:
    """The folder of models and mazes, of the installed package or the checkout around it."""
    package = Path(str(resources.files("sofnn_torch")))
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent / "assets"


def standard_path() -> Path:
    """The MJCF of the standard maze."""
    return assets() / "khepera_maze.xml"


def built_in() -> list[str]:
    """The names of the mazes that are built in, but those of `random:SEED`."""
    return [STANDARD, *sorted(path.stem for path in (assets() / "mazes").glob("*.txt"))]


def content(layout: Any) -> str:
    """A layout as it is kept: the name of a maze that is built in, or the text of a map or an MJCF.

    Args:
        layout: one of them, or the path of a file with such a text.

    Raises:
        ValueError: there is no such maze and no such file.
    """
    if not isinstance(layout, str | Path):
        raise ValueError(f"must be a name, a file or a text, not {str(layout)[:40]!r}")
    text = str(layout)
    if text in built_in() or RANDOM.fullmatch(text) or "\n" in text:
        return _short(text)
    try:
        with open(text, encoding="utf-8-sig") as file:
            return _short(file.read(LARGEST + 1)).rstrip() + "\n"
    except UnicodeDecodeError:
        raise ValueError(f"{text} is no text file") from None
    except (OSError, ValueError) as error:
        if "characters" in str(error):
            raise ValueError(f"{text}: {error}") from None
        names = ", ".join(built_in())
        raise ValueError(f"neither a file nor one of {names}, random:SEED") from None


def mjcf(layout: str) -> str:
    """The MJCF of a layout as `content` returns it.

    Raises:
        ValueError: one line on what is wrong in a map, or an MJCF that needs other files.
    """
    standard = standard_path().read_text()
    if layout == STANDARD:
        return standard
    if layout.lstrip().startswith("<"):
        return _alone(layout)
    if found := RANDOM.fullmatch(layout):
        layout = random_map(int(found[1]))
    elif "\n" not in layout:
        layout = (assets() / "mazes" / f"{layout}.txt").read_text()
    return build(parse(layout), standard)


def parse(text: str) -> Map:
    """Read a map.

    Raises:
        ValueError: one line on what is wrong with it, and where.
    """
    words, rows, first = _split(text)
    cell = words.pop("cell", CELL)
    height, width = len(rows), len(rows[0])
    if max(height, width) > MOST_CELLS or max(height, width) * cell > MOST_METRES:
        raise ValueError(
            f"{width} x {height} cells of {cell:g} m are too many: at most {MOST_CELLS} and "
            f"{MOST_METRES:g} m along a side"
        )
    found: dict[str, list[tuple[int, int]]] = {}
    for i, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(
                f"line {first + i} has {len(row)} cells and line {first} has {width}: all lines of "
                "the map must be equally long"
            )
        for j, mark in enumerate(row):
            if mark not in MARKS:
                raise ValueError(f"line {first + i}, column {j + 1}: {mark!r} is no cell: {LEGEND}")
            found.setdefault(mark, []).append((i, j))
    starts = [(mark, place) for mark in HEADINGS for place in found.get(mark, [])]
    goals = found.get("G", [])
    _count("start", [place for _, place in starts], words, first)
    _count("goal", goals, words, first)
    numbers = [mark for mark in "123456789" if mark in found]
    for number, mark in enumerate(numbers, 1):
        if mark != str(number) or len(found[mark]) > 1:
            raise ValueError(f"sub-goals must be numbered 1, 2, ... once each: {mark} is not")

    def middle(place: tuple[int, int]) -> Place:
        return round((place[1] + 0.5) * cell, 9), round((height - place[0] - 0.5) * cell, 9)

    wall = np.array([[mark == "#" for mark in row] for row in rows])[::-1]
    return Map(
        size=(round(width * cell, 9), round(height * cell, 9)),
        walls=[tuple(round(edge * cell, 9) for edge in box) for box in _boxes(wall)],
        starts=[(*middle(place), float(HEADINGS[mark])) for mark, place in starts],
        goals=[middle(place) for place in goals],
        subgoals=[middle(found[mark][0]) for mark in numbers],
        words=words,
    )


def build(plan: Map, standard: str) -> str:
    """The MJCF of a map, made from the standard maze's by other walls, zones and views."""
    root = ET.fromstring(standard)
    world, keys = root.find("worldbody"), root.find("keyframe")
    assert world is not None and keys is not None
    for element in [*world.findall("geom"), *world.findall("site")]:
        if element.get("name") != "floor":
            world.remove(element)
    keys.clear()
    (width, height), long = plan.size, max(plan.size)
    centre = np.array([width / 2, height / 2, 0.0])

    def put(tag: str, name: str | None = None, **attributes: Any) -> None:
        element = next(e for e in root.iter(tag) if e.get("name") == name)
        for attribute, numbers in attributes.items():
            element.set(attribute, " ".join(f"{number:.9g}" for number in numbers))

    put("statistic", center=centre, extent=[1.1 * long])
    put("light", "sun", pos=centre + long * np.array([-1.1, -1.4, 2.6]))
    put("camera", "top", pos=centre + [0, 0, (long / 2 + 2 * WALL) / 0.52 * 2.96 + 4 * WALL])
    put("geom", "floor", pos=centre, size=[width / 2 + 0.1, height / 2 + 0.1, 0.01])
    put("body", "khepera", pos=[*plan.starts[0][:2], 0])

    def add(tag: str, name: str, at: Place, size: list[float], **words: str) -> None:
        style, z = ("wall", 2 * WALL) if tag == "geom" else ("zone", 0)
        element = ET.SubElement(world, tag, {"name": name, "class": style, **words})
        for attribute, numbers in (("pos", [*at, z]), ("size", size)):
            element.set(attribute, " ".join(f"{number:.9g}" for number in numbers))

    t = 2 * WALL
    outer = {
        "south": (-t, -t, width + t, 0.0),
        "north": (-t, height, width + t, height + t),
        "west": (-t, 0.0, 0.0, height),
        "east": (width, 0.0, width + t, height),
    }
    inner = {str(number): box for number, box in enumerate(plan.walls, 1)}
    for name, (x0, y0, x1, y1) in (outer | inner).items():
        half = [(x1 - x0) / 2, (y1 - y0) / 2, t]
        add("geom", f"wall_{name}", ((x0 + x1) / 2, (y0 + y1) / 2), half)
    for number, (x, y, heading) in enumerate(plan.starts, 1):
        name = "start" if number == 1 else f"start_{number}"
        if plan.words.get("start") != "anywhere":
            add("site", name, (x, y), [START_RADIUS, 0.0003], material="start")
        turned = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
        pose = " ".join(f"{number:.17g}" for number in [x, y, 0, *turned, 0, 0])
        ET.SubElement(keys, "key", {"name": name, "qpos": pose})
    for number, at in enumerate(plan.subgoals, 1):
        size = [SUBGOAL_RADIUS, 0.0003]
        add("site", f"subgoal_{number}", at, size, material="subgoal")
    for number, at in enumerate(plan.goals, 1):
        name = "goal" if number == 1 else f"goal_{number}"
        add("site", name, at, [GOAL_RADIUS, 0.0003], material="goal")
        add("site", f"{name}_ring", at, [0.04, 0.0005], material="goal_ring")
        add("site", f"{name}_centre", at, [0.02, 0.0007], material="goal")
    custom = ET.SubElement(root, "custom")
    for name, word in plan.words.items():
        ET.SubElement(custom, "text", {"name": name, "data": word})
    ET.indent(root)
    return ET.tostring(root, "unicode")


def random_map(seed: int, rooms: int = 3, lane: int = 5) -> str:
    """A maze without circles as a map, by a random walk that goes back where it is stuck.

    The goal is in the room farthest from the start in the south-west, sub-goals on the way to it.

    Args:
        seed: of the walk.
        rooms: along each side.
        lane: cells of 0.06 m along the side of a room.
    """
    rng, pitch = np.random.default_rng(seed), lane + 1
    cells = np.full((rooms * pitch - 1,) * 2, "#")
    way, ways = [(0, 0)], {(0, 0): [(0, 0)]}
    while way:
        x, y = way[-1]
        cells[y * pitch : y * pitch + lane, x * pitch : x * pitch + lane] = "."
        sides = [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)]
        new = [p for p in sides if min(p) >= 0 and max(p) < rooms and p not in ways]
        if not new:
            way.pop()
            continue
        u, v = new[rng.integers(len(new))]
        low, side = np.minimum((x, y), (u, v)) * pitch, (lane, lane + pitch)
        cells[low[1] : low[1] + side[v != y], low[0] : low[0] + side[u != x]] = "."
        way.append((u, v))
        ways[u, v] = [*way]
    longest = max(ways.values(), key=len)
    half, last = lane // 2, len(longest) - 1
    marks = {0: ">^"[longest[1][1]], last: "G", last // 3: "1", 2 * last // 3: "2"}
    for i, mark in marks.items():
        x, y = longest[i]
        cells[y * pitch + half, x * pitch + half] = mark
    rows = ["".join(row) for row in cells[::-1]]
    return "\n".join([f"; random:{seed}", "cell 0.06", *rows, ""])


def _split(text: str) -> tuple[dict[str, Any], list[str], int]:
    """What the lines before the map say, the lines of the map, and the number of its first."""
    lines = [line.rstrip() for line in _short(text).splitlines()]
    words: dict[str, Any] = {}
    for i, line in enumerate(lines):
        name, _, value = line.partition(" ")
        if not line or line.startswith(";"):
            continue
        if name == "cell" and re.fullmatch(r"\d*\.?\d+", value) and 0.01 <= float(value) <= 1:
            words["cell"] = float(value)
        elif name == "cell":
            raise ValueError(f"line {i + 1}: a cell must be 0.01 to 1 m long, not {value[:20]!r}")
        elif value in WORDS.get(name, ()):
            words[name] = value
        elif set(line) & set("#.") and " " not in line:
            rows = "\n".join(lines[i:]).rstrip("\n").split("\n")
            return words, rows, i + 1
        else:
            raise ValueError(f"line {i + 1}: {line[:30]!r} is not one of {KNOWN}")
    raise ValueError(f"there is no map: {LEGEND}")


def _count(what: str, places: list[tuple[int, int]], words: dict[str, Any], first: int) -> None:
    """Raise ValueError if there is no start or goal, or more than one where one is meant."""
    if not places:
        signs = "one of > ^ < v" if what == "start" else "G"
        raise ValueError(f"there is no {what}: mark it with {signs}")
    if len(places) > 1 and what not in words:
        where = " and ".join(f"line {first + i}, column {j + 1}" for i, j in sorted(places)[:2])
        ways = " or ".join(f"'{what} {word}'" for word in WORDS[what][: 1 + (what == "goal")])
        raise ValueError(f"there are {len(places)} {what}s, at {where}: leave one, or say {ways}")


def _boxes(wall: Any) -> list[Any]:
    """Few rectangles (x0, y0, x1, y1) of cells that cover all walls and nothing else."""
    rest, boxes = wall.copy(), []
    for y, x in np.argwhere(wall):
        if not rest[y, x]:
            continue
        wide = _run(wall[y, x:])
        tall = _run(wall[y:, x])
        across = _run(wall[y:, x : x + wide].all(1)), wide
        along = tall, _run(wall[y : y + tall, x:].all(0))
        high, broad = max(across, along, key=lambda box: box[0] * box[1])
        rest[y : y + high, x : x + broad] = False
        boxes.append((int(x), int(y), int(x + broad), int(y + high)))
    return boxes


def _run(cells: Any) -> int:
    """How many are true before the first that is not."""
    return len(cells) if cells.all() else int(cells.argmin())


def _short(text: str) -> str:
    if len(text) > LARGEST:
        raise ValueError(f"more than {LARGEST:,} characters are too many")
    return text


def _alone(text: str) -> str:
    """An MJCF that needs no other file.

    Raises:
        ValueError: it does, or it is no XML.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ValueError(f"it begins like an MJCF, but is no XML: {error}") from None
    for element in root.iter():
        if element.tag == "include" or any("file" in name for name in element.keys()):  # noqa: SIM118
            raise ValueError(
                f"<{element.tag}> needs another file: a layout must be one file, to be stored with "
                "the run"
            )
    return text
