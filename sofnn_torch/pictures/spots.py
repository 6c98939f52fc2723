"""The spot where a decision was made, with the rules that made it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.pictures.figures import (
    BLACK,
    BLUE,
    SERIES,
    VERMILION,
    maze_plan,
    memberships,
    styled,
)

REACH = 0.22  # m that are shown around the robot


@styled
def spot(
    agent: Learner,
    state: NDArray[np.float32],
    rules: Sequence[int],
    values: NDArray[np.float64],
    title: str,
    plan: MazePlan | None = None,
) -> Figure:
    """The rules that decide at a state: in the maze where they are, and their memberships.

    Args:
        agent: the learner.
        state: where. Shape: (n,).
        rules: numbers of the rules, the most important first; the first five are shown.
        values: above 0 where a rule is for what is done, by number. Shape: (K,).
        title: what is done, in a few words.
        plan: the maze; None for other tasks.
    """
    rules, inputs = list(rules)[: len(SERIES)], len(agent.task.axes)
    figure = Figure(
        figsize=(7.2 if plan else 4.2, 0.6 + 1.15 * max(inputs, 3)), layout="compressed"
    )
    cells = figure.add_gridspec(inputs, 2 if plan else 1, width_ratios=[1.2, 1] if plan else [1])
    if plan:
        _around(plan, agent, state, rules, values, figure.add_subplot(cells[:, 0]))
    names = {k: f"rule {k + 1} {'for' if values[k] > 0 else 'against'}" for k in rules}
    for i, axis in enumerate(agent.task.axes):
        ax = figure.add_subplot(cells[i, -1])
        memberships(agent, i, ax, names)
        scale = 180 / math.pi if axis.unit == "rad" else 1.0
        ax.axvline(scale * float(state[i]), color="0.3", linewidth=1, linestyle=(0, (1, 1)))
        if i == 0:
            ax.legend(loc="lower left", bbox_to_anchor=(-0.04, 1), ncols=2)
    figure.suptitle(title, fontsize=9)
    return figure


def _around(
    plan: MazePlan,
    agent: Learner,
    state: NDArray[np.float32],
    rules: Sequence[int],
    values: NDArray[np.float64],
    ax: Axes,
) -> None:
    """The neighbourhood: each rule an ellipse of one width, a tick towards its heading."""
    maze_plan(plan, ax, labels=False)
    halo = [withStroke(linewidth=2, foreground="white")]
    x, y, heading = map(float, state[:3])
    for k in rules:
        (u, v, angle, *_), (a, b, *_) = agent.net.centres[k].tolist(), agent.net.widths[k].tolist()
        colour, line = (BLUE, "-") if values[k] > 0 else (VERMILION, "--")
        style: dict[str, Any] = {
            "fill": False,
            "edgecolor": colour,
            "linestyle": line,
            "linewidth": 1.2,
        }
        ax.add_patch(Ellipse((u, v), 2 * a, 2 * b, zorder=5, **style))
        ends = [u, u + 0.03 * math.cos(angle)], [v, v + 0.03 * math.sin(angle)]
        ax.plot(*ends, color=colour, linewidth=1.6, zorder=6)
        ax.annotate(
            str(k + 1),
            (u, v),
            (3, 3),
            textcoords="offset points",
            color=colour,
            fontsize=8,
            path_effects=halo,
            zorder=8,
        )
    ax.add_patch(Circle((x, y), plan.robot_radius, facecolor="0.8", edgecolor=BLACK, zorder=4))
    tip = x + plan.robot_radius * math.cos(heading), y + plan.robot_radius * math.sin(heading)
    ax.plot([x, tip[0]], [y, tip[1]], color=BLACK, linewidth=1.8, zorder=7)
    ax.set(xlim=(x - REACH, x + REACH), ylim=(y - REACH, y + REACH))
    ax.set_title("blue: for it, dashed red: against it")
