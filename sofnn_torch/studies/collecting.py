"""The data of a study, as small files, from its finished runs."""

import contextlib
import dataclasses
import itertools
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.pictures.figures import read_column
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.results import write_table
from sofnn_torch.studies.running import EPISODES, PLAYED, POLICIES, find_runs, sittings
from sofnn_torch.studies.studies import STUDIES, changed, essence, settings

IN_A_ROW, WITHIN = 10, 1.5  # learned: so many trials in a row under so many times the optimum
TAKEN = {"steps": "steps", "decisions": "decisions", "replayed": "learning/replayed"}


def collect(
    name: str,
    parent: Path,
    out: Path,
    changes: Mapping[str, Any],
    notes: Mapping[str, Any],
    any_code: bool = False,
) -> None:
    """Write the data of a study from all its finished runs, whatever their seeds.

    Args:
        name: of the study.
        parent: where the runs are.
        out: where the data goes.
        changes: settings that are changed in every arm.
        notes: more entries of the summary: command, quick and optimum. Commands of earlier
            sittings stay beside this one.
        any_code: take also runs of code that learns or plays in another way.

    The files are <study>.csv (a line for each run), <study>-curves.csv (steps and rules of each
    trial), <study>-paths.csv (the last trial), <study>-conditions.csv and <study>.json.
    """
    study = STUDIES[name]
    parts = ("", "curves", "paths", "conditions")
    tables: dict[str, list[dict[str, Any]]] = {part: [] for part in parts}
    of_arm: dict[Config, list[tuple[int, Path]]] = {}
    for config, path in find_runs(parent, any_code)[0].items():
        if (path / "evaluation.json").exists():
            anonymous = dataclasses.replace(config, seed=0)
            of_arm.setdefault(anonymous, []).append((config.seed, path))
    arms, spans, sources, played = {}, [], [], []
    for arm, entries in study.arms.items():
        config = settings({**entries, **changes})
        found = sorted(of_arm.get(essence(config), []))
        if not found:
            continue
        made = [source for _, path in found for source in sittings(path)]
        arms[arm] = {
            "changes": changed(entries),
            "commits": _distinct(source["commit"] for source in made),
            "seeds": [seed for seed, _ in found],
            "config": {k: v for k, v in dataclasses.asdict(config).items() if k != "seed"},
        }
        sources += made
        for seed, path in found:
            key = {"arm": arm, "seed": seed}
            row = _row(path, config, notes["optimum"])
            tables[""].append(key | row)
            spans.append((path, row["wall_seconds"], row["cpu_seconds"]))
            if (path / PLAYED).exists():
                played += json.loads((path / PLAYED).read_text())
            tables["curves"] += [key | curve for curve in _curves(path)]
            if study.figures:
                tables["paths"] += [key | point for point in _path(path)]
            if study.conditions and (path / "conditions.json").exists():
                results = json.loads((path / "conditions.json").read_text())
                tables["conditions"] += [key | result for result in results]
    out.mkdir(parents=True, exist_ok=True)
    for part, rows in tables.items():
        if rows:
            write_table(out / f"{name}{'-' * bool(part)}{part}.csv", rows)
    seconds = {path: (wall, cpu) for path, wall, cpu in spans}  # arms may share runs
    notes, file = dict(notes), out / f"{name}.json"
    earlier = json.loads(file.read_text()).get("made_with", []) if file.exists() else []
    made_with = [*earlier, notes.pop("command")]
    summary = {
        "study": name,
        "title": study.title,
        "about": study.about,
        **notes,
        "made_with": list(dict.fromkeys(made_with)),
        "episodes": EPISODES,
        "in_a_row": IN_A_ROW,
        "within": WITHIN,
        "runs": len(seconds),
        "wall_seconds": round(sum(wall for wall, _ in seconds.values())),
        "cpu_seconds": round(sum(cpu for _, cpu in seconds.values())),
        "commits": _distinct(source["commit"] for source in sources),
        "versions": _distinct([*(source["versions"] for source in sources), *played]),
        "arms": arms,
    }
    file.write_text(json.dumps(summary, indent=1) + "\n")


def _row(path: Path, config: Config, optimum: int) -> dict[str, Any]:
    """What one run came to; a run that diverged counts as one that never reached the goal."""
    results = json.loads((path / "evaluation.json").read_text())
    table = path / "trials.csv"
    try:
        steps, success = read_column(table, "steps"), read_column(table, "success")
        rules, total = int(read_column(table, "rules")[-1]), int(steps.sum())
        taken = {name: read_column(table, column) for name, column in TAKEN.items()}
    except (ValueError, OSError):  # diverged in its first trial
        steps, success, rules, total = np.zeros(0), np.zeros(0), 0, 0
        taken = dict.fromkeys(TAKEN, steps)
    learned = trials_to_learn(steps, success, optimum)
    row = {
        "status": "diverged" if "diverged" in results else "done",
        "trials": config.trials,
        "trials_to_learn": learned,
    }
    for name, counts in taken.items():
        never = math.isnan(learned)
        row[f"{name}_to_learn"] = learned if never else int(counts[: int(learned)].sum())
    for policy in POLICIES:
        failure = [{"steps": config.maze.max_steps, "success": False, "collisions": math.nan}]
        records = results.get(policy, failure)
        for quantity in ("success", "steps", "collisions"):
            values = [record[quantity] for record in records]
            row[f"{policy}_{quantity}"] = round(float(np.mean(values)), 4)
        if policy == "greedy":
            row["trials_freed"] = sum(bool(record.get("freed")) for record in records)
    wall = cpu = 0.0
    if (path / "seconds.csv").exists():  # a sitting that was killed leaves no line
        wall, cpu = np.loadtxt(path / "seconds.csv", delimiter=",", ndmin=2).sum(0).round(1)
    row |= {"rules": rules, "total_steps": total}
    return row | {"wall_seconds": float(wall), "cpu_seconds": float(cpu)}


def trials_to_learn(steps: Any, success: Any, optimum: float) -> float:
    """The trial that completes the first ten in a row under 1.5 times the optimum, or NaN."""
    row = 0
    for trial, (n, arrived) in enumerate(zip(steps, success, strict=True), 1):
        row = row + 1 if arrived and n < WITHIN * optimum else 0
        if row == IN_A_ROW:
            return trial
    return math.nan


def _curves(path: Path) -> Iterable[dict[str, Any]]:
    for quantity in ("steps", "rules"):
        with contextlib.suppress(ValueError, OSError):
            values = read_column(path / "trials.csv", quantity)
            yield {"quantity": quantity, "values": " ".join(f"{value:.0f}" for value in values)}


def _path(path: Path) -> Iterable[dict[str, Any]]:
    last = json.loads((path / "evaluation.json").read_text()).get("last_trial")
    names = ("x", "y", "heading", "x_estimated", "y_estimated", "heading_estimated")
    for decision, poses in enumerate(
        zip(last["true"], last["estimated"], strict=True) if last else ()
    ):
        yield {"decision": decision} | dict(zip(names, itertools.chain(*poses), strict=True))


def _distinct(values: Iterable[Any]) -> list[Any]:
    return list({json.dumps(value, sort_keys=True): value for value in values}.values())
