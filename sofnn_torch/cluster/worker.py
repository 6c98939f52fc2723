"""What a worker of a Dask cluster does with a job: a process for it, and the run it leaves.

A worker that sees the client's disk works in place. Any other works on a copy for two minutes or
so, the slice of a run that is lost if the worker is killed, and sends back what has changed.
"""

import contextlib
import dataclasses
import signal
import tempfile
from dataclasses import dataclass
from pathlib import Path

from distributed import Status, get_worker

from sofnn_torch.runs.jobs import Job, attend

PATIENCE = 120.0  # seconds for the process of a worker that is gone to save, and to leave a run
Files = dict[str, bytes]  # by their paths in the directory of the run
stopped: dict[str, int] = {}  # by session of a client: the signal that ended it


@dataclass(frozen=True)
class Order:
    """A job on its way to a worker."""

    key: str
    """Of the task; no other has it."""
    session: str
    """Of the client."""
    job: Job
    """Its path is that on the client's disk."""
    files: Files
    """What is in the directory of the run, but for its curves."""
    probe: tuple[str, str]
    """Path and content of a file on the client's disk."""
    folder: str
    """Where the client works."""
    seconds: float
    """Length of a slice, on a copy."""


@dataclass(frozen=True)
class Outcome:
    """What came of an order."""

    code: int
    """Exit code of the process."""
    message: str
    """Its last words."""
    files: Files | None
    """What has changed in the directory of the run; None where the worker worked in place."""


def stop(session: str, number: int) -> None:
    """Let the jobs of a client get a signal, those that are under way and those to come."""
    stopped[session] = number


def do(order: Order) -> Outcome:
    """Do the order, or a slice of it."""
    here = get_worker()

    def told() -> int:
        if number := stopped.get(order.session):
            return number
        task = here.state.tasks.get(order.key)  # the client is gone, or gave it to another worker
        wanted = here.status == Status.running and task and task.state == "executing"
        return 0 if wanted else signal.SIGTERM

    if number := told():
        return Outcome(128 + number, "not started", {})
    if _same_disk(*order.probe):
        folder = Path(order.folder) if Path(order.folder).is_dir() else None
        return Outcome(*attend(order.job, told, patience=PATIENCE, folder=folder), None)
    with tempfile.TemporaryDirectory(prefix="run-", dir=here.local_directory) as scratch:
        path = Path(scratch) / order.job.path.name
        if order.files:
            unpack(order.files, path)
        copy = dataclasses.replace(order.job, path=path)
        code, message = attend(copy, told, seconds=order.seconds)
        files = pack(path)
    message = message.replace(f"{scratch}/", "")  # of the worker's disk; it is gone
    changed = {name: data for name, data in files.items() if order.files.get(name) != data}
    return Outcome(code, message, changed)


def pack(path: Path, curves: bool = True) -> Files:
    """The files of a run.

    Args:
        path: of its directory, which may be missing.
        curves: TensorBoard's too, which going on does not need.
    """
    names = sorted(p for p in path.rglob("*") if p.is_file() and p.name != "run.lock")
    kept = [p for p in names if curves or not p.name.startswith("events.")]
    packed = {}
    for file in kept:
        with contextlib.suppress(FileNotFoundError):  # a temporary file of one who writes
            packed[str(file.relative_to(path))] = file.read_bytes()
    return packed


def unpack(files: Files, path: Path) -> None:
    """Write the files of a run."""
    for name, data in files.items():
        file = path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)


def _same_disk(path: str, content: str) -> bool:
    with contextlib.suppress(OSError):
        return Path(path).read_text() == content
    return False
