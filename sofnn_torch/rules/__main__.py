"""Read the rules that a run has learned, write them to a file, load edited ones.

    python -m sofnn_torch.rules RUN                        # the rules that matter most, a table
    python -m sofnn_torch.rules RUN --words 5              # as sentences, from start to goal
    python -m sofnn_torch.rules RUN --at 0.15 0.15 90      # who decides at a pose: m, m, degrees
    python -m sofnn_torch.rules RUN --why 0.15 0.15 90     # why it does what it does there
    python -m sofnn_torch.rules RUN --check                # what is doubtful in them
    python -m sofnn_torch.rules RUN --within 0.1 0.2 0.1 0.2 60 120   # what it can do in a region
    python -m sofnn_torch.rules RUN --json rules.json --csv rules.csv --picture rules.png
    python -m sofnn_torch.rules RUN --html lab.html        # a page to look, change and drive
    python -m sofnn_torch.rules RUN --load rules.json      # edited rules become a new run
    python -m sofnn_torch.rules RUN --reduce 40            # few rules that drive as well, a new run
    python -m sofnn_torch.rules --new rules.csv            # rules alone do: with flags of train.py

The run directory is not changed. docs/rules.md says how to read a rule and what a file holds.
"""

import itertools
import math
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import numpy as np
import tyro
from numpy.typing import NDArray

from sofnn_torch.bounds import Count, Settings, Within
from sofnn_torch.evaluate import learned, load
from sofnn_torch.learners.learner import Learner
from sofnn_torch.pictures import figures, spots
from sofnn_torch.rules import checks, lab, new, played, tables, terms, why, words
from sofnn_torch.rules.editing import edited
from sofnn_torch.rules.reducing import reduce_run
from sofnn_torch.rules.regions import actions_within, ranges_within
from sofnn_torch.rules.words import Reading
from sofnn_torch.runs import checkpoint, rule_files
from sofnn_torch.runs.factory import make_plan
from sofnn_torch.runs.session import RunOptions, arithmetic
from sofnn_torch.runs.settings import MAZE, Config
from sofnn_torch.terminal import attempt, check_output, command, plural, say

PICTURES = (".png", ".svg", ".pdf")
ALONE = ("load", "reduce", "at", "why", "within", "check", "path", "why_trial")


@dataclass(frozen=True)
class Options(Settings):
    """Print the learned rules of a run as a table, the most used first; write, edit, explain."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Directory of the run, or one of its checkpoint files."""
    top: Annotated[int, Within(least=0)] = 20
    """Rules in the table; 0 for all."""
    words: Annotated[int, Within(least=2, most=7)] | None = None
    """Print them as sentences in the order of the way, with so many terms on each axis."""
    at: tuple[float, ...] | None = None
    """Show which rules decide at a state instead: in the maze x and y in metres and the heading in
    degrees, in another task its inputs in their order and units."""
    why: tuple[float, ...] | None = None
    """Say in a sentence why the policy does what it does at a state, in the units of --at;
    --picture draws the spot."""
    why_trial: Count | None = None
    """Say so of a decision in the trial of this number that `evaluate` plays with the same --seed;
    of trials of the training only the numbers in trials.csv are kept."""
    decision: Count | None = None
    """Number of the decision (with --why-trial)."""
    path: Path | None = None
    """Write every decision of that trial, or else of the first, to this .csv file."""
    check: bool = False
    """Look for contradictions, rules that are outvoted, idle or inside walls, and gaps on the
    way."""
    within: tuple[float, ...] | None = None
    """Show instead which actions the policy can take anywhere in a region, proved or with an
    example: the lower and the upper end of each input, in the units of --at."""
    json: Path | None = None
    """Write all rules to this .json file."""
    csv: Path | None = None
    """Write all rules to this .csv file."""
    html: Path | None = None
    """Write the lab to this .html file: a page to look at the rules, change them and drive."""
    picture: Path | None = None
    """Draw the rules into this .png, .svg or .pdf file."""
    load: Path | None = None
    """Make a new run out of this one and the rules in a .json or .csv file."""
    reduce: tuple[Count, ...] | None = None
    """Make a new run with so many rules that does what this one does; one for each number."""
    name: str | None = None
    """Name of the new run; by default that of the old one with `-edited` or, say, `-40-rules`."""
    seed: Annotated[int, Within(least=0)] = 1000
    """Seed of the trials: that which shows how much each rule is used, those of --why-trial, and of
    all chance in --reduce."""


def check(options: Options) -> None:
    """Check what can be checked before anything is loaded.

    Raises:
        ValueError: naming the flag.
    """
    for name in ("at", "why"):
        values = getattr(options, name)
        if values and not all(abs(value) < 1e6 for value in values):
            raise ValueError(f"--{name} must be a state in the units of its inputs, got {values}")
    if options.within and not all(abs(value) < 1e6 for value in options.within):
        raise ValueError(f"--within needs ends in the units of its inputs, got {options.within}")
    if options.name is not None and not options.load and len(options.reduce or ()) != 1:
        raise ValueError("--name goes with --load, or with --reduce and one number")
    RunOptions(name=options.name)
    outputs = {name: getattr(options, name) for name in ("json", "csv", "html", "picture")}
    for name, path in outputs.items():
        check_output(f"--{name}", path, PICTURES if name == "picture" else (f".{name}",))
    check_output("--path", options.path, (".csv",))
    if (options.why_trial is None) != (options.decision is None) and not options.path:
        raise ValueError("--why-trial and --decision go together")
    if options.decision and not options.why_trial:
        raise ValueError("--decision needs --why-trial")
    given = [name for name in (*ALONE, *outputs, "words") if getattr(options, name)]
    pairs = ({"why", "picture"}, {"why_trial", "picture"}, {"path", "why_trial"})
    if len(given) > 1 and set(given) & set(ALONE) and set(given) not in pairs:
        a, b = (f"--{name}".replace("_", "-") for name in given[:2])
        raise ValueError(f"{a} and {b} do not go together: use two commands")


def firing_along_a_trial(
    config: Config, agent: Learner, seed: int
) -> tuple[NDArray[Any], played.Played]:
    """Share of each rule (K,) in a trial without learning, and that trial."""
    trial = played.trial(config, agent, 1, seed)
    return agent.usage(trial.states), trial


def explain(options: Options, config: Config, agent: Learner) -> None:
    """Say why the policy does what it does at a state or did in a trial; write what is asked for.

    Raises:
        ValueError: there is no such decision, or rules have no vote.
        OSError: a file cannot be written.
    """
    plan = make_plan(config) if config.env == MAZE else None
    if options.why:
        state = state_of(options.why, "--why", config)
    else:
        number = options.why_trial or 1
        trial = played.trial(config, agent, number, options.seed)
        end = f"{played.outcome(trial.record)}, {plural(trial.record.decisions, 'decision')}"
        print(f"trial {number} of evaluate --seed {options.seed}, without learning: {end}")
        if options.path:
            checkpoint.write_atomically(options.path, played.to_csv(agent, trial))
            print(f"written: {options.path}")
        if not options.decision:
            return
        state = played.asked(trial, options.decision)
    place = ", ".join(map(words.at, config.task.axes, state.tolist()))
    print(f"at {place}:")
    reason = why.reason(agent, state)
    if options.decision and played.chance(trial, agent, options.decision):
        print(f"the policy took chance here to leave a circle, and did not do {reason.action};")
        print("without chance it would have:")
    print(why.sentence(agent, reason, plan))
    tables.show(why.table(agent, reason))
    print(why.threshold(reason))
    if options.picture:
        shown = [*itertools.chain(*reason.deciding())]
        figure = spots.spot(agent, state, shown, reason.values, f"{place}: {reason.action}", plan)
        data = figures.saved(figure, options.picture.suffix[1:])
        checkpoint.write_atomically(options.picture, data)
        print(f"written: {options.picture}")


def state_of(given: tuple[float, ...], flag: str, config: Config) -> NDArray[np.float32]:
    """The state (n,) that was asked for.

    Where it is out of range this warns, and no more: the rules answer everywhere.

    Raises:
        ValueError: it has another number of inputs.
    """
    axes, values = config.task.axes, list(given)
    if len(values) != len(axes):
        names = ", ".join(axis.name for axis in axes)
        raise ValueError(f"{flag} needs {len(axes)} numbers ({names}), got {len(values)}")
    if config.env == MAZE:
        width, height = make_plan(config).size
        x, y, degrees = values[:3]
        if not (0 <= x <= width and 0 <= y <= height):
            say(f"warning: {flag} {x:g} {y:g} is outside the maze of {width:g} x {height:g} m")
        values[2] = math.remainder(math.radians(degrees), 2 * math.pi)
    else:
        for axis, value in zip(axes, values, strict=True):
            if not (axis.period or axis.low <= value <= axis.high):
                ends = f"{axis.low:g} to {axis.high:g}"
                say(f"warning: {flag} {axis.name} {value:g} is out of its range, {ends}")
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


def write(options: Options, config: Config, agent: Learner, reading: Reading, shares: Any) -> None:
    """Write the files that were asked for.

    Raises:
        OSError: a file cannot be written.
    """
    kind = rule_files.schema(agent)
    parameters = agent.net.table().detach().T.numpy()
    comments = {"usage": shares.tolist(), "outvoted": reading.outvoted.tolist()}
    comments["text"] = reading.sentences()
    if options.json:
        data = rule_files.to_json(kind, parameters, comments)
        checkpoint.write_atomically(options.json, data)
    if options.csv:
        checkpoint.write_atomically(options.csv, rule_files.to_csv(kind, parameters, comments))
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
    loaded = load(options.run)
    config, agent, path, state = loaded
    if options.picture and config.env != MAZE and not (options.why or options.why_trial):
        raise ValueError(f"--picture is for the maze, not for --env {config.env}")
    if options.load:
        made, rules = edited(options.run, loaded, options.load, options.name), agent.net.n_rules
        print(f"{made}: {plural(rules, 'rule')} from {options.load}, the rest from {path}")
        return
    print(learned(agent, path, state))
    if options.why or options.why_trial or options.path:
        explain(options, config, agent)
        return
    if options.check:
        trial = played.trial(config, agent, 1, options.seed)
        print(f"one trial without learning, seed {options.seed}: {played.outcome(trial.record)}")
        plan = make_plan(config) if config.env == MAZE else None
        print(checks.report(checks.findings(agent, trial.states, plan)))
        return
    if options.reduce:
        reduce_run(options.run, loaded, options.reduce, options.name, options.seed)
        return
    reading = words.read(agent)
    if options.at:
        asked = state_of(options.at, "--at", config)
        decision = words.decide(agent, asked)
        place = map(words.at, config.task.axes, asked.tolist())
        print(f"at {', '.join(place)}:")
        tables.show(
            tables.decision_table(reading, decision, len(agent.inputs) > len(agent.task.axes))
        )
        print(f"action: {decision.action}")
        print(f"firing strength of the strongest rule: {decision.strongest:.2g}")
        return
    if options.within:
        region = region_of(options, config)
        if agent.choices:
            tables.show(tables.region_table(actions_within(agent, *region), config.task.axes))
        else:
            tables.show(tables.range_table(ranges_within(agent, *region)))
        return
    shares, trial = firing_along_a_trial(config, agent, options.seed)
    decisions, outcome = trial.record.decisions, played.outcome(trial.record)
    print(f"one trial without learning or exploration, seed {options.seed}: {outcome}")
    print(tables.summary(shares, decisions, reading))
    files = [path for path in (options.json, options.csv, options.html, options.picture) if path]
    if options.words:
        said = terms.sentences(agent, reading, options.words)
        when = played.moments(agent, trial.states)
        print(tables.along_the_way(said, shares, when, decisions, options.top))
        print(*(axis.bounds() for axis in terms.of_rules(agent, options.words)), sep="\n")
    elif not files:
        tables.show(tables.table(reading, shares, options.top))
    write(options, config, agent, reading, shares)
    if options.html:
        lab.write(options.html, options.run, loaded, trial.states)
    for file in files:
        print(f"written: {file}")


def main() -> None:
    """Entry point of ``python -m sofnn_torch.rules``."""
    if new.is_asked(sys.argv[1:]):
        sys.exit(attempt(lambda: new.begin(sys.argv[1:])))
    command(run, Options, __doc__)


if __name__ == "__main__":
    main()
