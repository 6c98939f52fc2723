"""Draw the learning curves of runs, grouped by what differs in their settings.

    python -m sofnn_torch.plot runs/*                          # learning-curves.png and a table
    python -m sofnn_torch.plot runs --quantity rules --out rules.svg
    python -m sofnn_torch.plot RUN RUN --smooth 10 --csv curves.csv

Runs that differ in nothing but their seed and their number of trials are one group: a line for the
median over its seeds, a band from the first to the third quartile, and each seed faintly; of fewer
than five seeds each is a line. Each task has a panel, and more than five groups have several with
the same axes. The table is of the last 10 trials of each run. Runs that are still learning can be
drawn; those without a trial yet are left out. A run made of another one's rules (rules --load,
--reduce) begins with the trials of that one: it is no further seed, and has a group of its own.
"""

import dataclasses
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from matplotlib.axes import Axes
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from sofnn_torch.bounds import Count, Settings
from sofnn_torch.pictures import figures
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.directory import flatten, load_config
from sofnn_torch.runs.settings import MAZE
from sofnn_torch.runs.table import line
from sofnn_torch.terminal import check_output, command, plural, say

LAST = 10  # trials at the end of each run that the table tells of
LONG = 60  # letters that no label can hold
ENDINGS = (".png", ".svg", ".pdf")
FIRST = ("agent", "network", "pose")  # named first where they differ
USUAL = {MAZE: "steps"}  # what is drawn; the reward in other tasks
LABELS = {"steps": "steps to the goal", "success": "share of trials that reach the goal"}

Curves = dict[str, list[NDArray[Any]]]  # by group, those of its runs


@dataclass(frozen=True)
class Options(Settings):
    """Draw learning curves of runs, and print a table of their last trials."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directories of runs, or directories that hold runs."""
    quantity: str | None = None
    """Column of trials.csv; by default the steps in the maze and the reward in other tasks."""
    smooth: Count = 1
    """Each point is the mean of so many trials, the last ones until there."""
    out: Path = Path("learning-curves.png")
    """The picture: a .png, .svg or .pdf file."""
    csv: Path | None = None
    """Write the curves to this .csv file: task, group, run, trial, value."""


def find(places: Sequence[Path]) -> list[Path]:
    """The runs among directories, and those inside directories that are none, each once.

    Raises:
        ValueError: there is no run.
    """
    if not places:
        raise ValueError("no run: give the directories of runs, such as runs/*")
    found: dict[Path, Path] = {}
    for place in places:
        inside = [place]
        if place.is_dir() and not (place / "config.json").exists():
            inside = sorted(p.parent for p in place.glob("[!.]*/config.json"))
            if not inside:
                raise ValueError(f"{place} is no run and holds none")
        found |= {path.resolve(): path for path in inside if path.resolve() not in found}
    return list(found.values())


def group(runs: Sequence[Path]) -> dict[str, list[Path]]:
    """Runs whose settings are equal but for seed and trials, by what tells the groups apart.

    Raises:
        ValueError: a directory is no run, or its settings cannot be read.
    """
    settings: dict[Path, dict[str, str]] = {}
    for run in runs:
        config = load_config(run)
        flat = flatten(dataclasses.asdict(config))
        flat = {name: _short(str(v)) for name, v in flat.items() if name not in ("seed", "trials")}
        settings[run] = flat | {"agent": config.learner.name, "made": _made(run)}
    names = sorted(set().union(*settings.values()), key=lambda name: (name not in FIRST, name))
    varying = [n for n in names if len({flat.get(n) for flat in settings.values()}) > 1]
    telling: list[str] = []  # as few names as tell all apart
    labels = _labels(settings, telling)
    for name in varying:
        more = _labels(settings, [*telling, name])
        if not telling or len(set(more.values())) > len(set(labels.values())):
            telling, labels = [*telling, name], more
    groups: dict[str, list[Path]] = {}
    for run, label in labels.items():
        groups.setdefault(label, []).append(run)
    return groups


def tasks(runs: Sequence[Path]) -> dict[str, dict[str, list[Path]]]:
    """The groups of each task."""
    found: dict[str, list[Path]] = {}
    for run in runs:
        found.setdefault(load_config(run).env, []).append(run)
    return {task: group(own) for task, own in found.items()}


def _made(run: Path) -> str:
    """How a run was made: trained, or of the rules of another one, edited or reduced."""
    sessions = json.loads((run / "config.json").read_bytes()).get("earlier", [])
    changes = [what for what in ("edited", "reduced") if any(what in s for s in sessions)]
    return " and ".join(changes) or "trained"


def _with_trials(runs: Sequence[Path]) -> list[Path]:
    """The runs that have played a trial; a line says which others are left out.

    Raises:
        ValueError: none has, or a directory is no run.
    """
    begun = []
    for run in runs:
        load_config(run)
        file = run / "trials.csv"
        if file.exists() and file.read_bytes().count(b"\n") > 1:
            begun.append(run)
        else:
            say(f"{run}: no trial yet, left out")
    if not begun:
        raise ValueError("no run has a trial yet")
    return begun


def _labels(settings: Mapping[Path, Mapping[str, str]], names: Sequence[str]) -> dict[Path, str]:
    return {run: _label(flat, names) for run, flat in settings.items()}


def _short(value: str) -> str:
    """A setting as a label has it: of a map or a list of rules something that tells it apart."""
    return value if len(value) < LONG else f"own {zlib.crc32(value.encode()):08x}"


def _label(settings: Mapping[str, str], names: Sequence[str]) -> str:
    """The settings that tell a group from others; short for those that everybody knows."""
    known = [settings.get(name, "-") for name in names if name in FIRST]
    others = [f"{name} {settings.get(name, '-')}" for name in names if name not in FIRST]
    return ", ".join(known + others) or f"{settings['agent']}, {settings['network']}"


def smoothed(values: NDArray[Any], window: int) -> NDArray[Any]:
    """Means of up to `window` values, the last ones until each. Shape: (T,), as the values."""
    sums = np.concatenate([[0.0], np.cumsum(values, dtype=float)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def summary(curves: Mapping[str, Sequence[NDArray[Any]]], quantity: str) -> Table:
    """The mean of the last trials of each run: median, least and most over the runs of a group."""
    table = Table(title=f"{quantity}, mean of the last {LAST} trials of each run")
    table.add_column("group")
    for heading in ("runs", "trials", "median", "least", "most"):
        table.add_column(heading, justify="right")
    for name, runs in curves.items():
        ends = [float(curve[-LAST:].mean()) for curve in runs]
        trials = sorted({len(curve) for curve in runs})
        numbers = [float(np.median(ends)), min(ends), max(ends)]
        span = f"{trials[0]:,}" if len(trials) == 1 else f"{trials[0]:,}-{trials[-1]:,}"
        table.add_row(name, str(len(runs)), span, *(f"{x:,.4g}" for x in numbers))
    return table


def write_table(
    path: Path,
    groups: Mapping[str, Mapping[str, Sequence[Path]]],
    curves: Mapping[str, Curves],
) -> None:
    """Write every point of every curve as CSV."""
    lines = [line(["task", "group", "run", "trial", "value"])]
    for task, own in groups.items():
        for name, runs in own.items():
            for run, curve in zip(runs, curves[task][name], strict=True):
                points = enumerate(curve, 1)
                lines += [line([task, name, run.name, i, float(v)]) for i, v in points]
    checkpoint.write_atomically(path, "".join(lines).encode())


def run(options: Options) -> None:
    """What the command does.

    Raises:
        ValueError: a run cannot be used or a file cannot be written.
    """
    check_output("--out", options.out, ENDINGS)
    check_output("--csv", options.csv, (".csv",))
    groups = tasks(_with_trials(find(options.runs)))
    most = len(figures.SERIES)
    panels = [
        (task, list(own)[at : at + most])
        for task, own in groups.items()
        for at in range(0, len(own), most)
    ]
    figure, axes = figures.canvas(len(panels), width=6, height=3.6, columns=2)
    curves: dict[str, Curves] = {task: {} for task in groups}
    first: dict[str, Axes] = {}
    for (task, names), ax in zip(panels, axes, strict=True):
        quantity = options.quantity or USUAL.get(task, "reward")
        for name in names:
            files = [path / "trials.csv" for path in groups[task][name]]
            curves[task][name] = [figures.read_column(file, quantity) for file in files]
        shown = {name: [smoothed(c, options.smooth) for c in curves[task][name]] for name in names}
        if task in first:
            ax.sharex(first[task])
            ax.sharey(first[task])
        first.setdefault(task, ax)
        figures.learning_curves(shown, ax, quantity, LABELS.get(quantity, quantity))
    if len(groups) > 1:
        for task, ax in first.items():
            ax.set_title(task)
    checkpoint.write_atomically(options.out, figures.saved(figure, options.out.suffix.lower()[1:]))
    for task in groups:
        Console().print(summary(curves[task], options.quantity or USUAL.get(task, "reward")))
    count = sum(len(runs) for own in groups.values() for runs in own.values())
    print(f"written: {options.out} ({plural(count, 'run')})")
    if options.csv:
        write_table(options.csv, groups, curves)
        print(f"written: {options.csv}")


def main() -> None:
    """Entry point of ``python -m sofnn_torch.plot``."""
    command(run, Options, __doc__ or "")


if __name__ == "__main__":
    main()
