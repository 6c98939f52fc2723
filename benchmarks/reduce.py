r"""How well few rules drive: `rules RUN --reduce`, over many seeds, learners and tasks.

Trains what is not in the folder of runs yet, with the presets (`train.py`), makes small rule bases
of each run, and plays all of them, the full one too, as `evaluate` does, on a seed that nothing was
chosen by. One row for each rule base goes to the CSV file; rows that are there are not made again.
Prints the table of docs/rules.md and draws its curves.

    python benchmarks/reduce.py --runs runs/reduce --out reduced.csv --picture reduced.png
    python benchmarks/reduce.py --out tasks.csv --tasks MountainCar-v0 CartPole-v1 --train 200 \
        --seeds 1 5 --rules 20 10 5
"""

import argparse
import csv
import itertools
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import NullLocator

from sofnn_torch import training
from sofnn_torch.evaluate import evaluate, load
from sofnn_torch.learners.learner import Learner
from sofnn_torch.pictures import figures
from sofnn_torch.rules.reducing import measured, reduced
from sofnn_torch.runs.session import RunOptions, arithmetic, saved_config
from sofnn_torch.runs.settings import MAZE, Config

CHOICE, TEST = 1, 5000  # seeds: of the reduction, and of the trials that judge it
FIDELITY = 10  # plain trials on whose states decisions are compared
NAMES = {"sga": "SGA", "q": "Q-learning"}
Row = dict[str, Any]


def run_of(folder: Path, config: Config) -> Path:
    """The run with these settings; it is trained if it is not there.

    Raises:
        ValueError: a run of that name has other settings.
    """
    name = f"{config.env}-{config.agent}-{config.seed}"
    if not (folder / name).exists():
        options = RunOptions(runs=folder, name=name, picture_every=0, video_every=0, quiet=True)
        training.train(config, options)
    elif saved_config(folder / name) != config:
        raise ValueError(f"{folder / name} has other settings than those asked for: move it away")
    return folder / name


def played(config: Config, agent: Learner, trials: int) -> Row:
    """How a policy plays, as `evaluate` says it."""
    records = evaluate(config, agent, trials, seed=TEST)
    return {
        "rules": agent.net.n_rules,
        "outcome": np.mean([record.outcome for record in records]),
        "steps": np.mean([record.steps for record in records]),
        "freed": sum(bool(record.freed) for record in records),
    }


def rows(run: Path, counts: list[int], trials: int, done: set[int]) -> Iterator[Row]:
    """The full rule base, as `asked` 0, and each small one that is not done yet."""
    config, full, _, _ = load(run)
    task = {"task": config.env, "agent": config.agent, "seed": config.seed, "trials": trials}
    if 0 not in done:
        yield task | {"asked": 0} | played(config, full, trials)
    for count in counts:
        if count in done or count >= full.net.n_rules:
            continue
        began = time.monotonic()
        small = reduced(config, full, count, CHOICE)
        seconds = time.monotonic() - began
        fidelity = measured(config, full, [small], FIDELITY, TEST)[1]
        shares = {"on_full": fidelity.on_full, "on_own": fidelity.on_own}
        found = played(config, small, trials)
        yield task | {"asked": count} | found | shares | {"seconds": round(seconds, 1)}


COLUMNS = "task agent seed trials asked rules outcome steps freed on_full on_own seconds".split()


def read(path: Path) -> list[Row]:
    """The rows of a CSV file, numbers as numbers; none if there is no file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        lines = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return [{k: v if k in COLUMNS[:2] else float(v or "nan") for k, v in x.items()} for x in lines]


def table(found: list[Row]) -> str:
    """A line of Markdown for each task, learner and number of rules; medians are of the seeds."""
    lines = [
        "| task, learner | rules | outcome | seeds below 99.5 % | steps over the full's: median, "
        "worst | way out | same decision on the full policy's way, on its own |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    kinds = {(row["task"], row["agent"]): None for row in found}
    for task, agent in kinds:
        ours = [row for row in found if (row["task"], row["agent"]) == (task, agent)]
        full = {row["seed"]: row for row in ours if not row["asked"]}
        for asked in sorted({row["asked"] for row in ours}, key=lambda n: -n or -1e9):
            some = [row for row in ours if row["asked"] == asked]
            outcomes = np.array([row["outcome"] for row in some])
            ratios = [row["steps"] / full[row["seed"]]["steps"] - 1 for row in some]
            cells = [f"{task}, {NAMES[agent]}", f"{np.median([r['rules'] for r in some]):.0f}"]
            if task == MAZE:
                cells += [f"{outcomes.mean():.2%}", f"{sum(outcomes < 0.995)} of {len(some)}"]
                cells += [f"{np.median(ratios):+.1%}, {max(ratios):+.1%}" if asked else ""]
            else:
                cells += [", ".join(f"{outcome:.4g}" for outcome in outcomes), "", ""]
            cells += [f"{sum(row['freed'] for row in some):.0f}"]
            shares = (np.median([row[on] for row in some]) for on in ("on_full", "on_own"))
            cells += [", ".join(f"{share:.1%}" for share in shares) if asked else ""]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


@figures.styled
def draw(found: list[Row], path: Path) -> None:
    """Steps, over those of the full policy, and success in the maze against the number of rules."""
    found = [row for row in found if row["task"] == MAZE]
    figure, (left, right) = figures.canvas(2, 3.6, 2.8)
    # Hollow marks of two sizes: equal values are seen in each other.
    for agent, (colour, line), size in zip(NAMES, figures.SERIES, (7, 4), strict=False):
        ours = [row for row in found if row["agent"] == agent]
        full = {row["seed"]: row["steps"] for row in ours if not row["asked"]}
        asked = sorted({row["asked"] for row in ours if row["asked"]})
        many = np.median([row["rules"] for row in ours if not row["asked"]])
        points = []
        for count in [*asked, 0]:
            some = [row for row in ours if row["asked"] == count]
            ratios = np.array([row["steps"] / full[row["seed"]] for row in some])
            goal = sum(row["outcome"] for row in some) / len(some)
            x = count or many
            points.append((x, np.median(ratios), goal))
            left.plot([x] * len(ratios), ratios, "o", color=colour, ms=2.5, alpha=0.35, mew=0)
        x, steps, goals = np.array(points).T
        mark = {"marker": "o" if agent == "sga" else "s", "mfc": "none", "ms": size}
        left.plot(x, steps, color=colour, linestyle=line, label=NAMES[agent], **mark)
        right.plot(x, 100 * goals, color=colour, linestyle=line, **mark)
    for ax in (left, right):
        ax.set(xscale="log", xlabel="rules")
        ax.set_xticks([5, 10, 20, 40, 100, 200, 400, 800], minor=False)
        ax.xaxis.set_major_formatter("{x:.0f}")
        ax.xaxis.set_minor_locator(NullLocator())
    low, high = left.get_ylim()
    left.set(ylabel="steps, over those of the full policy", yscale="log")
    left.set_yticks([0.5, 0.8, 0.9, 1, 1.1, 1.2, 1.5, 2, 3, 5, 10, 20, 40])
    left.set_ylim(min(0.9, low), max(1.2, high))
    left.yaxis.set_major_formatter("{x:g}")
    left.yaxis.set_minor_locator(NullLocator())
    right.set(ylabel="trials that reach the goal [%]")
    right.set_ylim(min(90, right.get_ylim()[0]), 101)
    left.legend()
    path.write_bytes(figures.saved(figure, path.suffix[1:]))


@arithmetic()
def main() -> None:
    """Train, reduce, play; print the table and draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=Path, default=Path("runs/reduce"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--tasks", nargs="+", default=[MAZE])
    parser.add_argument("--agents", nargs="+", default=["sga", "q"])
    parser.add_argument("--seeds", type=int, nargs=2, default=[1, 20], help="first and last")
    parser.add_argument("--train", type=int, default=100, help="trials of each training")
    parser.add_argument("--trials", type=int, default=100, help="that each policy plays")
    parser.add_argument("--rules", type=int, nargs="+", default=[40, 20, 10])
    options = parser.parse_args()
    if not options.out.exists():
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True)
        head = f"# commit {commit.stdout.decode().strip()}, presets, {options.train} trials learned"
        options.out.write_text(f"{head}\n{','.join(COLUMNS)}\n")
    seeds = range(options.seeds[0], options.seeds[1] + 1)
    for task, seed, agent in itertools.product(options.tasks, seeds, options.agents):
        config = Config(env=task, agent=agent, seed=seed, trials=options.train)
        key = {"task": task, "agent": agent, "seed": seed}
        done = {int(row["asked"]) for row in read(options.out) if row.items() >= key.items()}
        if done >= {0, *options.rules}:
            continue
        run = run_of(options.runs, config)
        for row in rows(run, options.rules, options.trials, done):
            with open(options.out, "a", newline="") as file:
                csv.DictWriter(file, COLUMNS).writerow(row)
            print(run.name, *row.values(), flush=True)
    found = read(options.out)
    print(table(found))
    if options.picture:
        draw(found, options.picture)


if __name__ == "__main__":
    main()
