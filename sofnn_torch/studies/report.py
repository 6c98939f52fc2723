"""Pages in Markdown, with figures, from the data of the studies: nothing here needs the runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.studies import drawing
from sofnn_torch.studies.claims import GOALS, HOW, SWAPPED, arriving, claims, closing_table, goals
from sofnn_torch.studies.drawing import AGENTS
from sofnn_torch.studies.results import (
    Data,
    cell,
    learned_after,
    markdown,
    read,
    success,
    until_learned,
)
from sofnn_torch.studies.robustness import EPISODES
from sofnn_torch.studies.statistics import median, ratio, share
from sofnn_torch.studies.studies import STUDIES
from sofnn_torch.terminal import say

RESULTS = Path("docs/results")
NOTES = """\
Cells are medians over the seeds, with the 95 % interval of a percentile bootstrap over seeds in
brackets; of fewer than five seeds, which no interval describes, the values themselves. Success is
the share of all trials with its exact interval, wider where the seeds differ (Korn and Graubard).
*Arriving* is the number of seeds for which at least 9 of the last 10 training trials ended
at the goal. *Trials to learn* is the trial that completes the first {in_a_row} in a row under
{within} times the optimum (in training, so exploration included); a run where that never happens
counts as more than its number of trials. What was
learned is then played for {episodes} trials without learning: *greedy* is the mean action (SGA) or
the best one (Q), *sampled* the stochastic policy of the training; both gain chance where they run
in [circles](../paper.md#what-plays-in-an-evaluation-and-loops). *Plain* is greedy without that, and
*freed* counts the greedy trials in which chance was given. A trial that fails counts with its
{limit:,} steps. The kinematic optimum of the maze, with actions held 10 steps, is {optimum} steps
(`python -m sofnn_torch.maze.optimum`)."""
TAKEN = """\
Sums over the trials until a run had learned, medians over the seeds; a seed that did not counts as
*never*. Each replayed decision is one drawn
from the memory and learned from again; batches hold 64. The processor time is that of all trials,
of pictures and checkpoints, and of the evaluation."""
DIVERGED = """\
A seed *diverged* if its numbers left all bounds, where the training stops. It counts as one that
never reaches the goal, with the rules of its last whole trial; an arm of nothing else shows `-`."""
CONDITION_NOTES = """\
Greedy policy, 10 trials for each seed; success is the share of all trials, steps are medians over
the seeds, with 95 % intervals; of fewer than five seeds the values themselves. The robot is told
the pose that it starts from, scattered or not. The sampled policy is in the data."""


def arm_table(data: Data, arms: Sequence[str]) -> str:
    """The main table of a study, for some of its arms."""
    changes = any(data.info["arms"][arm]["changes"] for arm in arms)
    base = next((arm for arm in arms if arm.endswith("-default")), None)
    head = [
        "arm",
        *["change"] * changes,
        "seeds",
        "arriving",
        "trials to learn",
        "success, greedy [%]",
    ]
    head += ["steps, greedy", "over the optimum", *["over the default"] * bool(base)]
    plain = data.has("plain_steps")
    if plain:
        head += ["success, plain [%]", "steps, plain", "trials freed"]
    head += ["success, sampled [%]", "steps, sampled", "collisions a trial", "rules"]
    rows = []
    for arm in arms:
        flags = data.info["arms"][arm]["changes"]
        greedy = data.column(arm, "greedy_steps")
        row = [arm, *[f"`{flags}`" if flags else ""] * changes, str(len(greedy))]
        row.append(data.remark(str(arriving(data, arm)[0]), arm))
        if data.diverged(arm) == len(greedy):
            rows.append(row + ["-"] * (len(head) - len(row)))
            continue
        row += [
            cell(learned_after(data, arm), limit=data.column(arm, "trials")[0]),
            cell(success(data, arm, "greedy"), 1, 100),
            cell(median(greedy)),
            cell(median(greedy), 2, 1 / data.info["optimum"]),
        ]
        if base:
            compared = ratio(greedy, data.column(base, "greedy_steps"))
            row.append(cell(compared, 2) if arm != base else "1")
        if plain:
            freed, trials = data.column(arm, "trials_freed").sum(), data.info["episodes"]
            row += [
                cell(success(data, arm, "plain"), 1, 100),
                cell(median(data.column(arm, "plain_steps"))),
                f"{freed:.0f} of {trials * len(greedy)}",
            ]
        row += [
            cell(success(data, arm, "sampled"), 1, 100),
            cell(median(data.column(arm, "sampled_steps"))),
            cell(median(data.column(arm, "sampled_collisions")), 1),
            cell(median(data.column(arm, "rules"))),
        ]
        rows.append(row)
    return markdown(head, rows, 1 + changes)


def learning_table(data: Data) -> str:
    """What each arm took until it had learned."""
    head = ["arm", "trials", "steps of the environment", "decisions taken", "decisions replayed"]
    head += ["processor time of a whole run [s]"]
    rows = []
    for arm in data.arms():
        if data.diverged(arm) < len(data.column(arm, "trials")):
            took = (until_learned(data, arm, name) for name in ("steps", "decisions", "replayed"))
            trials = cell(learned_after(data, arm), limit=data.column(arm, "trials")[0])
            seconds = cell(median(data.column(arm, "cpu_seconds")))
            rows.append([arm, trials, *took, seconds])
    return markdown(head, rows)


def arm_tables(data: Data) -> str:
    """A table for each learner where arms vary the settings of one, else one for all."""
    arms = data.arms()
    if not any(arm.endswith("-default") for arm in arms):
        return arm_table(data, arms)
    own = {title: [a for a in arms if a.startswith(f"{k}-")] for k, title in AGENTS.items()}
    parts = [f"### {title}\n\n{arm_table(data, names)}" for title, names in own.items() if names]
    return "\n\n".join(parts)


def provenance(info: dict[str, Any]) -> str:
    """With what a study was made, and how long it took."""
    commits = ", ".join(f"`{commit}`" for commit in info["commits"]) + _mixed(info)
    versions = "; ".join(
        ", ".join(f"{name} {version}" for name, version in made.items())
        for made in info["versions"]
    )
    hours = info["wall_seconds"] / 3600, info["cpu_seconds"] / 3600
    return (
        f"Made with {_commands(info)}; number of runs: {info['runs']}, together {hours[0]:.2f} "
        f"hours of wall time and {hours[1]:.2f} of processor time. Commit: {commits}. "
        f"Versions: {versions}. Settings and seeds of every arm: "
        f"[{info['study']}.json]({info['study']}.json); a line for each run: "
        f"[{info['study']}.csv]({info['study']}.csv)."
    )


def _mixed(info: dict[str, Any]) -> str:
    """Which arms are of which commits, where they differ."""
    arms = {arm: kept.get("commits") for arm, kept in info["arms"].items()}
    if all(commits == next(iter(arms.values())) for commits in arms.values()):
        return ""
    told = (f"{arm} {', '.join(str(c)[:7] for c in made or ['?'])}" for arm, made in arms.items())
    return f" (**the arms are of different commits**: {'; '.join(told)})"


def _commands(info: dict[str, Any]) -> str:
    return ", ".join(f"`{command}`" for command in info["made_with"])


def page(out: Path, data: Data) -> str:
    """The page of a study; its figures are drawn into the directory."""
    info, study = data.info, STUDIES[data.info["study"]]
    limit = max(arm["config"]["maze"]["max_steps"] for arm in info["arms"].values())
    trials = sorted({arm["config"]["trials"] for arm in info["arms"].values()})
    length = f"Runs of {' or '.join(map(str, trials))} trials."
    parts = [f"# {info['title']}", f"{study.about} {length}"]
    if info["quick"]:
        parts.append("**A quick look with short runs: the numbers mean nothing.**")
    if study.figures:
        parts += ["## Beside the paper's numbers"]
        parts += [markdown(["", "paper", "here", "over the optimum"], closing_table(data)), SWAPPED]
        parts += ["## The paper's claims"]
        parts += [markdown(["claim", "criterion", "measured", "verdict"], claims(data), 4), HOW]
        if (out / "fixed.csv").exists():
            parts += ["What else was tried for FSFNN: [the search over its settings](fixed.md)."]
        parts += ["## What was to be reached (greedy policy)"]
        parts += [markdown(["learner", "goal", "measured", "reached"], goals(data), 4), GOALS]
    if study.conditions and "conditions" in data.tables:
        parts += ["## In other conditions", condition_table(data), CONDITION_NOTES]
    captions = drawing.draw(out, data)
    if captions:
        parts += [
            "## Figures",
            *(f"![{text.partition(':')[0]}]({name}.png)\n\n*{text}*" for name, text in captions),
        ]
    parts += ["## All arms", arm_tables(data), NOTES.format(limit=limit, **info)]
    if data.has("steps_to_learn"):
        parts += ["## What learning took", learning_table(data), TAKEN]
    parts += [DIVERGED] * bool(data.diverged(*info["arms"]))
    return "\n\n".join(part.strip() for part in [*parts, "## Provenance", provenance(info)]) + "\n"


def condition_table(data: Data) -> str:
    """Success and steps of every arm in every condition."""
    rows = data.tables["conditions"]
    conditions = list(dict.fromkeys((row["group"], row["value"]) for row in rows))
    arms = data.arms()
    head = [
        "condition",
        *(f"{arm}, {quantity}" for arm in arms for quantity in ("success", "steps")),
    ]
    lines = []
    for group, value in conditions:
        line = [group.replace("[", f"{value:g} [")]
        for arm in arms:
            chosen = [
                row
                for row in rows
                if (row["arm"], row["group"], row["value"]) == (arm, group, value)
                and row["policy"] == "greedy"
            ]
            shares, steps = (np.array([row[q] for row in chosen]) for q in ("success", "steps"))
            arrived = share(np.rint(shares * EPISODES), EPISODES)
            line += [f"{cell(arrived, 0, 100)} %", cell(median(steps))]
        lines.append(line)
    return markdown(head, lines)


def write(out: Path) -> int:
    """Write the page of every study that has data in a directory, and the index; the exit code.

    Raises:
        ValueError: there is no data.
    """
    names = [name for name in STUDIES if (out / f"{name}.csv").exists()]
    if not names:
        raise ValueError(f"{out}: no data of a study; run one first")
    index = []
    for name in names:
        data = read(out, name)
        (out / f"{name}.md").write_text(page(out, data))
        seeds = sorted({len(arm["seeds"]) for arm in data.info["arms"].values()})
        count = "-".join(map(str, seeds[:: max(1, len(seeds) - 1)]))
        link = f"[{data.info['title']}]({name}.md)"
        index.append([link, str(len(data.info["arms"])), count, _commands(data.info)])
    where = "" if out.resolve() == RESULTS.resolve() else f" --out {out}"
    text = (
        "# Results\n\nEvery table and figure here is written by a command, from the data beside "
        f"it. `python -m sofnn_torch.studies --report-only{where}` writes them anew without "
        "running anything.\n\n"
    )
    text += markdown(["study", "arms", "seeds of an arm", "command"], index, 4)
    more = [path for name in ("peers", "change") if (path := out / f"{name}.md").exists()]
    if more:
        titles = (f"[{path.read_text().splitlines()[0][2:]}]({path.name})" for path in more)
        text += f"\n\nMade by commands of their own: {', '.join(titles)}."
    if (out / "earlier").exists():
        text += "\n\nOf earlier code, which told the robot more: [earlier](earlier/README.md)."
    (out / "README.md").write_text(text + "\n")
    say(f"written: {out}/README.md and the pages of {', '.join(names)}")
    return 0
