"""A world that changes under a learning robot, and changes back: A, B, A.

    python -m sofnn_torch.studies.change                       # hours; finished seeds are kept
    python -m sofnn_torch.studies.change --learners q --seeds 0-1 --changes wall
    python -m sofnn_torch.studies.change --report-only         # the page from the data

The paper's abstract says that the network adapts to a change of its environment. A robot learns
the maze (A). Then a wall moves, or the goal, or the wheels are a tenth smaller than the robot takes
them to be (B), and it learns on; then all is as before (A again). Each change begins from a copy of
what was learned in A. Learners are told nothing of a change.
"""

import copy
import dataclasses
import json
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sofnn_torch import terminal
from sofnn_torch.bounds import Count, Settings
from sofnn_torch.maze.layouts import STANDARD, standard_path
from sofnn_torch.runs import parallel, places, seeding
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.collecting import IN_A_ROW, WITHIN
from sofnn_torch.studies.peers import Trial, learned, play
from sofnn_torch.studies.results import NEVER, cell, markdown, read_table, write_table
from sofnn_torch.studies.statistics import median, share
from sofnn_torch.studies.tiles import TileCoder, TileConfig
from sofnn_torch.terminal import say

LEARNERS = {
    "sga-sofnn": "SGA, growing network",
    "q-sofnn": "Q-learning, growing network",
    "sga-fixed": "SGA, fixed grid",
    "q-fixed": "Q-learning, fixed grid",
    "tiles": "tile coding",
}
CHANGES = {
    "wall": "the upper wall moves 60 mm south",
    "goal": "the goal moves to the west end of the middle corridor",
    "wheel": "the wheels are 10 % smaller than the robot takes them to be",
}
# What another place is called in the standard maze's MJCF, and what it becomes.
WALL = {"0.66 0.667 0.02": "0.66 0.607 0.02"}
GOAL = {"0.85 0.85 0": "0.1 0.45 0"}
PLAYED, LIMIT = 10, 2_000  # greedy trials where a world comes or goes, and their steps at most
SMALLER = 1 / 0.9  # what the robot takes its wheels to be, over what they are


@dataclass(frozen=True)
class Options(Settings):
    """Change the world under learning robots, and back."""

    learners: tuple[Literal["sga-sofnn", "q-sofnn", "sga-fixed", "q-fixed", "tiles"], ...] = (
        "sga-sofnn",
        "q-sofnn",
        "sga-fixed",
        "q-fixed",
        "tiles",
    )
    """Learners."""
    changes: tuple[Literal["wall", "goal", "wheel"], ...] = ("wall", "goal", "wheel")
    """What changes."""
    seeds: str = "0-9"
    """Seeds of each learner."""
    before: Count = 60
    """Trials in A."""
    during: Count = 25
    """Trials in B."""
    after: Count = 15
    """Trials in A again."""
    max_steps: Count = 5_000
    """Steps after which a trial ends."""
    workers: Count = 2
    """Seeds at the same time, each in a process of its own."""
    out: Path = Path("docs/results")
    """Where data and page go; seeds of the same trials that are there are kept."""
    report_only: bool = False
    """Run nothing: the page from the data that is there."""


def world(config: Config, change: str | None) -> Config:
    """The settings of a run in the maze as it is, or changed."""
    maze, text = config.maze, standard_path().read_text()
    for old, new in {"wall": WALL, "goal": GOAL}.get(change or "", {}).items():
        maze = dataclasses.replace(maze, layout=text.replace(f'pos="{old}"', f'pos="{new}"'))
    if change == "wheel":
        maze = dataclasses.replace(maze, wheel_radius_scale=SMALLER)
    return dataclasses.replace(config, maze=maze)


def phase(config: Config, agent: Any, trials: int, seed: int) -> list[Trial]:
    """Trials of learning in one world."""
    env: Any = make_env(config)
    env.reset(seed=seed)
    played = [play(env, agent) for _ in range(trials)]
    env.close()
    return played


def arrives(config: Config, agent: Any, seed: int) -> tuple[int, float]:
    """How many greedy trials arrive, without learning or a cure for loops, and their mean steps."""
    most = min(LIMIT, config.maze.max_steps)
    maze = dataclasses.replace(config.maze, max_steps=most)
    env: Any = make_env(dataclasses.replace(config, maze=maze))
    env.reset(seed=seeding.stream("maze", seed))
    trials = [play(env, agent, learn=False) for _ in range(PLAYED)]
    env.close()
    return sum(t.success for t in trials), float(np.mean([t.steps for t in trials]))


def recovered(trials: list[Trial], layout: str) -> float:
    """Trials before the first ten good ones in a row; NaN if there are none."""
    return learned(trials, layout) - IN_A_ROW


@arithmetic()
def lives(learner: str, seed: int, options: Options) -> list[dict[str, Any]]:
    """The rows of a learner with a seed: one for each change."""
    kind, _, network = learner.partition("-")
    own: dict[str, Any] = {} if kind == "tiles" else {"agent": kind, "network": network}
    config = Config(**own, seed=seed)
    maze = dataclasses.replace(config.maze, max_steps=options.max_steps)
    if kind == "tiles":
        maze = dataclasses.replace(maze, actions="three")
    config = dataclasses.replace(config, maze=maze)
    agent: Any = make_agent(config)
    if kind == "tiles":
        env: Any = make_env(config)
        agent = TileCoder(TileConfig(), env.unwrapped.axes, 3, seed)
        env.close()
    first = phase(config, agent, options.before, seeding.stream("training", seed))
    before = arrives(config, agent, seed)
    rows = []
    for number, change in enumerate(options.changes):
        alive, other = copy.deepcopy(agent), world(config, change)
        begin = rules(alive)
        at_once = arrives(other, alive, seed)
        second = phase(other, alive, options.during, 1 + number)
        there, grown = arrives(other, alive, seed), rules(alive) - begin
        back = arrives(config, alive, seed)
        third = phase(config, alive, options.after, 101 + number)
        rows.append(
            {
                "learner": learner,
                "change": change,
                "seed": seed,
                "trials": f"{options.before} {options.during} {options.after}",
                "learned": before[0],
                "trials_to_learn": learned(first),
                "at_once": at_once[0],
                "recovered": recovered(second, other.maze.layout),
                "changed": there[0],
                "changed_steps": there[1],
                "rules": begin,
                "rules_added": grown,
                "returned": back[0],
                "returned_steps": back[1],
                "recovered_again": recovered(third, STANDARD),
            }
        )
    return rows


def rules(agent: Any) -> int:
    """Rules of a learner; tiles of a tile coder."""
    return agent.weights.shape[0] if isinstance(agent, TileCoder) else agent.net.n_rules


# ------------------------------------------------------------------------------------- page

HOW = f"""\
A learner *recovered* after so many trials, exploration included, if the next {IN_A_ROW} stay under
{WITHIN} times the optimum of the changed maze; *never* if that does not come. Success is that of
{PLAYED} greedy trials of each seed, of at most {LIMIT:,} steps, without learning and without a cure
for loops: in A as learned, in B before anything was learned there and after it, and in A at the
return, before anything is learned there again: what is missing was forgotten. Medians and shares
with 95 % intervals; of fewer than five seeds the values themselves. Goal: recovered in 10 trials, A
still at 95 % at the return."""


def page(rows: list[dict[str, Any]], commands: list[str]) -> str:
    """The page of what was measured."""
    head = ["learner", "seeds", "A [%]", "B at once [%]", "recovered after", "B learned [%]"]
    head += ["rules in A", "rules added in B", "A at the return [%]", "recovered again after"]
    parts = ["# A world that changes", __doc__.split("\n\n")[2].strip().replace("\n", " "), HOW]
    for change, text in CHANGES.items():
        table = list(_lines([row for row in rows if row["change"] == change]))
        if table:
            parts += [f"## {text[0].upper()}{text[1:]}", markdown(head, table)]
    made = ", ".join(f"`{command}`" for command in commands)
    parts += ["## Provenance", f"Made with {made}. A row for each run: [change.csv](change.csv)."]
    return "\n\n".join(parts) + "\n"


def _lines(rows: list[dict[str, Any]]) -> Iterator[list[str]]:
    for learner, title in LEARNERS.items():
        mine = [row for row in rows if row["learner"] == learner]
        if not mine:
            continue

        def of(name: str, mine: list[dict[str, Any]] = mine) -> Any:
            values = np.array([float(row[name]) for row in mine])
            return np.where(np.isnan(values), NEVER, values)

        line = [title, str(len(mine))]
        line += [_cell(name, of(name)) for name in ("learned", "at_once", "recovered", "changed")]
        line += [cell(median(of("rules"))), cell(median(of("rules_added")))]
        yield [*line, _cell("returned", of("returned")), _cell("recovered", of("recovered_again"))]


def _cell(name: str, values: Any) -> str:
    return cell(median(values)) if name == "recovered" else cell(share(values, PLAYED), 0, 100)


def run(options: Options) -> int:
    """What the command does; the exit code.

    Raises:
        ValueError: there is no data, or seeds that are none.
    """
    table, notes = options.out / "change.csv", options.out / "change.json"
    rows = read_table(table) if table.exists() else []
    commands = json.loads(notes.read_text()) if notes.exists() else []
    if not options.report_only:
        places.directory(options.out, "--out")
        _complete(options, rows, table)
        rows = read_table(table)
        commands = list(dict.fromkeys([*commands, command(options)]))
        notes.write_text(json.dumps(commands, indent=1) + "\n")
    if not rows:
        raise ValueError(f"{options.out}: no data of this study; run it first")
    (options.out / "change.md").write_text(page(rows, commands))
    say(f"written: {options.out}/change.md")
    return 0


def _complete(options: Options, rows: list[dict[str, Any]], table: Path) -> None:
    """Run what is not there yet, and write the table after each."""
    length = f"{options.before} {options.during} {options.after}"
    there = {_key(row) for row in rows if row["trials"] == length}
    todo = [
        (learner, seed)
        for seed in parallel.parse(options.seeds)
        for learner in options.learners
        if not all((learner, change, seed) in there for change in options.changes)
    ]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = {pool.submit(lives, *job, options): job for job in todo}
        for done in as_completed(jobs):
            fresh = done.result()
            new = set(map(_key, fresh))
            rows = [row for row in rows if _key(row) not in new]
            rows = sorted([*rows, *fresh], key=_key)
            write_table(table, rows)
            say(f"{jobs[done][0]}, seed {jobs[done][1]}: done")


def _key(row: dict[str, Any]) -> tuple[str, str, int]:
    return row["learner"], row["change"], int(row["seed"])


def command(options: Options) -> str:
    """The command that makes the data."""
    given, usual = vars(options), vars(Options())
    words = ["python -m sofnn_torch.studies.change"]
    for name in ("learners", "changes", "seeds", "before", "during", "after", "max_steps"):
        if given[name] != usual[name]:
            value = given[name] if isinstance(given[name], tuple) else [given[name]]
            words.append(f"--{name.replace('_', '-')} {' '.join(map(str, value))}")
    return " ".join(words)


def main() -> None:
    """Entry point of ``python -m sofnn_torch.studies.change``."""
    terminal.command(run, Options, __doc__, advice="the same command goes on")


if __name__ == "__main__":
    main()
