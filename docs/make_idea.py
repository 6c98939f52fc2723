"""Make the pictures of docs/idea.md: python docs/make_idea.py."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from make_animation import watched
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sofnn_torch.pictures import figures
from sofnn_torch.runs.session import arithmetic, build
from sofnn_torch.runs.settings import Config
from sofnn_torch.terminal import command

OUT = Path(__file__).parent / "images"
WIDTH = 0.06  # metres, of the membership functions on x and y
HEIGHT = 2.6  # inches of a picture in a line of text


@dataclass(frozen=True)
class Options:
    """Draw them all."""


def near(x: np.ndarray, centre: float, width: float = WIDTH) -> np.ndarray:
    """Equation 1."""
    return np.exp(-0.5 * ((x - centre) / width) ** 2)


def membership() -> Figure:
    """What 'about 0.35 m' means."""
    figure, (ax,) = figures.canvas(1, 4.6, 2.2)
    x = np.linspace(0.1, 0.6, 300)
    ax.plot(x, near(x, 0.35), color=figures.BLUE)
    for widths, level in ((0, 1.0), (1, 0.61), (2, 0.14)):
        place = 0.35 + widths * WIDTH
        ax.plot([place, place], [0, level], color="0.6", linestyle=":", linewidth=1)
        ax.plot(place, level, "o", color=figures.BLACK, markersize=4)
        text = ("at the centre: 1", "one width away: 0.61", "two widths away: 0.14")[widths]
        ax.annotate(text, (place, level), (6, 0), textcoords="offset points", fontsize=8)
    ax.set(xlabel="x [m]", ylabel="membership", ylim=(0, 1.1), yticks=(0, 0.5, 1))
    ax.set_title('"x is about 0.35 m"', loc="left")
    return figure


def firing() -> Figure:
    """A product of memberships is a hill over the floor."""
    figure, (ax,) = figures.canvas(1, 3.4, HEIGHT)
    x, y = np.meshgrid(np.linspace(0.1, 0.6, 120), np.linspace(0, 0.4, 100))
    both = near(x, 0.35) * near(y, 0.15)
    lines = ax.contour(x, y, both, [0.1, 0.4, 0.7, 0.9], colors=figures.BLUE, linewidths=1.1)
    ax.clabel(lines, fontsize=7)
    ax.plot(0.35, 0.15, "o", color=figures.BLACK, markersize=4)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set_title("... and y is about 0.15 m", loc="left")
    return figure


def mean() -> Figure:
    """Conclusions of three rules, their shares, and what comes out between them."""
    figure, (above, below) = figures.canvas(2, 3.4, HEIGHT)
    x = np.linspace(0.1, 0.7, 300)
    centres, conclusions = (0.25, 0.4, 0.5), (0.6, 0.0, -0.8)
    strengths = np.array([near(x, centre) for centre in centres])
    shares = strengths / strengths.sum(0)
    for number, share in enumerate(shares):
        colour, line = figures.SERIES[number]
        above.plot(x, share, color=colour, linestyle=line, label=f"rule {number + 1}")
        below.plot(
            centres[number],
            conclusions[number],
            "os^"[number],
            color=colour,
            label=f"rule {number + 1}",
        )
    below.plot(x, shares.T @ conclusions, color=figures.BLACK, label="all together")
    above.set(xlabel="x [m]", ylabel="share of the firing", ylim=(0, 1.1), yticks=(0, 0.5, 1))
    below.set(xlabel="x [m]", ylabel="turn: right -1, left 1", ylim=(-1.1, 1.1))
    for ax in (above, below):
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return figure


def action() -> Figure:
    """The density of the action, cut into three parts, before and after a reward."""
    figure, (ax,) = figures.canvas(1, 4.6, 2.4)
    a = np.linspace(-1.2, 1.2, 400)
    for centre, (colour, line), text in (
        (0.0, ("0.45", "--"), "before: mean 0"),
        (0.25, (figures.BLUE, "-"), "after: mean 0.25"),
    ):
        density = near(a, centre, 0.3) / (np.sqrt(2 * np.pi) * 0.3)
        ax.plot(a, density, color=colour, linestyle=line, label=text)
    for edge in (-1 / 3, 1 / 3):
        ax.axvline(edge, color="0.7", linewidth=1)
    for place, text in ((-0.75, "right turn"), (0, "straight"), (0.75, "left turn")):
        ax.text(place, 1.62, text, ha="center", fontsize=8)
    ax.plot(0.55, 0.04, "^", color=figures.VERMILION, markersize=7, clip_on=False)
    ax.annotate("drawn: 0.55,\nand it was good", (0.57, 0.09), (0.78, 0.55), fontsize=8)
    ax.set(xlabel="action a", ylabel="density", ylim=(0, 1.8), yticks=(0, 0.5, 1, 1.5))
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return figure


def roulette() -> Figure:
    """Probabilities of three actions by their values, at two temperatures."""
    figure, axes = figures.canvas(2, 2.7, 2.3)
    values, names = np.array([61.0, 61.6, 61.5]), ("right turn", "straight", "left turn")
    for ax, temperature in zip(axes, (0.5, 0.05), strict=True):
        weights = np.exp((values - values.max()) / temperature)
        bars = ax.bar(names, weights / weights.sum(), color=figures.SKY, edgecolor="black")
        ax.bar_label(bars, [f"Q {value}" for value in values], fontsize=8, padding=2)
        ax.set(ylim=(0, 1), yticks=(0, 0.5, 1))
        ax.set_title(f"temperature {temperature}", loc="left")
    axes[0].set_ylabel("probability")
    return figure


@arithmetic()
def growth() -> Figure:
    """Rules that the first trial of `train.py` adds."""
    filmed = watched(*build(Config()), trial=1)
    steps, rules, centres = filmed.places, filmed.rules, filmed.centres
    figure, axes = figures.canvas(4, 2.3, 2.7)
    for ax, step in zip(axes, (60, 600, 3000, len(steps)), strict=True):
        figures.maze_plan(filmed.plan, ax, labels=False)
        ax.set(xticks=[], yticks=[], xlabel=f"{rules[step - 1]} rules", ylabel="")
        ax.plot(*np.array(steps[:step]).T, color=figures.BLUE, linewidth=0.6, zorder=3)
        for centre in centres[: rules[step - 1]]:
            ax.add_patch(Circle(centre, WIDTH, color="0.2", alpha=0.13, linewidth=0, zorder=4))
        ax.plot(*centres[: rules[step - 1]].T, ".", color=figures.BLACK, markersize=2, zorder=5)
        ax.set_title(f"after {step:,} steps")
    return figure


@figures.styled
def main(_: Options) -> None:
    """Draw them all."""
    for draw in (membership, firing, growth, mean, action, roulette):
        (OUT / f"idea-{draw.__name__}.png").write_bytes(figures.png(draw(), dpi=130))


if __name__ == "__main__":
    command(main, Options, __doc__)
