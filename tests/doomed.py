"""Training processes that die at a chosen moment, forked from one that has loaded everything."""

import contextlib
import json
import multiprocessing
import os
import signal
import sys
from pathlib import Path

from sofnn_torch import training
from sofnn_torch.maze.env import KheperaMazeEnv
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.signals import Interrupted
from sofnn_torch.training import RunOptions

FILE_EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir"}
MOMENTS = ("decision", "file", "fsync", "half written")


def start(
    config: Config,
    options: RunOptions,
    run: Path,
    moment: tuple[str, int] = ("", 0),
    number: int = signal.SIGKILL,
) -> multiprocessing.Process:
    """Start a process that trains, or resumes the run if it exists.

    Args:
        config: settings of a new run.
        options: how the run is kept.
        run: where the run is.
        moment: kind and count; at the count-th of its kind the process gets the signal.
        number: the signal.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sofnn_torch.training"])
    child = context.Process(target=_live, args=(config, options, run, moment, number))
    child.start()
    return child


def finish(child: multiprocessing.Process) -> int:
    """Wait for a process; its exit code, negative for a signal."""
    child.join(600)
    assert child.exitcode is not None, "the process hangs"
    return child.exitcode


def count_moments(config: Config, options: RunOptions, run: Path) -> dict[str, int]:
    """Train without harm; how many moments of each kind there were."""
    assert finish(start(config, options, run, ("count", 0))) == 0
    counts = json.loads((run.parent / f"{run.name}.json").read_text())
    return {kind: counts[kind] for kind in MOMENTS}


def _live(config, options, run, moment, number) -> None:
    counts = dict.fromkeys(MOMENTS, 0)

    def pass_by(kind: str) -> bool:
        counts[kind] += 1
        return moment == (kind, counts[kind])

    def audit(event: str, arguments: tuple) -> None:
        here = event in FILE_EVENTS and str(arguments[0]).startswith(str(run.parent))
        if here and pass_by("file"):
            os.kill(os.getpid(), number)

    def fsync(descriptor: int) -> None:
        if pass_by("half written"):
            with contextlib.suppress(OSError):  # of a file that is only read, or a directory
                os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        if pass_by("fsync"):
            os.kill(os.getpid(), number)
        real_fsync(descriptor)

    def step(env: KheperaMazeEnv, action):
        if pass_by("decision"):
            os.kill(os.getpid(), number)
        return real_step(env, action)

    real_fsync, real_step = os.fsync, KheperaMazeEnv.step
    os.fsync, KheperaMazeEnv.step = fsync, step
    sys.addaudithook(audit)
    try:
        if run.exists():
            training.resume(run, options)
        else:
            training.train(config, options)
    except Interrupted as stop:
        sys.exit(128 + stop.number)
    if moment[0] == "count":
        (run.parent / f"{run.name}.json").write_text(json.dumps(counts))
