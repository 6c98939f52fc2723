"""The paper's Figs 6 to 11 from the data of a study, and the figure of the robustness study."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.rendering import OffscreenRenderer, RenderingError
from sofnn_torch.maze.robot import Physics, load_model, plan_of
from sofnn_torch.pictures import figures
from sofnn_torch.plot import smoothed
from sofnn_torch.runs.trial import Trajectory
from sofnn_torch.studies.results import Data
from sofnn_torch.studies.studies import STUDIES
from sofnn_torch.terminal import say

AGENTS = {"sga": "SGA", "q": "Q-learning"}
NETWORKS = {"sofnn": "SOFNN", "fixed": "FSFNN"}
FIRST = 50  # trials that are drawn enlarged
WINDOW = 10  # trials of a success rate
LIMIT = "A trial that ends without the goal counts with its limit."
MARKERS = [("o", 7), ("s", 4), ("^", 5), ("D", 2)]  # hollow: equal values are seen in each other
Caption = tuple[str, str]  # file without suffix, text


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG and SVG, equal figures as equal files."""
    with matplotlib.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(path.with_suffix(".png"), dpi=180)
        figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def draw(out: Path, data: Data) -> list[Caption]:
    """Draw what the data of the study allows; file names and captions."""
    folder = out / "figures"
    captions = []
    for number, figure, text in _figures(data):
        folder.mkdir(exist_ok=True)
        name = f"{data.info['study']}-{number}"
        if figure is not None:
            save(figure, folder / name)
        if (folder / f"{name}.png").exists():
            captions.append((f"figures/{name}", text))
    return captions


def _figures(data: Data) -> Iterator[tuple[str, Figure | None, str]]:
    study = STUDIES[data.info["study"]]
    if study.figures:
        yield from _of_the_paper(data)
    if study.conditions and "conditions" in data.tables:
        text = (
            "Robustness: success (mean over the seeds) and steps (median and interquartile band; a "
            "trial that fails counts with its limit) of the greedy policy in changed conditions; "
            "the axes do not begin at zero."
        )
        yield "conditions", robustness(data), text


def _of_the_paper(data: Data) -> Iterator[tuple[str, Figure | None, str]]:
    plan = plan_of(data.layout)
    yield "fig6", maze(data.layout), "Fig. 6: the maze, as rendered and as a plan."
    optimum = ("kinematic optimum", data.info["optimum"])
    for number, agent in ((7, "sga"), (8, "q")):
        names = {text: f"{agent}-{network}-estimated" for network, text in NETWORKS.items()}
        if arms := _curves(data, names):
            limit = data.info["arms"][names["SOFNN"]]["config"]["maze"]["max_steps"]
            text = f"Fig. {number}: steps to the goal, {AGENTS[agent]}, estimated pose. "
            text += f"{_bands(arms)} {LIMIT} Right: the share of the seeds that reach the goal, "
            text += f"mean of the last {WINDOW} trials."
            figure = learning(arms, optimum, limit)
            yield f"fig{number}", figure, text + _diverged(data, names)
    names = {
        f"{AGENTS[agent]}, {text}": f"{agent}-{network}-estimated"
        for agent in AGENTS
        for network, text in NETWORKS.items()
    }
    if arms := _curves(data, names, "rules"):
        figure, (ax,) = figures.canvas(width=5, height=3.3)
        figures.learning_curves(arms, ax, "rules", "rules")
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        ax.set_ylim(bottom=0)
        _legend_above(ax)
        text = f"Fig. 9: number of rules after each trial, estimated pose. {_bands(arms)}"
        yield "fig9", figure, text + _diverged(data, names)
    poses = {
        agent: {f"{pose} pose": f"{agent}-sofnn-{pose}" for pose in ("estimated", "true")}
        for agent in AGENTS
    }
    panels = {agent: _curves(data, names) for agent, names in poses.items()}
    if all(len(arms) == 2 for arms in panels.values()):
        figure, axes = figures.canvas(2, width=3.8, height=3.3)
        for ax, (agent, arms) in zip(axes, panels.items(), strict=True):
            figures.learning_curves(arms, ax, reference=optimum)
            _legend_above(ax, columns=1)
            ax.set_title(f"{AGENTS[agent]}, SOFNN", y=1.27)
        axes[1].sharey(axes[0])
        every = [*panels["sga"].values(), *panels["q"].values()]
        bands = _bands(dict(enumerate(every)))
        text = f"Fig. 10: steps to the goal with estimated and true pose. {bands} {LIMIT}"
        names = {f"{AGENTS[a]}, {t}": arm for a, arms in poses.items() for t, arm in arms.items()}
        yield "fig10", figure, text + _diverged(data, names)
    paths = {agent: last_paths(data, f"{agent}-sofnn-estimated") for agent in AGENTS}
    if any(paths.values()):
        figure, axes = figures.canvas(2, width=3.8, height=3)
        for ax, (agent, found) in zip(axes, paths.items(), strict=True):
            pose_errors(found, ax, plan)
            ax.set_title(f"{AGENTS[agent]}, SOFNN", y=1.1)
        shown = [ax for ax, found in zip(axes, paths.values(), strict=True) if found]
        right, top = (max(get(ax)[1] for ax in shown) for get in (Axes.get_xlim, Axes.get_ylim))
        for ax in shown:
            ax.set(xlim=(0, right), ylim=(0, top))
        yield (
            "fig11",
            figure,
            "Fig. 11: distance between true and estimated position on the way to the goal in the "
            "last training trial, one point for each decision. Dark: the seed of median length; "
            "faint: the other seeds that reached the goal. Shaded: the dark one is inside a "
            "sub-goal, where the estimate is corrected.",
        )


@figures.styled
def learning(arms: dict[str, Any], optimum: tuple[str, float], limit: int) -> Figure:
    """Steps of all trials, before them those of the first enlarged, and how many seeds arrive."""
    enlarged = max(len(run) for runs in arms.values() for run in runs) > FIRST
    figure, axes = figures.canvas(2 + enlarged, width=3, height=3.1)
    *steps, every, reached = axes
    for first in steps:
        begin = {name: [run[:FIRST] for run in runs] for name, runs in arms.items()}
        figures.learning_curves(begin, first, reference=optimum)
        first.set_title(f"the first {FIRST} trials")
        every.sharey(first)
    figures.learning_curves(arms, every, reference=optimum)
    success_rates(arms, reached, limit)
    lines, names = every.get_legend_handles_labels()
    figure.legend(
        lines, names, loc="outside upper left", ncols=4, title=_title(every), alignment="left"
    )
    for ax in axes:
        if legend := ax.get_legend():
            legend.remove()
    return figure


def success_rates(arms: dict[str, Any], ax: Axes, limit: int) -> None:
    """Share of the seeds whose trials end before the limit, mean of the last ten trials."""
    for (_, runs), (colour, line) in zip(arms.items(), figures.SERIES, strict=False):
        length = min(map(len, runs))
        share = np.mean([run[:length] < limit for run in runs], axis=0)
        rate = 100 * smoothed(share, WINDOW)
        ax.plot(np.arange(1, length + 1), rate, color=colour, linestyle=line, linewidth=1.4)
    ax.set(xlabel="trial", ylabel="seeds that reach the goal [%]", ylim=(0, 103))


def _bands(arms: dict[Any, Any]) -> str:
    """What the lines of learning curves are, for a caption."""
    few = [len(runs) < figures.FEWEST for runs in arms.values()]
    single = "Each line is a seed."
    if all(few):
        return single
    band = f"{figures.BAND[0].upper()}{figures.BAND[1:]}."
    return f"{band} Of fewer than {figures.FEWEST} seeds each is a line." if any(few) else band


def _title(ax: Axes) -> str:
    """Of a legend: what line and band are."""
    legend = ax.get_legend()
    return legend.get_title().get_text() if legend else ""


def _legend_above(ax: Axes, columns: int = 2) -> None:
    """Where it covers nothing; matplotlib's search for such a place is slow with many curves."""
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    title = _title(ax)
    with matplotlib.rc_context(figures.STYLE):
        ax.legend(ncols=columns, title=title, alignment="left", **place)


def _diverged(data: Data, names: dict[str, str]) -> str:
    """For a caption: which curves end early."""
    labels = [label for label, arm in names.items() if data.diverged(arm)]
    return f" {' and '.join(labels)}: the median ends where a seed diverged." * bool(labels)


def _curves(data: Data, names: dict[str, str], quantity: str = "steps") -> dict[str, Any]:
    found = {label: [*data.curves(arm, quantity).values()] for label, arm in names.items()}
    return {label: runs for label, runs in found.items() if runs}


@figures.styled
def maze(layout: str, size: int = 900) -> Figure | None:
    """The maze as it is rendered, beside its plan; None where nothing can be rendered."""
    try:
        physics = Physics(layout)
        renderer = OffscreenRenderer(load_model(layout), size, size)
        picture = renderer.draw(physics.data.qpos)
        renderer.close()
    except RenderingError as error:
        say(f"warning: Fig. 6 is left as it is ({error})")
        return None
    figure, (left, right) = figures.canvas(2)
    left.imshow(picture, extent=(0, 1, 0, 1))
    left.set_axis_off()
    figures.maze_plan(physics.plan, right)
    return figure


def last_paths(data: Data, arm: str) -> dict[int, Trajectory]:
    """The path of the last training trial of each seed that reached the goal in it."""
    rows: dict[int, list[list[float]]] = {}
    names = ("x", "y", "heading", "x_estimated", "y_estimated", "heading_estimated")
    for row in data.tables.get("paths", []):
        if row["arm"] == arm:
            rows.setdefault(int(row["seed"]), []).append([row[name] for name in names])
    tables = {seed: np.array(values) for seed, values in rows.items()}
    return {seed: Trajectory(values[:, :3], values[:, 3:]) for seed, values in tables.items()}


@figures.styled
def pose_errors(paths: dict[int, Trajectory], ax: Axes, plan: MazePlan) -> None:
    """Errors of the estimated position of several seeds, that of median length in front."""
    if not paths:
        ax.text(0.5, 0.5, "no seed reached the goal", ha="center", transform=ax.transAxes)
        ax.set_axis_off()
        return
    order = sorted(paths.values(), key=lambda path: len(path.true))
    chosen = order[(len(order) - 1) // 2]
    figures.pose_error(chosen, ax, plan)
    errors = [1000 * np.hypot(*(path.true - path.estimated)[:, :2].T) for path in order]
    for error, path in zip(errors, order, strict=True):
        if path is not chosen:
            ax.plot(error, color="0.5", linewidth=0.5, alpha=0.5, zorder=1)
    ax.set(xlim=(0, max(map(len, errors)) - 1), ylim=(0, 1.05 * max(map(np.max, errors)) + 0.1))


def _name(arm: str) -> str:
    agent, network, _ = arm.split("-")
    return f"{AGENTS[agent]}, {NETWORKS[network]}"


@figures.styled
def robustness(data: Data, policy: str = "greedy") -> Figure:
    """Success and steps of each learner against the size of each change."""
    rows = [row for row in data.tables["conditions"] if row["policy"] == policy]
    groups = list(dict.fromkeys(row["group"] for row in rows))
    figure = Figure(figsize=(2.4 * len(groups), 4.6), layout="constrained")
    axes = figure.subplots(2, len(groups), sharex="col", sharey="row", squeeze=False)
    for column, group in enumerate(groups):
        for arm, (colour, line), (marker, size) in zip(
            data.arms(), figures.SERIES, MARKERS, strict=False
        ):
            chosen = [row for row in rows if (row["arm"], row["group"]) == (arm, group)]
            values = sorted({row["value"] for row in chosen})
            for ax, quantity, scale in zip(
                axes[:, column], ("success", "steps"), (100, 1), strict=True
            ):
                table = [
                    [scale * row[quantity] for row in chosen if row["value"] == value]
                    for value in values
                ]
                low, middle, high = ([np.quantile(v, q) for v in table] for q in (0.25, 0.5, 0.75))
                if quantity == "success":
                    middle = [np.mean(v) for v in table]
                else:
                    ax.fill_between(values, low, high, color=colour, alpha=0.15, linewidth=0)
                style = {"marker": marker, "markersize": size, "linewidth": 1.2}
                style |= {"markerfacecolor": "none", "markeredgewidth": 0.9}
                ax.plot(values, middle, color=colour, linestyle=line, label=_name(arm), **style)
        axes[1, column].set_xlabel(group.replace(" [", "\n["))
    axes[0, 0].set(ylabel="success [%]")
    axes[0, 0].set_ylim(min(90, axes[0, 0].get_ylim()[0]), 101)
    axes[1, 0].set(ylabel="steps, all trials")
    figures.logarithmic(axes[1, 0], subs=range(1, 10))
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
