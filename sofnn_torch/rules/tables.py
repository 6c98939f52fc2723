"""What is known of rules, as tables for the terminal."""

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import words
from sofnn_torch.rules.regions import Answer, Range
from sofnn_torch.rules.words import Decision, Reading, number
from sofnn_torch.terminal import plural

WIDEST = 1000  # columns of a table for which there is room
WIDTH = 100  # columns of a table that does not go to a terminal
ENOUGH = 0.99  # share of the firing that decides at a pose
FIRED = 0.01  # a rule with less firing in all of a trial took no part, as in docs/metrics.md


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


def along_the_way(
    sentences: Sequence[str], shares: NDArray[Any], moments: NDArray[Any], decisions: int, top: int
) -> str:
    """The rules with the largest shares (K,) as sentences in the order of the way; 0 for all.

    Args:
        sentences: of all K rules.
        shares: of them in a trial.
        moments: the decision, from 0, at which each has its largest share. Shape: (K,).
        decisions: of the trial.
        top: how many rules.
    """
    rules = np.argsort(-shares, kind="stable")[: top or None]
    idle = shares * decisions < FIRED
    rules = rules[np.lexsort((moments[rules], idle[rules]))]
    lines = ["decision  rule  share"]
    for k in rules.tolist():
        when = "" if idle[k] else f"{moments[k] + 1:,}"
        lines.append(f"{when:>8}  {k + 1:>4}  {shares[k]:>5.1%}  {sentences[k]}")
    console = Console()
    if console.is_terminal:  # a file keeps a rule on a line
        lines = [textwrap.fill(line, console.width, subsequent_indent=" " * 23) for line in lines]
    return "\n".join(lines)


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


def region_table(answers: Sequence[Answer], axes: Sequence[Axis]) -> Table:
    """What a policy can do in a region."""
    view = Table("action", "there", "for example", box=SIMPLE_HEAD, pad_edge=False)
    said = {True: "taken", False: "never: proved", None: "not decided"}
    for answer in answers:
        found = answer.example
        place = "" if found is None else ", ".join(map(words.at, axes, found.tolist()))
        view.add_row(answer.action, said[answer.possible], place)
    return view


def range_table(ranges: Sequence[Range]) -> Table:
    """Between which ends a policy's action lies in a region."""
    view = Table("number", "never below", "seen", "never above", box=SIMPLE_HEAD, pad_edge=False)
    for found in ranges:
        seen = f"{found.least:+.3f} to {found.greatest:+.3f}"
        view.add_row(found.name, f"{found.low:+.3f}", seen, f"{found.high:+.3f}")
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
