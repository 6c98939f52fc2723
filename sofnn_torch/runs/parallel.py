"""Several seeds in one call: one process and one run directory for each.

joblib hands out the jobs on this machine, a Dask cluster on others (`sofnn_torch.cluster`).
"""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from sofnn_torch import training
from sofnn_torch.numerals import whole
from sofnn_torch.progress import Progress, say
from sofnn_torch.runs import places
from sofnn_torch.runs.jobs import Job, attend
from sofnn_torch.runs.session import RunOptions
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.runs.signals import Interrupted, SignalTrap
from sofnn_torch.terminal import program, quoted

WORK = "sofnn_torch.runs.parallel:work"
MOST = 100_000  # seeds in one call
SLURM = "slurm"
NEED = "--cluster needs Dask: pip install 'sofnn-torch[cluster]'"
Done = tuple[Job, int, str]  # a job, the exit code of its process, and its last words


def train(
    config: Config, options: RunOptions, listed: str, workers: int, cluster: str | None = None
) -> int:
    """Train the seeds, `workers` at a time, under one progress bar; the exit code.

    Raises:
        ValueError: the list of seeds cannot be read, or the cluster cannot be used.
        Interrupted: after every run was saved.
    """
    configs = [dataclasses.replace(config, seed=number) for number in parse(listed)]
    places.directory(options.runs, "--runs")
    how = {key: value for key, value in vars(options).items() if key not in ("runs", "name")}

    def jobs() -> Iterator[Job]:
        for each in configs:  # a name is taken when the turn of its seed has come
            name = options.name and f"{options.name}-s{each.seed}"
            path = places.reserve(options.runs / (name or places.default_name(each)))
            arguments = {"config": dataclasses.asdict(each), "options": how | {"quiet": True}}
            yield Job(f"seed {each.seed}", path, WORK, arguments)

    failed, many = 0, f"{len(configs)} seeds"
    bar = Progress(many, config.trials * len(configs), quiet=options.quiet)
    with SignalTrap() as trap, bar:
        for job, code, message in together(jobs(), workers, bar, trap, cluster):
            path = job.path
            failed += code != 0
            with contextlib.suppress(OSError):
                path.rmdir()  # only of a run that never began is it empty
            if code == 0:
                bar.print(f"{path}: done")
            elif trap.number and code in (128 + trap.number, -trap.number) and path.exists():
                go_on = f"{program()} --resume {quoted(path)}"
                say(f"{job.name}: stopped and saved; go on with: {go_on}")
            else:
                say(f"{job.name}: {message}, {path}")
    if trap.number:
        raise Interrupted(trap.number)
    if failed:
        say(f"{failed} of {many} failed")
    return 1 if failed else 0


def together(
    jobs: Iterable[Job], workers: int, bar: Progress, trap: SignalTrap, cluster: str | None = None
) -> Iterator[Done]:
    """Do the jobs at the same time; each when it is done.

    Args:
        jobs: asked for one at a time, when their turn comes.
        workers: jobs at the same time, on this machine or in Slurm.
        bar: is moved on by every trial.
        trap: a signal in it stops all jobs, after saving.
        cluster: None for this machine; else `slurm` or the address of a Dask scheduler.

    Raises:
        ValueError: the cluster cannot be used.
    """
    if cluster is not None:
        if cluster != SLURM and not re.fullmatch(r"[a-z]+://\S+", cluster):
            raise ValueError(
                "--cluster must be slurm or the address of a Dask scheduler, as in "
                f"tcp://host:8786, got {cluster!r}"
            )
        try:
            from sofnn_torch.cluster.client import hand_out
        except ModuleNotFoundError:
            raise ValueError(NEED) from None
        return hand_out(jobs, cluster, workers, bar, trap)
    parallel = Parallel(n_jobs=workers, backend="threading", return_as="generator_unordered")
    return parallel(delayed(watch)(job, bar, trap) for job in jobs)


def watch(job: Job, bar: Progress, trap: SignalTrap) -> Done:
    """Do a job to its end."""
    if trap.number:
        return job, 128 + trap.number, "not started"
    shown = 0  # what a run had before counts too, once it is gone on with

    def look() -> None:
        nonlocal shown
        done = job.trials()
        bar.update(done - shown)
        shown = done

    return job, *attend(job, lambda: trap.number, look)


def work(path: Path, arguments: dict[str, Any], after: Callable[[Any], bool]) -> int:
    """Train one run, from its beginning or from where it is; the exit code.

    Raises:
        ValueError, Interrupted, Divergence, OSError: as `training.train`.
    """
    options = RunOptions(**arguments["options"], runs=path.parent, name=path.name)
    if (path / "config.json").exists():
        training.resume(path, options, after=after)
    else:
        training.train(from_dict(arguments["config"]), options, after)
    return 0


def parse(listed: str) -> list[int]:
    """The seeds in a list such as ``0-3,7``.

    Raises:
        ValueError: it is no such list.
    """
    numbers: list[int] = []
    with contextlib.suppress(ValueError):
        for part in listed.split(","):
            low, dash, high = part.partition("-")
            several = range(whole(low), whole(high if dash else low) + 1)[:MOST]
            if not several:
                raise ValueError
            numbers += several
        if numbers and len(set(numbers)) == len(numbers) < MOST:
            return numbers
    raise ValueError(f"--seeds must be a list such as 0-7 or 0,3,5, got {listed!r}")
