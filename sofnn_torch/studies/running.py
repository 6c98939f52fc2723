"""Runs of the studies: found again by their settings, each done in a process of its own."""

import contextlib
import dataclasses
import itertools
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sofnn_torch import evaluate, training
from sofnn_torch.pictures.figures import read_column
from sofnn_torch.progress import Progress, say
from sofnn_torch.runs import checkpoint, directory, jobs, session
from sofnn_torch.runs.guard import Divergence
from sofnn_torch.runs.parallel import together
from sofnn_torch.runs.provenance import code, versions
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.runs.signals import Interrupted, SignalTrap
from sofnn_torch.runs.trial import Trajectory, TrialRecord
from sofnn_torch.studies.robustness import under_conditions
from sofnn_torch.studies.studies import STUDIES, essence, settings

POLICIES = ("greedy", "plain", "sampled")
EPISODES = 20  # evaluation trials of a run, for each policy
PLAYED = "played-with.json"  # versions of the software, and the processor
WORK = "sofnn_torch.studies.running:work"


@dataclass(frozen=True)
class Job:
    """One run: its directory, its settings, and whether it is also played in other conditions."""

    path: Path
    config: Config
    conditions: bool

    def done(self) -> bool:
        """All its files are there."""
        others = not self.conditions or (self.path / "conditions.json").exists()
        return _is_evaluated(self.path) and others


def find_runs(parent: Path, any_code: bool = False) -> tuple[dict[Config, Path], set[Config]]:
    """The runs in a directory by what determines them; of equal ones the finished.

    Args:
        parent: the directory.
        any_code: take also runs of code that learns or plays in another way.

    Returns:
        the runs, and what determines those that are there of other code alone.
    """
    found: dict[Config, Path] = {}
    others = set()
    for file in sorted(parent.glob("*/config.json")):
        with contextlib.suppress(ValueError):  # written by a version with other settings
            key = essence(directory.load_config(file.parent))
            if not any_code and {part.get("code") for part in sittings(file.parent)} != {code()}:
                others.add(key)
                continue
            if key not in found or not (found[key] / "evaluation.json").exists():
                found[key] = file.parent
    return found, others - found.keys()


def sittings(run: Path) -> list[dict[str, Any]]:
    """Versions, commit and code of all sittings of a run; without what was not kept."""
    last = json.loads((run / "config.json").read_bytes())
    return [last, *last.get("earlier", [])]


def plan(
    parent: Path,
    studies: Sequence[str],
    only: str,
    numbers: Sequence[int],
    changes: Mapping[str, Any],
    any_code: bool = False,
) -> list[Job]:
    """The runs that studies need, each once.

    Args:
        parent: where runs are and will be.
        studies: names of the studies.
        only: text that is in the name of every arm to run.
        numbers: seeds.
        changes: settings that are changed in every arm.
        any_code: take also runs of code that learns or plays in another way.
    """
    existing, others = find_runs(parent, any_code)
    if others:
        many = f"{len(others)} runs below {parent}"
        say(f"{many} are of other code and left alone; --any-code takes them")
    planned: dict[Config, Job] = {}
    for name in studies:
        study, taken = STUDIES[name], {job.path for job in planned.values()}
        for seed, (arm, entries) in itertools.product(numbers, study.arms.items()):
            if only not in arm:
                continue
            config = settings({**entries, **changes}, seed)
            key = essence(config)
            if key in planned:
                conditions = planned[key].conditions or study.conditions
                planned[key] = dataclasses.replace(planned[key], conditions=conditions)
                continue
            path = existing.get(key) or _free(parent / f"{name}-{arm}-s{seed}", taken)
            taken.add(path)
            planned[key] = Job(path, config, study.conditions)
    return list(planned.values())


def _free(path: Path, taken: set[Path]) -> Path:
    """The path, or with -2, -3 ... appended if a run of other settings is there."""
    numbered = (path.with_name(f"{path.name}-{count}") for count in itertools.count(2))
    return next(p for p in itertools.chain([path], numbered) if not p.exists() and p not in taken)


def execute(planned: Sequence[Job], workers: int, cluster: str | None = None) -> int:
    """Do the jobs, each in a process of its own; how many failed.

    Raises:
        ValueError: the cluster cannot be used.
        Interrupted: after every run was saved.
    """
    todo = [job for job in planned if not job.done()]
    say(f"{len(planned)} runs, {len(planned) - len(todo)} of them finished")
    failed = 0
    total = sum(job.config.trials for job in todo)
    with SignalTrap() as trap, Progress("trials", total, quiet=not todo) as bar:
        for job, failure, message in together(map(_process, todo), workers, bar, trap, cluster):
            if not failure:
                bar.update(0, facts=[f"{job.path.name} is done"])
            elif not trap.number:
                failed += 1
                say(f"failed: {job.path}, {message}")
    if trap.number:
        raise Interrupted(trap.number)
    return failed


def _process(job: Job) -> jobs.Job:
    arguments = {"config": dataclasses.asdict(job.config), "conditions": job.conditions}
    return jobs.Job(job.path.name, job.path, WORK, arguments)


# ------------------------------------------------------------------------------- a single run


def _is_evaluated(path: Path) -> bool:
    """It was played, by all policies and for as many trials as today."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads((path / "evaluation.json").read_bytes())
        return "diverged" in found or (found.get("episodes") == EPISODES and "plain" in found)
    return False


@arithmetic()
def work(path: Path, arguments: dict[str, Any], after: training.After | None = None) -> int:
    """Train, evaluate and play in other conditions what is not done yet; the exit code."""
    config, conditions = from_dict(arguments["config"]), arguments["conditions"]
    wall, cpu, failure = time.perf_counter(), time.process_time(), 0
    done = Job(path, config, conditions).done()
    try:
        if not _is_evaluated(path):
            _write(path / "evaluation.json", _train_and_evaluate(path, config, after))
        if conditions and not (path / "conditions.json").exists():
            diverged = "diverged" in json.loads((path / "evaluation.json").read_bytes())
            _write(path / "conditions.json", [] if diverged else under_conditions(path))
        if not done:
            _note_versions(path / PLAYED)
    except (ValueError, OSError, ArithmeticError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        failure = 2
    except (Interrupted, KeyboardInterrupt) as stop:
        failure = 128 + getattr(stop, "number", 2)
    if path.is_dir():
        spent = [time.perf_counter() - wall, time.process_time() - cpu]
        with open(path / "seconds.csv", "a") as file:  # a line for each sitting
            file.write(f"{spent[0]:.1f},{spent[1]:.1f}\n")
    return failure


def _train_and_evaluate(
    path: Path, config: Config, after: training.After | None = None
) -> dict[str, Any]:
    options = training.RunOptions.silent(path)
    try:
        if (path / "config.json").exists():
            training.resume(path, options, after=after)
        else:
            training.train(config, options, after)
    except Divergence as error:  # a result too
        return {"diverged": str(error)}
    config, agent, _, _ = evaluate.load(path)
    results: dict[str, Any] = {"episodes": EPISODES, "seed": 1000 + config.seed}
    for policy in POLICIES:
        explore, plain = policy == "sampled", policy == "plain"
        records = evaluate.evaluate(config, agent, EPISODES, explore, results["seed"], plain=plain)
        results[policy] = [record.row() for record in records]
    if read_column(path / "trials.csv", "success")[-1]:
        record, trajectory = last_trial(path)
        results["last_trial"] = {
            "steps": record.steps,
            "true": trajectory.true.round(5).tolist(),
            "estimated": trajectory.estimated.round(5).tolist(),
        }
    return results


def last_trial(path: Path) -> tuple[TrialRecord, Trajectory]:
    """The last trial of a finished run, played once more from the last checkpoint before it.

    Raises:
        CheckpointError: the checkpoint cannot be used.
    """
    file = checkpoint.checkpoints(path)[1]
    config, state = directory.load_config(path), checkpoint.load(file)
    agent, env = session.build(config)
    checkpoint.restore(file, state, agent, env)
    for _ in range(state["trial"], config.trials):
        record, trajectory = training.play(env, agent)
    env.close()
    return record, trajectory


def _note_versions(file: Path) -> None:
    """With what policies were played: it may be another machine than the one that trained."""
    known = json.loads(file.read_bytes()) if file.exists() else []
    if (here := versions()) not in known:
        _write(file, [*known, here])


def _write(path: Path, data: Any) -> None:
    checkpoint.write_atomically(path, json.dumps(data).encode())
