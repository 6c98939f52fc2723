"""Run the paper's section 5 and the studies around it; write data, tables and figures.

    python -m sofnn_torch.studies                               # section 5, 10 seeds: hours
    python -m sofnn_torch.studies --quick                       # the same in minutes, to look at
    python -m sofnn_torch.studies --study growth ablation --seeds 0-4 --workers 8
    python -m sofnn_torch.studies --report-only                 # tables and figures from the data

Every run is a normal run directory below --runs, found again by its settings and code: finished
runs are kept, a killed one goes on where it was, and studies share the runs that they have in
common.
"""

import dataclasses
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

if __name__ == "__main__":  # Ctrl-C while libraries load: there is nothing to save yet
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sofnn_torch import terminal
from sofnn_torch.bounds import Count, Settings
from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.maze.optimum import mean_optimum
from sofnn_torch.maze.robot import checked, plan_of
from sofnn_torch.runs import parallel, places
from sofnn_torch.studies import collecting, report, running

Name = Literal["section5", "paper", "growth", "ablation", "sensors", "fixed", "robustness"]


@dataclass(frozen=True)
class Options(Settings):
    """Run studies, or only write their tables and figures anew."""

    study: tuple[Name, ...] = ("section5",)
    """Studies to run; all of them: section5 paper growth ablation sensors fixed robustness."""
    arms: str = ""
    """Only the arms whose name contains this text, e.g. `sofnn` or `q-no`."""
    seeds: str | None = None
    """Seeds of every arm, such as `0-9` (the default) or `0,3,5`."""
    workers: Count = 2
    """Runs at the same time, each in a process of its own on one core."""
    cluster: Annotated[str | None, tyro.conf.arg(metavar="WHERE")] = None
    """Train on a Dask cluster, as `--cluster` of `train.py`: `tcp://host:8786`, whose workers are
    all used, or `slurm` (docs/scale.md)."""
    trials: Count | None = None
    """Trials of every run; by default those of the presets."""
    max_steps: Count | None = None
    """Steps after which a trial ends; by default those of the presets."""
    layout: str | None = None
    """Maze of every run, as `--maze.layout` of `train.py`; by default that of the presets."""
    out: Path | None = None
    """Where data, tables and figures go; by default docs/results."""
    runs: Path | None = None
    """Where the runs are; by default runs/studies."""
    any_code: bool = False
    """Take finished runs also of code that learns or plays in another way; the pages say of which
    commits their arms are."""
    quick: bool = False
    """Few short runs, to see everything work: 2 seeds, 30 trials of at most 3000 steps, all of it
    below runs/quick. The numbers mean nothing."""
    report_only: bool = False
    """Run nothing: tables and figures from the data that is there."""


@dataclass(frozen=True)
class Complete(Options):
    """Options of which none is left open."""

    seeds: str = "0-9"
    out: Path = Path("docs/results")
    runs: Path = Path("runs/studies")


QUICK = Complete(
    seeds="0-1",
    trials=30,
    max_steps=3000,
    out=Path("runs/quick/results"),
    runs=Path("runs/quick"),
)


def complete(options: Options) -> Complete:
    """The options with everything that was left open."""
    values: dict[str, Any] = vars(options)
    given = {name: value for name, value in values.items() if value is not None}
    return dataclasses.replace(QUICK if options.quick else Complete(), **given)


def variations(options: Options) -> dict[str, int | str]:
    """The settings that the options change in every arm."""
    asked = {
        "trials": options.trials,
        "maze.max_steps": options.max_steps,
        "maze.layout": options.layout and checked("--layout", options.layout),
    }
    return {name: value for name, value in asked.items() if value is not None}


def command(name: str, options: Options) -> str:
    """The command that makes a study."""
    usual = complete(Options(quick=options.quick))
    words = [f"python -m sofnn_torch.studies --study {name}", *["--quick"] * options.quick]
    words += [
        f"--{flag.replace('_', '-')} {getattr(options, flag)}"
        for flag in ("arms", "seeds", "trials", "max_steps", "layout")
        if getattr(options, flag) != getattr(usual, flag)
    ]
    return " ".join(words)


def run(options: Options) -> int:
    """What the command does; the exit code.

    Raises:
        ValueError: options that fit nothing.
        Interrupted: by a signal, after saving.
    """
    asked = complete(options)
    if asked.report_only:
        return report.write(asked.out)
    numbers, changes = parallel.parse(asked.seeds), variations(asked)
    jobs = running.plan(asked.runs, asked.study, asked.arms, numbers, changes, asked.any_code)
    if not jobs:
        raise ValueError(f"--arms {asked.arms}: no arm of {', '.join(asked.study)} has that")
    places.directory(asked.out, "--out")
    places.directory(asked.runs, "--runs")
    failed = running.execute(jobs, asked.workers, asked.cluster)
    optimum = mean_optimum(plan_of(str(changes.get("maze.layout", STANDARD))))
    for name in asked.study:
        notes = {"command": command(name, asked), "quick": asked.quick, "optimum": optimum}
        collecting.collect(name, asked.runs, asked.out, changes, notes, asked.any_code)
    report.write(asked.out)
    return 1 if failed else 0


def main() -> None:
    """Entry point of ``python -m sofnn_torch.studies``."""
    terminal.command(run, Options, __doc__, advice="the same command goes on")


if __name__ == "__main__":
    main()
