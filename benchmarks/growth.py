"""Does growth help? A growing network against a grid of as many rules, in 2, 4 and 6 dimensions.

    python benchmarks/growth.py --out docs/results/growth-or-grid.json --picture growth-or-grid.png
    python benchmarks/growth.py --table docs/results/growth-or-grid.json   # table, picture alone

Q-learning with the settings of each task and the same step sizes, the same budget of environment
steps, and the same search: four widths are tried with seeds that do not count, and the best of each
is trained with seeds of its own. The grid has the number of rules nearest to the median of those
that grew, as even along its axes as that allows. Runs stay in ``--runs`` and are not repeated.
"""

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tasks import STEPS, learned

from sofnn_torch import Config
from sofnn_torch.pictures import figures
from sofnn_torch.studies.results import cell, markdown
from sofnn_torch.studies.statistics import mean

TASKS = {"MountainCar-v0": 2, "CartPole-v1": 4, "Acrobot-v1": 6}  # dimensions
FACTORS = (0.7, 1.0, 1.4, 2.0)  # of the widths of the preset
SEARCHED = (100, 101)  # seeds
SHADES = {"sofnn": "0.1", "fixed": "0.6"}
TITLES = {"sofnn": "growing network", "fixed": "grid of as many rules"}


@dataclasses.dataclass
class Options:
    """Train growing networks and grids of as many rules on tasks of 2, 4 and 6 dimensions."""

    env: tuple[str, ...] = tuple(TASKS)
    """Tasks."""
    seeds: int = 10
    """Seeds 0, 1, ... of the best of each."""
    steps: int | None = None
    """Environment steps of training; by default those of benchmarks/tasks.py."""
    runs: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/growth-or-grid")
    """Where the runs go."""
    out: Path | None = None
    """Write what was measured as JSON."""
    table: Path | None = None
    """Measure nothing: print the table of this JSON."""
    picture: Path | None = None
    """Draw what was measured."""


def grid(count: float, dimensions: int) -> tuple[int, ...]:
    """Rules along each axis, at most one apart, whose product is nearest to a number."""
    few = max(1, int(count ** (1 / dimensions)))
    shapes = [
        tuple([side + 1] * more + [side] * (dimensions - more))
        for side, more in itertools.product((few, few + 1), range(dimensions + 1))
    ]
    return min(shapes, key=lambda shape: abs(math.log(math.prod(shape) / count)))


def settings(env: str, network: Any, seed: int, factor: float, shape: tuple[int, ...]) -> Config:
    """The preset for a task with other widths; a grid with a shape has them by its spacing."""
    config = Config(env=env, agent="q", network=network, seed=seed, trials=100_000)
    net = config.net
    if network == "fixed":
        net = dataclasses.replace(net, grid=shape, width=tuple(0.5 / side for side in shape))
    net = dataclasses.replace(net, width=tuple(float(f"{factor * w:.3g}") for w in net.width))
    return dataclasses.replace(config, net=net)


def compared(env: str, options: Options) -> dict[str, Any]:
    """What both networks came to on a task: the search, and a row for each seed of the best."""
    steps, found = options.steps or STEPS[env], {}
    shape: tuple[int, ...] = ()
    for network in ("sofnn", "fixed"):
        tries = []
        for factor in FACTORS:
            runs = [_run(env, network, s, factor, shape, steps, options) for s in SEARCHED]
            tries.append({"factor": factor, "return": float(np.mean([r["return"] for r in runs]))})
        best = max(tries, key=lambda row: row["return"])["factor"]
        seeds = [_run(env, network, s, best, shape, steps, options) for s in range(options.seeds)]
        found[network] = {"tries": tries, "factor": best, "shape": shape, "seeds": seeds}
        shape = grid(float(np.median([row["rules"] for row in seeds])), TASKS[env])
    return {"env": env, "steps": steps} | found


def _run(
    env: str,
    network: str,
    seed: int,
    factor: float,
    shape: tuple[int, ...],
    steps: int,
    options: Options,
) -> dict[str, float]:
    size = "x".join(map(str, shape)) or "grown"
    run = options.runs / f"{env}-{network}-{size}-{factor}-{steps}-s{seed}"
    row = learned(settings(env, network, seed, factor, shape), steps, run)
    print(run.name, *(f"{k} {v:,.4g}" for k, v in row.items()), flush=True)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """What was measured, in Markdown."""
    head = ["task", "network", "inputs", "steps", "width, factor", "seeds", "rules", "mean return"]
    lines = []
    for row in rows:
        for network, title in TITLES.items():
            part = row[network]
            seeds = part["seeds"]
            rules = [int(seed["rules"]) for seed in seeds]
            span = "-".join(dict.fromkeys(map(str, (min(rules), max(rules)))))
            shape = f" ({' x '.join(map(str, part['shape']))})" if part["shape"] else ""
            lines.append(
                [
                    row["env"],
                    title,
                    str(TASKS[row["env"]]),
                    f"{row['steps']:,}",
                    f"{part['factor']:g}",
                    str(len(seeds)),
                    span + shape,
                    cell(mean(np.array([seed["return"] for seed in seeds])), 1),
                ]
            )
    return markdown(head, lines, 2)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Every seed as a ring, the median as a line, a panel for each task."""
    figure, axes = figures.canvas(len(rows), width=2.6, height=2.8)
    for ax, row in zip(axes, rows, strict=True):
        for place, (network, title) in enumerate(TITLES.items()):
            returns = [seed["return"] for seed in row[network]["seeds"]]
            spread = place + 0.03 * (np.arange(len(returns)) - 0.5 * (len(returns) - 1))
            ax.plot(spread, returns, "o", mfc="none", color=SHADES[network], label=title)
            ax.hlines(np.median(returns), place - 0.3, place + 0.3, color=SHADES[network])
        ax.set_xticks([0, 1], ["grown", "grid"])
        ax.set_xlim(-0.5, 1.5)
        ax.set_title(f"{row['env']}, {TASKS[row['env']]} inputs", fontsize=9)
    axes[0].set_ylabel("return of the greedy policy")
    path.write_bytes(figures.saved(figure, path.suffix[1:] or "png"))


def main() -> None:
    """Print a line for each run, then the table."""
    options = tyro.cli(Options, description=__doc__)
    if options.table:
        rows = json.loads(options.table.read_text())
    else:
        rows = []
        for env in options.env:
            rows.append(compared(env, options))
            if options.out:
                options.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
