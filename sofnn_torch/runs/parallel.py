"""Several seeds in one call: one process and one run directory for each.

joblib hands out the seeds; each is trained by a process of its own, so that one which crashes or
is killed takes no other with it.
"""

import contextlib
import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from sofnn_torch.numerals import whole
from sofnn_torch.progress import Progress, say
from sofnn_torch.runs import places
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.signals import Interrupted, SignalTrap
from sofnn_torch.terminal import program, quoted
from sofnn_torch.training import RunOptions

OWN = {"--seeds", "--workers", "--name", "--seed"}  # flags that the single runs do not inherit
MOST = 10_000  # seeds in one call
HOME = str(Path(__file__).parents[2])  # the children must find this package, installed or not
PATHS = [HOME, *filter(None, [os.environ.get("PYTHONPATH")])]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(PATHS)}


def train(
    config: Config, options: RunOptions, listed: str, workers: int, argv: Sequence[str]
) -> int:
    """Train the seeds, `workers` at a time, under one progress bar; the exit code.

    Raises:
        ValueError: the list of seeds cannot be read.
        Interrupted: after every run was saved.
    """
    configs = [dataclasses.replace(config, seed=number) for number in parse(listed)]
    common = [sys.executable, "-m", "sofnn_torch.cli", *_without(argv, OWN), "--quiet"]

    def jobs() -> Iterator[Any]:
        for each in configs:  # a name is taken when the turn of its seed has come
            number, name = each.seed, options.name and f"{options.name}-s{each.seed}"
            path = places.reserve(options.runs / (name or places.default_name(each)))
            command = [*common, "--seed", str(number), "--name", path.name]
            yield delayed(watch)(number, path, command, bar, trap)

    failed, many = 0, f"{len(configs)} seeds"
    bar = Progress(many, config.trials * len(configs), quiet=options.quiet)
    with SignalTrap() as trap, bar:
        parallel = Parallel(n_jobs=workers, backend="threading", return_as="generator_unordered")
        for number, path, code, message in parallel(jobs()):
            failed += code != 0
            with contextlib.suppress(OSError):
                path.rmdir()  # only of a run that never began is it empty
            if code == 0:
                bar.print(f"{path}: done")
            elif trap.number and code == 128 + trap.number and path.exists():
                go_on = f"{program()} --resume {quoted(path)}"
                say(f"seed {number}: stopped and saved; go on with: {go_on}")
            else:
                say(f"seed {number}: {message}, {path}")
    if trap.number:
        raise Interrupted(trap.number)
    if failed:
        say(f"{failed} of {many} failed")
    return 1 if failed else 0


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


def watch(
    number: int, path: Path, command: list[str], bar: Progress, trap: SignalTrap
) -> tuple[int, Path, int, str]:
    """Run the command of a training to its end; its number, directory, exit code and message."""
    if trap.number:
        return number, path, 128 + trap.number, "not started"
    child = subprocess.Popen(
        command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    shown, told = 0, False
    while True:
        try:
            _, errors = child.communicate(timeout=0.5)
        except subprocess.TimeoutExpired:
            errors = None
        done = _trials(path)
        bar.update(done - shown)
        shown = done
        if errors is not None:
            lines = errors.strip().splitlines()
            message = lines[-1] if lines and child.returncode >= 0 else "killed"
            return number, path, child.returncode, f"exit code {child.returncode} ({message})"
        if trap.number and not told:  # once: a second one could hit a child that has just saved
            child.send_signal(trap.number)
            told = True


def _trials(path: Path) -> int:
    with contextlib.suppress(OSError):
        return max(0, (path / "trials.csv").read_bytes().count(b"\n") - 1)
    return 0


def _without(argv: Sequence[str], flags: set[str]) -> list[str]:
    """The arguments without some flags and their values."""
    kept, skip = [], False
    for word in argv:
        if skip:
            skip = False
        elif word in flags:
            skip = True
        elif word.partition("=")[0] not in flags:
            kept.append(word)
    return kept
