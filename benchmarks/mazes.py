"""Do the defaults learn the mazes that are built in?

    python benchmarks/mazes.py --out docs/results/mazes.json
    python benchmarks/mazes.py --layout rooms spiral --agent q --seeds 5
    python benchmarks/mazes.py --table docs/results/mazes.json    # the table of docs/mazes.md

Each seed trains with the preset ``default`` for the trials given, and plays 20 trials without
learning or exploration. Seconds are processor time of the training. Runs stay in ``--runs`` and are
not repeated.
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tasks import EPISODES, keep, trained

from sofnn_torch import Config
from sofnn_torch.maze.layouts import built_in
from sofnn_torch.maze.optimum import mean_optimum
from sofnn_torch.maze.robot import plan_of
from sofnn_torch.studies.results import cell, markdown
from sofnn_torch.studies.statistics import median, share

SHOWN = ("random:0", "random:1")  # of the random mazes


@dataclasses.dataclass
class Options:
    """Train the presets in mazes and play what they learned."""

    layout: tuple[str, ...] = (*built_in(), *SHOWN)
    """Mazes."""
    agent: tuple[str, ...] = ("sga", "q")
    """Learners."""
    seeds: int = 5
    """Seeds 0, 1, ... of each."""
    trials: int = 100
    """Trials of training."""
    max_steps: int | None = None
    """Steps after which a trial ends; by default those of the preset."""
    runs: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/mazes")
    """Where the runs go."""
    out: Path | None = None
    """Write what was measured as JSON; rows that are there already, but not measured now, stay."""
    table: Path | None = None
    """Measure nothing: print the table of this JSON."""


def learned(config: Config, run: Path) -> dict[str, Any]:
    """Train a run and play it: what `trained` finds, and the steps of each trial, 0 for a miss."""
    found, records = trained(config, run)
    if records:
        found["played"] = [record.steps if record.success else 0 for record in records]
        keep(found, run)
    return found


def row(found: dict[str, Any]) -> list[str]:
    """Cells of the table for a maze and a learner."""
    seeds = found["seeds"]
    reached = np.array([np.count_nonzero(seed["played"]) for seed in seeds])
    steps = [float(np.mean([n for n in seed["played"] if n] or [np.inf])) for seed in seeds]
    rules = [seed["rules"] for seed in seeds]
    return [
        f"`{found['layout']}`",
        f"{found['optimum']:.0f}",
        found["agent"].upper(),
        str(found["trials"]),
        str(len(seeds)),
        cell(share(reached, EPISODES), 0, 100),
        f"{100 * reached.min() / EPISODES:.0f}",
        cell(median(np.array(steps))),
        f"{min(rules)}-{max(rules)}",
        f"{np.median([seed['seconds'] for seed in seeds]):.0f}",
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """What was measured, in Markdown."""
    head = [
        "Maze",
        "Optimum",
        "Learner",
        "Trials",
        "Seeds",
        "Success [%]",
        "Worst seed [%]",
        "Steps",
    ]
    return markdown([*head, "Rules", "Seconds"], [row(each) for each in rows], 1)


def merged(rows: list[dict[str, Any]], out: Path) -> list[dict[str, Any]]:
    """The rows and those of the file that are of others."""
    before = json.loads(out.read_text()) if out.exists() else []
    both = {(each["layout"], each["agent"]): each for each in [*before, *rows]}
    order = [*built_in(), *SHOWN, *(layout for layout, _ in both)]
    return [both[key] for key in sorted(both, key=lambda key: order.index(key[0]))]


def main() -> None:
    """Print a line for each seed, then the table."""
    options = tyro.cli(Options, description=__doc__)
    if options.table:
        print(table(json.loads(options.table.read_text())))
        return
    rows: list[dict[str, Any]] = []
    for layout in options.layout:
        optimum = mean_optimum(plan_of(layout))
        for agent in options.agent:
            seeds: list[dict[str, Any]] = []
            about = {"layout": layout, "agent": agent, "trials": options.trials}
            rows.append(about | {"optimum": optimum, "seeds": seeds})
            for seed in range(options.seeds):
                config = Config(agent=agent, seed=seed, trials=options.trials)
                limit = options.max_steps or config.maze.max_steps
                maze = dataclasses.replace(config.maze, layout=layout, max_steps=limit)
                name = f"{layout.replace(':', '-')}-{agent}-{options.trials}-s{seed}"
                config = dataclasses.replace(config, maze=maze)
                seeds.append(learned(config, options.runs / name))
                print(name, seeds[-1], flush=True)
                if options.out:
                    text = json.dumps(merged(rows, options.out), indent=1)
                    options.out.write_text(text + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
