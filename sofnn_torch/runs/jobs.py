"""Jobs: runs in processes of their own, so that one which crashes takes no other with it.

The process is told what to do by a line of JSON on its standard input, which stays open: when it
ends, whoever waited for the run is gone, and the process saves and stops. Nothing heavy is loaded
here before the process knows its work.
"""

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # Ctrl-C while libraries load: there is nothing to save yet
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import filelock

from sofnn_torch.runs.signals import NUMBERS, Interrupted

EVERY = 0.25  # seconds between two looks at a process
PAUSE = signal.SIGALRM  # "stops" a run whose time is up for now; no one else may send it
PAUSED = 128 + PAUSE  # exit code of such a run
HOME = str(Path(__file__).parents[2])  # the process must find this package, installed or not
PATHS = [HOME, *filter(None, [os.environ.get("PYTHONPATH")])]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(PATHS)}


@dataclass(frozen=True)
class Job:
    """One run and what is done with it.

    Examples:
        >>> Job("seed 3", Path("runs/s3"), "sofnn_torch.runs.parallel:work").path.name
        's3'
    """

    name: str
    """What messages call it."""
    path: Path
    """Directory of the run."""
    work: str
    """`module:function`, called with the path, the arguments and what `training.train` takes as
    `after`; it goes on with a run that is there, and returns an exit code."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Anything that JSON holds."""

    def trials(self) -> int:
        """Trials in the table of the run."""
        with contextlib.suppress(OSError):
            return max(0, (self.path / "trials.csv").read_bytes().count(b"\n") - 1)
        return 0


def attend(
    job: Job,
    stop: Callable[[], int],
    look: Callable[[], None] = lambda: None,
    seconds: float | None = None,
    patience: float = 0.0,
    folder: Path | None = None,
) -> tuple[int, str]:
    """Do a job in a process of its own; its exit code, negative for a signal, and its last words.

    Args:
        job: the job.
        stop: the signal that the process is to get, 0 as long as it is none.
        look: called now and then, and at the end.
        seconds: after which the run pauses at the end of a trial; None for never.
        patience: seconds to wait for another process that still holds the run.
        folder: where the process works; None for here.
    """
    order = {"work": job.work, "path": str(job.path), "arguments": job.arguments}
    line = json.dumps(order | {"seconds": seconds, "patience": patience})
    command = [sys.executable, "-m", "sofnn_torch.runs.jobs", str(job.path)]  # the path for `ps`
    told = False
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(
            command,
            env=ENVIRONMENT,
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
        ) as child,
    ):
        assert child.stdin
        with contextlib.suppress(BrokenPipeError):  # it is dead already
            child.stdin.write(f"{line}\n".encode())
            child.stdin.flush()
        while child.returncode is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(EVERY)
            look()
            if (number := stop()) and not told:  # once: a second one could hit what has just saved
                child.send_signal(number)
                told = True
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    last = lines[-1] if lines and child.returncode >= 0 else "killed"
    return child.returncode, f"exit code {child.returncode} ({last})"


def main() -> int:
    """The process of a job: do what the line on the standard input says; the exit code."""
    order = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_stop_when_alone, daemon=True).start()
    path = Path(order["path"])
    module, _, name = order["work"].partition(":")
    function = getattr(importlib.import_module(module), name)

    deadline = order["seconds"] and time.monotonic() + order["seconds"]  # of work, not of loading

    def after(_: Any) -> bool:
        if deadline and time.monotonic() > deadline:
            raise Interrupted(PAUSE)
        return False

    from sofnn_torch import terminal  # with the work: it loads much

    if order["patience"] and (path / "run.lock").exists():
        with (
            contextlib.suppress(filelock.Timeout),  # the work says what is wrong
            filelock.FileLock(path / "run.lock", timeout=order["patience"]),
        ):
            pass
    code = terminal.attempt(lambda: function(path, order["arguments"], after))
    for number in NUMBERS:  # what comes now comes too late to change what has happened
        signal.signal(number, signal.SIG_IGN)
    return code


def _stop_when_alone() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock would be held when Python ends
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
