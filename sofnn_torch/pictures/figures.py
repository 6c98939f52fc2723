"""Pictures of a run: maze, trajectory, rules, policy, value, learning curves, pose error.

Every function draws on the matplotlib axes that it is given and keeps no state; `canvas` makes a
figure without a window. Colours are those of Okabe and Ito, which colour-blind readers can tell
apart; line style, marker or direction says the same again for print in grey.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import (
    LogLocator,
    MaxNLocator,
    MultipleLocator,
    NullFormatter,
    StrMethodFormatter,
)
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.spaces import motion
from sofnn_torch.numerals import decimal
from sofnn_torch.runs.table import read as read_trials

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

    from sofnn_torch.maze.plan import MazePlan
    from sofnn_torch.runs.trial import Trajectory

BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, SKY, BLACK = "#CC79A7", "#56B4E9", "#000000"
SERIES = [(BLUE, "-"), (VERMILION, "--"), (GREEN, "-."), (PURPLE, ":"), (BLACK, (0, (5, 1, 1, 1)))]
DEPTHS = LinearSegmentedColormap.from_list("depths", ["white", SKY, "#409CD8"])  # low to high value
TURNS = LinearSegmentedColormap.from_list("turns", [BLUE, BLACK, ORANGE])  # right, straight, left
MARKS = ((BLUE, ">", "right turn"), (BLACK, "o", "straight"), (ORANGE, "<", "left turn"))
FEWEST = 5  # seeds that quartiles can describe
BAND = "line: median; band: quartiles; faint: each seed"
STYLE: "dict[RcKeyType, Any]" = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "legend.title_fontsize": 7,
    "legend.frameon": False,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
}


styled = matplotlib.rc_context(STYLE)  # as a decorator: in force while a function draws


@styled
def canvas(
    count: int = 1,
    width: float = 3.5,
    height: float = 3.5,
    tight: bool = True,
    columns: int | None = None,
) -> tuple[Figure, list[Axes]]:
    """A figure with so many axes; width and height of one of them in inches.

    They stand side by side, or in rows of so many columns. Without `tight` it has fixed margins,
    which is twice as fast.
    """
    columns = min(columns or count, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(columns * width, rows * height))
    figure.set_layout_engine("compressed" if tight else "none")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def png(figure: Figure, dpi: int = 120) -> bytes:
    """The figure as a PNG file."""
    return saved(figure, "png", dpi)


def saved(figure: Figure, kind: str, dpi: int = 200) -> bytes:
    """The figure as a file: png, svg or pdf."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi)
    return buffer.getvalue()


# ------------------------------------------------------------------------------ in the maze


@styled
def maze_plan(plan: "MazePlan", ax: Axes, labels: bool = True) -> None:
    """Draw walls, start, sub-goals and goal; axes in metres."""
    for x0, y0, x1, y1 in plan.walls:
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor="0.3", linewidth=0, zorder=2))
    for number, centre in enumerate(plan.subgoals, 1):
        _spot(ax, centre, plan.subgoal_radius, "0.35", ":", f"sub-goal {number}" if labels else "")
    for goal in plan.goals:
        _spot(ax, goal, plan.goal_radius, "#006B4E", "-", "goal" if labels else "")
    for x, y, heading in [] if plan.anywhere else plan.starts:
        _spot(ax, (x, y), plan.start_radius, "0.6", "-", "start" if labels else "")
        ax.add_patch(Circle((x, y), plan.robot_radius, fill=False, edgecolor=BLACK, zorder=3))
        tip = plan.robot_radius * np.array([math.cos(heading), math.sin(heading)])
        ax.plot([x, x + tip[0]], [y, y + tip[1]], color=BLACK, linewidth=1.2, zorder=4)
    x0, y0, x1, y1 = bounds(plan)
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    tick = 0.2 * math.ceil(max(plan.size) / 1.2)
    ax.xaxis.set_major_locator(MultipleLocator(tick))
    ax.yaxis.set_major_locator(MultipleLocator(tick))
    ax.spines[["left", "bottom"]].set_visible(False)


def bounds(plan: "MazePlan") -> tuple[float, float, float, float]:
    """The rectangle around all walls: x0, y0, x1, y1 in metres."""
    walls = np.array(plan.walls)
    return *walls[:, :2].min(0).tolist(), *walls[:, 2:].max(0).tolist()


def _spot(
    ax: Axes, centre: tuple[float, float], radius: float, colour: str, line: Any, text: str
) -> None:
    fill = Circle(centre, radius, facecolor=colour, alpha=0.12, linewidth=0, zorder=1)
    edge = Circle(centre, radius, fill=False, edgecolor=colour, linestyle=line, zorder=3)
    ax.add_patch(fill)
    ax.add_patch(edge)
    halo = [withStroke(linewidth=2, foreground="white")]
    style = {"ha": "center", "va": "bottom", "zorder": 6, "path_effects": halo}
    _note(ax, text, (centre[0], centre[1] + radius), 2, **style)


def _note(ax: Axes, text: str, at: tuple[float, float], shift: float, **style: Any) -> None:
    """Small text, shifted upwards by some points."""
    style = {"fontsize": 7, "color": "0.2", "textcoords": "offset points", **style}
    ax.annotate(text, at, (0, shift), **style)


@styled
def trajectory(plan: "MazePlan", path: "Trajectory", ax: Axes) -> None:
    """The true path with its estimate, and a heading tick at every decision."""
    maze_plan(plan, ax, labels=False)  # the path would run through them
    ax.plot(*path.true[:, :2].T, color=BLUE, linewidth=1.4, zorder=4, label="true")
    ax.plot(
        *path.estimated[:, :2].T,
        color=VERMILION,
        linewidth=1,
        linestyle=(0, (3, 1.5)),
        zorder=5,
        label="estimated",
    )
    _headings(ax, path.true, 0.018, colors=BLUE, linewidths=0.8, zorder=4)
    ax.plot(*path.true[-1, :2], "o", color=BLUE, markersize=3.5, zorder=6)
    _legend_above(ax)


def _headings(ax: Axes, poses: NDArray[Any], length: float, **style: Any) -> LineCollection:
    """A short line at each pose (T, 3) towards its heading."""
    ends = poses[:, :2] + length * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    lines = LineCollection(list(np.stack([poses[:, :2], ends], 1)), **style)
    ax.add_collection(lines, autolim=False)
    return lines


def _legend_above(ax: Axes) -> Legend:
    return ax.legend(
        loc="lower left", bbox_to_anchor=(0, 1), ncols=4, borderaxespad=0.2, handlelength=2.2
    )


def _turn_legend(ax: Axes, line: str = "") -> Legend:
    """What the colours mean, and the marks of a map of rules, which has no lines."""
    for colour, mark, name in MARKS:
        ax.plot([], [], line or mark, color=colour, markersize=4, label=name)
    return _legend_above(ax)


@styled
def rule_map(
    plan: "MazePlan", agent: Learner, ax: Axes, weights: NDArray[Any] | None = None
) -> Legend:
    """Every rule at its centre, a tick towards its heading, colour and mark of the action there.

    Args:
        plan: the maze.
        agent: the learner.
        ax: where to draw.
        weights: a use of each rule (`usage`), which sets the size of its mark. Shape: (K,).

    Returns:
        The legend of the colours.
    """
    maze_plan(plan, ax, labels=False)
    centres = agent.net.centres[:, : len(agent.task.axes)].double().numpy()
    _, turn = motion(agent.plan(centres).actions)
    colours = TURNS(Normalize(-1, 1)(turn))
    sizes = np.full(len(centres), 6.0)
    if weights is not None:
        sizes = 2 + 18 * np.sqrt(weights / max(weights.max(), 1e-12))
    _headings(ax, centres, 0.02, colors=colours, linewidths=0.7, zorder=4)
    x, y = centres[:, :2].T
    dots = ax.scatter(x, y, s=sizes, c=colours, alpha=0.75, linewidths=0, zorder=4)
    marks = [MarkerStyle(mark) for _, mark, _ in MARKS]
    shapes = [mark.get_path().transformed(mark.get_transform()) for mark in marks]
    dots.set_paths([shapes[i] for i in np.rint(np.clip(turn, -1, 1)).astype(int) + 1])
    return _turn_legend(ax)


@styled
def memberships(agent: Learner, i: int, ax: Axes, names: Mapping[int, str]) -> None:
    """Membership functions (eq. 1) of some rules on input i.

    Args:
        agent: the learner.
        i: number of the input.
        ax: where to draw.
        names: the rules and how the legend names them.

    Raises:
        ValueError: there are more rules than line styles.
    """
    if len(names) > len(SERIES):
        raise ValueError(f"at most {len(SERIES)} rules can be told apart, got {len(names)}")
    axis = agent.inputs[i]
    x, turns = np.linspace(axis.low, axis.high, 400), axis.unit == "rad"
    scale = 180 / math.pi if turns else 1.0
    for (rule, name), (colour, line) in zip(names.items(), SERIES, strict=False):
        distance = x - agent.net.centres[rule, i].item()
        if axis.period:
            distance -= axis.period * np.round(distance / axis.period)
        curve = np.exp(-0.5 * (distance / agent.net.widths[rule, i].item()) ** 2)
        ax.plot(scale * x, curve, color=colour, linestyle=line, linewidth=1.4, label=name)
    unit, acting = "degrees" if turns else axis.unit, i >= len(agent.task.axes)
    label = f"{axis.name} [{unit}]" if unit else axis.name
    if acting:
        first, last = agent.task.actions[0], agent.task.actions[-1]
        label = f"{axis.name}: {first} (-1) to {last} (1)"
    limits = (scale * axis.low, scale * axis.high)
    ax.set(xlabel=label, xlim=limits, ylim=(0, 1.05), yticks=(0, 1))
    ax.xaxis.set_major_locator(MultipleLocator(90) if turns else MaxNLocator(6))


@styled
def rules(
    plan: "MazePlan",
    agent: Learner,
    weights: NDArray[Any],
    texts: Sequence[str],
) -> Figure:
    """All rules on the maze, and the membership functions of those with the largest weights.

    Args:
        plan: the maze.
        agent: the learner.
        weights: a use of each rule (`usage`). Shape: (K,).
        texts: what each rule concludes, in words. K of them.
    """
    figure = Figure(figsize=(7.2, 3.9), layout="compressed")
    inputs = agent.net.n_inputs
    cells = figure.add_gridspec(inputs, 2, width_ratios=[1.2, 1])
    ax = figure.add_subplot(cells[:, 0])
    legend = rule_map(plan, agent, ax, weights)
    legend.set_title("all rules together, at each centre", FontProperties(size=8))
    legend.set_alignment("left")
    best = np.argsort(-weights, kind="stable")[: len(SERIES)].tolist()
    names = {rule: f"rule {rule + 1}: {texts[rule]}" for rule in best}
    for rule in best:
        x, y = agent.net.centres[rule, :2].tolist()
        ax.add_patch(Circle((x, y), 0.02, fill=False, edgecolor=PURPLE, linewidth=1.4, zorder=7))
        halo = [withStroke(linewidth=2, foreground="white")]
        _note(ax, str(rule + 1), (x, y), 7, ha="center", path_effects=halo, zorder=7)
    for i in range(inputs):
        ax = figure.add_subplot(cells[i, 1])
        memberships(agent, i, ax, names)
        if i == inputs // 2:
            ax.set_ylabel("membership")
        if i == 0:
            ax.legend(
                title="rules that fire most, each by itself",
                title_fontsize=8,
                loc="lower left",
                bbox_to_anchor=(-0.04, 1),
                alignment="left",
                ncols=2,
                handlelength=2,
                columnspacing=1,
                handletextpad=0.5,
            )
    return figure


def _states(plan: "MazePlan", poses: NDArray[Any]) -> NDArray[Any]:
    """What a learner is told at poses (P, 3): where goals vary, that the first is meant."""
    return np.hstack([poses, np.tile(plan.goal, (len(poses), 1))]) if plan.told else poses


def _grid(plan: "MazePlan", columns: int, headings: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Poses on a regular grid (P * headings, 3) and which positions a robot can stand on (P,)."""
    x0, y0, x1, y1 = bounds(plan)
    step = (x1 - x0) / columns
    xs, ys = np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step)
    angles = np.linspace(-math.pi, math.pi, headings, endpoint=False)
    x, y, heading = np.meshgrid(xs, ys, angles, indexing="xy")  # (rows, columns, headings)
    poses = np.column_stack([x.ravel(), y.ravel(), heading.ravel()])
    free = np.ones(len(xs) * len(ys), bool)
    for left, low, right, high in plan.walls:
        nearest = np.clip(poses[::headings, :2], (left, low), (right, high))
        free &= np.hypot(*(poses[::headings, :2] - nearest).T) > 0.3 * plan.robot_radius
    return poses, free


@styled
def action_field(
    plan: "MazePlan", agent: Learner, ax: Axes, columns: int = 10, headings: int = 8
) -> None:
    """The policy: at each position a rosette of headings, and where they lead.

    A spoke starts at the position towards its heading. It points outwards if the robot would go
    straight there, and bends to the side that it would turn to. The arrow is the mean motion over
    all headings.
    """
    maze_plan(plan, ax, labels=False)
    poses, free = _grid(plan, columns, headings)
    mask = np.repeat(free, headings)
    poses = poses[mask]
    forward, turn = motion(agent.plan(_states(plan, poses)).actions)
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    step = np.ptp(bounds(plan)[::2]) / columns
    begin = poses[:, :2] + 0.18 * step * ahead
    colours = TURNS(Normalize(-1, 1)(turn))
    forward, turn = np.clip(forward, 0, 1)[:, None], turn[:, None]
    end = begin + 0.24 * step * (forward * ahead + turn * aside)
    lines = list(np.stack([begin, end], 1))
    spokes = LineCollection(lines, colors=colours, linewidths=0.8, zorder=4)
    ax.add_collection(spokes, autolim=False)
    mean = (forward * ahead).reshape(-1, headings, 2).mean(1)
    length = np.hypot(*mean.T)
    ax.quiver(
        *poses[::headings, :2].T,
        *(mean / np.maximum(length, 1e-9)[:, None] * 0.4 * step).T,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.004,
        color=BLACK,
        zorder=5,
        pivot="middle",
    )
    _turn_legend(ax, "-")


@styled
def value_field(
    plan: "MazePlan", agent: Learner, ax: Axes, columns: int = 40, headings: int = 8
) -> None:
    """Value of the best heading at each position.

    Raises:
        ValueError: the learner keeps no value (SGA with a constant baseline).
    """
    poses, _ = _grid(plan, columns, headings)
    value = agent.plan(_states(plan, poses)).value
    if value is None:
        raise ValueError("this learner keeps no value: it was trained with --sga.baseline constant")
    picture = value.reshape(-1, columns, headings).max(2)
    x0, y0, x1, _ = bounds(plan)
    area = (x0, x1, y0, y0 + len(picture) * (x1 - x0) / columns)
    image = ax.imshow(picture, DEPTHS, origin="lower", extent=area, interpolation="bilinear")
    ax.contour(picture, 8, extent=area, colors="0.3", linewidths=0.4)
    maze_plan(plan, ax, labels=False)
    ax.figure.colorbar(image, ax=ax, shrink=0.8, label="value of the best heading")


# --------------------------------------------------------------------------------- over time


def read_column(path: Path, column: str) -> NDArray[np.float64]:
    """One column of a ``trials.csv``; True and False become 1 and 0. Shape: (trials,).

    Raises:
        ValueError: the file has no such column or no trial, or a cell that is no number.
    """
    try:
        rows = list(csv.DictReader(read_trials(path.read_bytes())[0]))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not rows or column not in rows[0]:
        raise ValueError(f"{path} has no trial with a column {column!r}")
    words = {"True": 1.0, "False": 0.0, "nan": math.nan, "inf": math.inf, "-inf": -math.inf}
    cells = [row[column] for row in rows]
    try:
        return np.array([words[cell] if cell in words else decimal(cell) for cell in cells])
    except ValueError as error:
        raise ValueError(f"{path}: {column} {error}") from None


def logarithmic(ax: Axes, subs: Sequence[float] = (1, 2, 3, 5)) -> None:
    """A logarithmic vertical axis with plain numbers at some multiples of powers of ten."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=subs))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


@styled
def learning_curves(
    arms: Mapping[str, Sequence[Path | NDArray[Any]]],
    ax: Axes,
    column: str = "steps",
    label: str = "steps to the goal",
    reference: tuple[str, float] | None = None,
) -> None:
    """Median and interquartile band over seeds for each arm, every seed drawn faintly.

    Of fewer than five seeds, which no band describes, each seed is a line.

    Args:
        arms: name of each arm and the ``trials.csv`` of its seeds, or their columns (trials,);
            the shortest ends the median.
        ax: where to draw.
        column: column of the file.
        label: label of the vertical axis, with its unit.
        reference: name and height of a horizontal line, e.g. the maze's optimum.

    Raises:
        ValueError: a file has no such column, or there are more arms than line styles.
    """
    if len(arms) > len(SERIES):
        raise ValueError(f"at most {len(SERIES)} arms can be told apart, got {len(arms)}")
    title = None
    for (name, runs), (colour, line) in zip(arms.items(), SERIES, strict=False):
        curves = [run if isinstance(run, np.ndarray) else read_column(run, column) for run in runs]
        many = len(curves) >= FEWEST
        single: dict[str, Any] = {"linestyle": line, "linewidth": 1, "zorder": 4}
        if many:
            single = {"linewidth": 0.4, "alpha": 0.3, "zorder": 2}
        for curve in curves:
            (drawn,) = ax.plot(np.arange(1, len(curve) + 1), curve, color=colour, **single)
        if many:
            length = min(map(len, curves))
            table, trials = np.array([c[:length] for c in curves]), np.arange(1, length + 1)
            low, median, high = np.quantile(table, [0.25, 0.5, 0.75], axis=0)
            ax.fill_between(trials, low, high, color=colour, alpha=0.2, linewidth=0, zorder=3)
            (drawn,) = ax.plot(
                trials, median, color=colour, linestyle=line, linewidth=1.4, zorder=4
            )
            title = BAND
        drawn.set_label(f"{name} ({len(curves)} seeds)" if len(curves) > 1 else name)
    if reference is not None:
        ax.axhline(reference[1], color="0.3", linewidth=0.8, linestyle=(0, (1, 2)))
        place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
        _note(ax, reference[0], (1, reference[1]), -2, **place)
    if column == "steps":
        logarithmic(ax)
        if reference is not None:
            ax.set_ylim(bottom=0.75 * reference[1])
    ax.set(xlabel="trial", ylabel=label)
    ax.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 2.5, 5, 10], integer=True))
    ax.margins(x=0.01)
    ax.legend(title=title, alignment="left")


@styled
def pose_error(path: "Trajectory", ax: Axes, plan: "MazePlan | None" = None) -> None:
    """Distance between true and estimated position along a trial, sub-goals shaded."""
    error = 1000 * np.hypot(*(path.true - path.estimated)[:, :2].T)
    before = -math.inf
    subgoals, radius = (plan.subgoals, plan.subgoal_radius) if plan else ([], 0.0)
    for number, centre in enumerate(subgoals, 1):
        inside = np.hypot(*(path.true[:, :2] - centre).T) < radius
        edges = np.flatnonzero(np.diff(inside, prepend=False, append=False)).reshape(-1, 2)
        for first, last in edges:
            ax.axvspan(first - 0.5, last - 0.5, color="0.88", zorder=0)
        if len(edges):
            place = {"xycoords": ("data", "axes fraction"), "ha": "center"}
            middle = edges[0].mean() - 0.5
            shift = 10 if abs(middle - before) < len(error) / 5 else 2  # above a label beside it
            _note(ax, f"sub-goal {number}", (middle, 1), shift, **place)
            before = middle
    ax.plot(error, color=BLUE, linewidth=1.2)
    ax.set(
        xlabel="decision", ylabel="error of the estimated position [mm]", xlim=(0, len(error) - 1)
    )
    ax.set_ylim(bottom=0)
