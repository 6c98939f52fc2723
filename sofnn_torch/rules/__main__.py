"""Read the rules that a run has learned, write them to a file, load edited ones.

    python -m sofnn_torch.rules RUN                        # the rules that matter most, a table
    python -m sofnn_torch.rules RUN --at 0.15 0.15 90      # who decides at a pose: m, m, degrees
    python -m sofnn_torch.rules RUN --within 0.1 0.2 0.1 0.2 60 120   # what it can do in a region
    python -m sofnn_torch.rules RUN --json rules.json --csv rules.csv --picture rules.png
    python -m sofnn_torch.rules RUN --load rules.json      # edited rules become a new run

The run directory is not changed. docs/rules.md says how to read a rule and what a file holds.
"""

import json
import math
import shutil
import signal
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from sofnn_torch.bounds import Settings, Within
from sofnn_torch.evaluate import learned, load
from sofnn_torch.learners.learner import Learner
from sofnn_torch.network.axes import Axis
from sofnn_torch.pictures import figures
from sofnn_torch.rules import files, words
from sofnn_torch.rules.regions import Answer, actions_within
from sofnn_torch.rules.words import Decision, Reading, number
from sofnn_torch.runs import checkpoint, seeding
from sofnn_torch.runs.directory import Run
from sofnn_torch.runs.factory import make_env, make_plan
from sofnn_torch.runs.places import numbered
from sofnn_torch.runs.session import RunOptions, arithmetic, home_of
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.terminal import check_output, command, plural, say
from sofnn_torch.training import play

PICTURES = (".png", ".svg", ".pdf")
WIDEST = 1000  # columns of a table for which there is room
WIDTH = 100  # columns of a table that does not go to a terminal
ENOUGH = 0.99  # share of the firing that decides at a pose
FIRED = 0.01  # a rule with less firing in all of a trial took no part, as in docs/metrics.md


@dataclass(frozen=True)
class Options(Settings):
    """Print the learned rules of a run as a table, the most used first; write, edit, explain."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run, or one of its checkpoint files."""
    top: Annotated[int, Within(least=0)] = 20
    """Rules in the table; 0 for all."""
    at: tuple[float, ...] | None = None
    """Show which rules decide at a state instead: in the maze x and y in metres and the heading in
    degrees, in another task its inputs in their order and units."""
    within: tuple[float, ...] | None = None
    """Show instead which actions the policy can take anywhere in a region, proved or with an
    example: the lower and the upper end of each input, in the units of --at."""
    json: Path | None = None
    """Write all rules to this .json file."""
    csv: Path | None = None
    """Write all rules to this .csv file."""
    picture: Path | None = None
    """Draw the rules into this .png, .svg or .pdf file."""
    load: Path | None = None
    """Make a new run out of this one and the rules in a .json or .csv file."""
    name: str | None = None
    """Name of the new run; by default that of the old one with `-edited`."""
    seed: Annotated[int, Within(least=0)] = 1000
    """Seed of the trial that shows how much each rule is used."""


def check(options: Options) -> None:
    """Check what can be checked before anything is loaded.

    Raises:
        ValueError: naming the flag.
    """
    if options.at and not all(abs(value) < 1e6 for value in options.at):
        raise ValueError(f"--at must be a state in the units of its inputs, got {options.at}")
    if options.within and not all(abs(value) < 1e6 for value in options.within):
        raise ValueError(f"--within needs ends in the units of its inputs, got {options.within}")
    if options.name is not None and not options.load:
        raise ValueError("--name goes with --load")
    RunOptions(name=options.name)
    outputs = {name: getattr(options, name) for name in ("json", "csv", "picture")}
    for name, path in outputs.items():
        check_output(f"--{name}", path, PICTURES if name == "picture" else (f".{name}",))
    given = [f"--{name}" for name in ("load", "at", "within", *outputs) if getattr(options, name)]
    if len(given) > 1 and (options.load or options.at or options.within):
        raise ValueError(f"{given[0]} and {given[1]} do not go together: use two commands")


def firing_along_a_trial(
    config: Config, agent: Learner, seed: int
) -> tuple[NDArray[Any], int, str]:
    """Share of each rule (K,) in a trial without learning, its decisions, and how it went."""
    env = make_env(config)
    try:
        seeding.begin(env, agent, seed)
        record, path = play(env, agent, learn=False, explore=False)
    finally:
        env.close()
    outcome = f"{'goal' if record.success else 'no goal'} after {record.steps:,} steps"
    if record.success is None:
        outcome = f"return {record.reward:,.4g} in {record.steps:,} steps"
    return agent.usage(path.decided_at(config.pose)), record.decisions, outcome


def summary(shares: NDArray[Any], decisions: int, reading: Reading) -> str:
    """How many rules matter. Shares: (K,)."""
    total = np.sort(shares)[::-1].cumsum()
    half, most = (1 + int((total < share * total[-1]).sum()) for share in (0.5, 0.9))
    idle = int((shares * decisions < FIRED).sum())
    text = f"{plural(len(shares), 'rule')}: {half:,} make up 50 % of the firing along the trial, "
    text += f"{most:,} make up 90 %, {idle:,} took no part"
    if outvoted := int(reading.outvoted.sum()):
        verb, where = ("is", "it is") if outvoted == 1 else ("are", "they are")
        text += (
            f"\n{plural(outvoted, 'rule')} (*) {verb} outvoted: where {where} centred, all rules "
        )
        text += "together choose another action"
    return text


def table(reading: Reading, shares: NDArray[Any], top: int) -> Table:
    """The rules with the largest shares (K,) for the terminal; all if top is 0."""
    columns = reading.antecedents | reading.consequents
    view = _headed(reading, reading.consequents)
    for rule in np.argsort(-shares, kind="stable")[: top or None].tolist():
        cells = [column[rule] for column in columns.values()]
        cells[len(reading.antecedents)] += " *" * int(reading.outvoted[rule])
        view.add_row(str(rule + 1), f"{shares[rule]:.1%}", *cells)
    return view


def decision_table(reading: Reading, decision: Decision, by_action: bool) -> Table:
    """The rules that decide at a state, their shares, and what they conclude together.

    Args:
        reading: all rules.
        decision: at the state.
        by_action: rules fire differently for each action.
    """
    shares, worth = decision.shares, decision.shares * decision.conclusions
    columns: Sequence[int] = range(len(decision.names))
    if len(columns) > words.MANY:
        columns = [int(decision.outputs.argmax())]
    view = _headed(reading, [decision.names[j] for j in columns])
    share = shares.mean(1)
    order = np.argsort(-share, kind="stable")
    count = 1 + int((share[order].cumsum() < ENOUGH).sum())
    for rule in order[:count].tolist():
        cells = [column[rule] for column in reading.antecedents.values()]
        for j in columns:
            cell = number(decision.conclusions[rule, j])
            if by_action:  # a rule fires for few of the actions
                weight = shares[rule, j]
                cell = f"{weight:.0%}×{cell}" if weight >= 0.005 else ""  # noqa: RUF001
            cells.append(cell)
        view.add_row(str(rule + 1), f"{share[rule]:.1%}", *cells)
    rest, blank = order[count:], [""] * len(reading.antecedents)
    if len(rest):
        means = worth[rest].sum(0) / np.maximum(shares[rest].sum(0), 1e-300)
        cells = [] if by_action else [number(means[j]) for j in columns]
        view.add_row("rest", f"{share[rest].sum():.1%}", *blank, *cells)
    view.add_section()
    view.add_row("all", "100%", *blank, *(number(decision.outputs[j]) for j in columns))
    return view


def _headed(reading: Reading, consequents: Iterable[str]) -> Table:
    named = [name.partition(", ") for name in reading.antecedents]
    heads = [f"{name}\nis about\n{unit}".strip() for name, _, unit in named]
    first, *others = [name.replace(" ", "\n") for name in consequents]
    heads = [f"IF {heads[0]}", *(f"AND {head}" for head in heads[1:]), f"THEN {first}", *others]
    view = Table("rule", "share", *heads, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column in view.columns:
        column.justify, column.no_wrap = "right", True
    return view


def show(view: Table) -> None:
    """Print a table: in full width where there is no terminal, broken at words in a narrow one."""
    console = Console()
    console = console if console.is_terminal else Console(width=WIDTH)
    if console.measure(view, options=console.options.update(width=WIDEST)).maximum > console.width:
        view.padding, view.show_edge = 0, False
        for column in view.columns:
            text = "\n".join(map(str, [column.header, *column.cells]))
            column.no_wrap, column.width = False, max(map(len, text.split()), default=1)
    console.print(view)


def state_of(options: Options, config: Config) -> NDArray[np.float32]:
    """The state (n,) that was asked for.

    Where it is out of range this warns, and no more: the rules answer everywhere.

    Raises:
        ValueError: it has another number of inputs.
    """
    axes, values = config.task.axes, list(options.at or ())
    if len(values) != len(axes):
        names = ", ".join(axis.name for axis in axes)
        raise ValueError(f"--at needs {len(axes)} numbers ({names}), got {len(values)}")
    if config.env == MAZE:
        width, height = make_plan(config).size
        x, y, degrees = values[:3]
        if not (0 <= x <= width and 0 <= y <= height):
            say(f"warning: --at {x:g} {y:g} is outside the maze of {width:g} x {height:g} m")
        values[2] = math.remainder(math.radians(degrees), 2 * math.pi)
    else:
        for axis, value in zip(axes, values, strict=True):
            if not (axis.period or axis.low <= value <= axis.high):
                ends = f"{axis.low:g} to {axis.high:g}"
                say(f"warning: --at {axis.name} {value:g} is out of its range, {ends}")
    return np.array(values, np.float32)


def region_of(options: Options, config: Config) -> tuple[list[float], list[float]]:
    """The lower and upper ends of the region that was asked for.

    Raises:
        ValueError: it has other numbers of ends, or a lower end above the upper one.
    """
    axes, ends = config.task.axes, list(options.within or ())
    if len(ends) != 2 * len(axes):
        names = ", ".join(axis.name for axis in axes)
        raise ValueError(f"--within needs two ends for each of {names}, got {len(ends)} numbers")
    low, high = ends[::2], ends[1::2]
    for axis, a, b in zip(axes, low, high, strict=True):
        if a > b:
            turn = 360 if config.env == MAZE else axis.period
            hint = f" (through the seam: {a:g} {b + turn:g})" if axis.period else ""
            raise ValueError(f"--within {axis.name} {a:g} {b:g}: the lower end comes first{hint}")
    if config.env == MAZE:
        low[2], high[2] = math.radians(low[2]), math.radians(high[2])
    return low, high


def region_table(answers: Sequence[Answer], axes: Sequence[Axis]) -> Table:
    """What a policy can do in a region."""
    view = Table("action", "there", "for example", box=SIMPLE_HEAD, pad_edge=False)
    said = {True: "taken", False: "never: proved", None: "not decided"}
    for answer in answers:
        found = answer.example
        place = "" if found is None else ", ".join(map(words.at, axes, found.tolist()))
        view.add_row(answer.action, said[answer.possible], place)
    return view


def edit(
    options: Options,
    file: Path,
    config: Config,
    agent: Learner,
    path: Path,
    state: dict[str, Any],
) -> Path:
    """Make a run with the rules in a file and the rest of a state; its directory.

    Raises:
        ValueError: rules that the run cannot have, or a directory that cannot be written; nothing
            is left behind then.
    """
    rules = torch.from_numpy(files.read(file, files.schema(agent)))
    agent.net.replace_rules(*rules.split_with_sizes(agent.net.parts, 1))
    # The best and the last ten trials were those of other rules.
    state = state | {"network": checkpoint.describe(agent.net), "recent": [], "best": []}
    state["agent"] = state["agent"] | {"net": agent.net.state_dict()}
    home = home_of(options.run)
    if home is None:
        raise ValueError(f"{options.run}: --load needs a run directory or a checkpoint in one")
    home = home if home.name not in ("", "..") else home.resolve()
    usual = numbered(home.with_name(f"{home.name}-edited"))
    places = [home.with_name(options.name)] if options.name else usual
    before = json.loads((home / "config.json").read_bytes())
    session = {"versions": before.get("versions"), "commit": before.get("commit")}
    session["edited"] = {"checkpoint": str(path), "rules": str(file)}
    earlier = [*before.get("earlier", []), session]
    with Run.create(places, config, RunOptions.keep, earlier) as run:
        if (trials := home / "trials.csv").exists():
            shutil.copyfile(trials, run.path / "trials.csv")
        run.rewind(state)
    run.close()
    return run.path


def write(options: Options, config: Config, agent: Learner, reading: Reading, shares: Any) -> None:
    """Write the files that were asked for.

    Raises:
        OSError: a file cannot be written.
    """
    kind = files.schema(agent)
    parameters = agent.net.table().detach().T.numpy()
    comments = {"usage": shares.tolist(), "outvoted": reading.outvoted.tolist()}
    comments["text"] = reading.sentences()
    if options.json:
        data = files.to_json(kind, parameters, comments)
        checkpoint.write_atomically(options.json, data)
    if options.csv:
        checkpoint.write_atomically(options.csv, files.to_csv(kind, parameters, comments))
    if options.picture:
        figure = figures.rules(make_plan(config), agent, shares, reading.brief())
        data = figures.saved(figure, options.picture.suffix[1:])
        checkpoint.write_atomically(options.picture, data)


@arithmetic()
def run(options: Options) -> None:
    """What the command does.

    Raises:
        ValueError: the run or a rule file cannot be used.
        OSError: a file cannot be written.
    """
    check(options)
    config, agent, path, state = load(options.run)
    if options.picture and config.env != MAZE:
        raise ValueError(f"--picture is for the maze, not for --env {config.env}")
    if options.load:
        new, rules = edit(options, options.load, config, agent, path, state), agent.net.n_rules
        print(f"{new}: {plural(rules, 'rule')} from {options.load}, the rest from {path}")
        return
    print(learned(agent, path, state))
    reading = words.read(agent)
    if options.at:
        asked = state_of(options, config)
        decision = words.decide(agent, asked)
        place = map(words.at, config.task.axes, asked.tolist())
        print(f"at {', '.join(place)}:")
        show(decision_table(reading, decision, len(agent.inputs) > len(agent.task.axes)))
        print(f"action: {decision.action}")
        print(f"firing strength of the strongest rule: {decision.strongest:.2g}")
        return
    if options.within:
        answers = actions_within(agent, *region_of(options, config))
        show(region_table(answers, config.task.axes))
        return
    shares, decisions, outcome = firing_along_a_trial(config, agent, options.seed)
    print(f"one trial without learning or exploration, seed {options.seed}: {outcome}")
    print(summary(shares, decisions, reading))
    files = [path for path in (options.json, options.csv, options.picture) if path]
    if not files:
        show(table(reading, shares, options.top))
    write(options, config, agent, reading, shares)
    for file in files:
        print(f"written: {file}")


def main() -> None:
    """Entry point of ``python -m sofnn_torch.rules``."""
    command(run, Options, __doc__)


if __name__ == "__main__":
    main()
