"""Jobs handed to a Dask cluster: none is lost, whatever happens to workers, scheduler and network.

The client holds the truth, which is the directory of each run. A task that is lost is handed out
again, and goes on from the last checkpoint that is in the directory (docs/scale.md).
"""

import contextlib
import dataclasses
import os
import secrets
import signal
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from distributed import Client, Future, KilledWorker

from sofnn_torch.cluster import worker
from sofnn_torch.cluster.connection import FAILURES, Connection
from sofnn_torch.cluster.worker import Order, Outcome
from sofnn_torch.progress import Progress, say
from sofnn_torch.runs import checkpoint, places
from sofnn_torch.runs.jobs import PAUSED, Job
from sofnn_torch.runs.parallel import Done
from sofnn_torch.runs.session import RunOptions
from sofnn_torch.runs.signals import NUMBERS, SignalTrap
from sofnn_torch.terminal import plural

SLICE = 120.0  # seconds of a run on a worker that does not see the client's disk
EVERY = 0.2  # seconds between two looks at the tasks,
TABLES = 2.0  # and at the tables of the runs,
FASTEST = 100  # of which so many are read in a second at most
AHEAD = 2  # tasks for each thread of the workers: the next one is there when one ends
LOSSES = 10  # of one job in a row, without a trial in between, after which it is given up
FAREWELL = 120.0  # seconds for all jobs to save
# Not the run's own doing, but that of someone who ends a worker and all that it has started.
STOPPED = {-signal.SIGKILL, *(-n for n in NUMBERS), *(128 + n for n in NUMBERS)}


@dataclass
class Task:
    """A job that is handed out."""

    job: Job
    future: Future | None = None
    shown: int = 0
    """Trials in the progress."""
    losses: int = 0
    lost_at: int = -1
    """Trials that there were when it was lost."""


def hand_out(
    jobs: Iterable[Job], where: str, workers: int, bar: Progress, trap: SignalTrap
) -> Iterator[Done]:
    """Do the jobs on a cluster; each when it is done.

    Args:
        jobs: asked for one at a time, when their turn comes.
        where: `slurm`, or the address of a scheduler.
        workers: jobs at the same time, in Slurm.
        bar: is moved on by every trial.
        trap: a signal in it stops all jobs, after saving.

    Raises:
        ValueError: the cluster cannot be used.
    """
    with Connection(where, workers, trap) as connection, contextlib.ExitStack() as stack:
        handler = _Handler(connection, bar, trap, stack)
        yield from handler.work(iter(jobs))


class _Handler:
    """The tasks of one call."""

    def __init__(
        self,
        connection: Connection,
        bar: Progress,
        trap: SignalTrap,
        stack: contextlib.ExitStack,
    ):
        self.connection, self.bar, self.trap, self.stack = connection, bar, trap, stack
        self.session, self.count = secrets.token_hex(8), 0
        self.probes: dict[Path, tuple[str, str]] = {}
        self.tasks: list[Task] = []

    def work(self, jobs: Iterator[Job]) -> Iterator[Done]:
        """All jobs to their end."""
        looked, deadline, more = 0.0, 0.0, True
        while more or self.tasks:
            room = AHEAD * self.connection.look() - len(self.tasks)
            while more and room > 0 and not self.trap.number:
                job = next(jobs, None)
                more, room = job is not None, room - 1
                if job:
                    self.tasks.append(Task(job))
            if (client := self.connection.client()) is None:
                yield from self._give_up()
                return
            if self.trap.number:
                more, deadline = False, deadline or time.monotonic() + FAREWELL
                if time.monotonic() > deadline or not self._tell(client):
                    yield from self._give_up()
                    return
            for task in list(self.tasks):
                if (done := self._step(task, client)) is not None:
                    self.tasks.remove(task)
                    self._show(task)
                    yield done
            if time.monotonic() - looked > max(TABLES, len(self.tasks) / FASTEST):
                looked = time.monotonic()
                for task in self.tasks:
                    self._show(task)
                self.bar.update(0, facts=[plural(self.connection.threads, "worker")])
            time.sleep(EVERY)

    def _tell(self, client: Client) -> bool:
        """Let every worker know of the signal; False if there is none."""
        with contextlib.suppress(*FAILURES):
            client.run(worker.stop, self.session, self.trap.number, on_error="ignore")
            return bool(client.nthreads())
        return True  # of the connection nothing is known now

    def _step(self, task: Task, client: Client) -> Done | None:
        """Hand a task out, again if need be; what became of its job once that is over."""
        try:
            outcome = self._outcome(task, client)
        except FAILURES:  # the connection is just being lost
            return None
        if isinstance(outcome, str):
            return self._lost(task, outcome)
        if outcome is None:
            return None
        task.future = None  # lets go of the files
        try:
            put_in_place(outcome.files or {}, task.job)
        except OSError as error:
            return task.job, 1, f"cannot be put in place ({error.strerror})"
        if outcome.code == PAUSED:
            task.losses = 0
            return None
        if outcome.code in STOPPED and not self.trap.number:
            return self._lost(task, outcome.message)
        return task.job, outcome.code, outcome.message

    def _outcome(self, task: Task, client: Client) -> Outcome | str | None:
        """What came of a task, or how it was lost; None as long as it is under way."""
        future = task.future
        if future is None or future.client is not client:
            task.future = self._submit(task.job, client)
            return None
        if future.status == "pending":
            return None
        if future.status == "error":
            error = future.exception(timeout=60)
            if isinstance(error, KilledWorker):
                return "its workers died"
            return Outcome(1, " ".join(f"{type(error).__name__}: {error}".split())[:300], None)
        if future.status != "finished":  # lost with the scheduler or the connection
            return "the connection was lost"
        return future.result(timeout=60)

    def _lost(self, task: Task, why: str) -> Done | None:
        """Hand the job out again, unless it gets nowhere."""
        trials, task.future = task.job.trials(), None
        task.losses = 1 if trials > task.lost_at else task.losses + 1
        task.lost_at = trials
        if task.losses < LOSSES:
            return None
        return task.job, 1, f"given up after {LOSSES} losses in a row without a trial ({why})"

    def _submit(self, job: Job, client: Client) -> Future:
        self.count += 1
        key = f"sofnn-{self.session}-{self.count}"  # Dask keeps an account of every first word
        path = job.path.absolute()
        order = Order(
            key,
            self.session,
            dataclasses.replace(job, path=path),
            worker.pack(path, curves=False),
            self._probe(path.parent),
            os.getcwd(),
            SLICE,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an order with a large run is meant to be large
            return client.submit(worker.do, order, key=key, pure=False)

    def _probe(self, parent: Path) -> tuple[str, str]:
        """A file that a worker sees if it has the same disk."""
        if parent not in self.probes:
            content = secrets.token_hex(16)
            file = parent / f".shared-{content}"
            parent.mkdir(parents=True, exist_ok=True)
            file.write_text(content)
            self.stack.callback(file.unlink, missing_ok=True)
            self.probes[parent] = str(file), content
        return self.probes[parent]

    def _show(self, task: Task) -> None:
        trials = task.job.trials()
        self.bar.update(trials - task.shown)
        task.shown = trials

    def _give_up(self) -> Iterator[Done]:
        """What becomes of the jobs when the cluster does not answer any more."""
        code = 128 + self.trap.number if self.trap.number else 1
        for task in self.tasks:
            yield task.job, code, f"no answer from {self.connection.where}"
        if not self.trap.number:
            say(f"{self.connection.where} does not come back; what is saved can be gone on with")


def put_in_place(files: worker.Files, job: Job) -> None:
    """Write what has changed in a run: at no moment is there a state that cannot be gone on with.

    A new run appears whole. Later, tables come before the checkpoints that count on them, as when a
    run itself saves.

    Raises:
        OSError: the disk refuses it.
    """
    path = job.path
    if files and not (path / "config.json").exists():
        with places.alone(path.parent):
            hidden = path.with_name(f".{secrets.token_hex(8)}{places.UNNAMED}")
            worker.unpack(files, hidden)
            hidden.rename(path)
        return
    checkpoints = {name for name in files if checkpoint.NAME.fullmatch(name)}
    for name in [*sorted(files.keys() - checkpoints), *sorted(checkpoints)]:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        checkpoint.write_atomically(path / name, files[name])
    if checkpoints:
        keep = job.arguments.get("options", {}).get("keep", RunOptions.keep)
        for old in checkpoint.checkpoints(path)[keep:]:
            old.unlink(missing_ok=True)
