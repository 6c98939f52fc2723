"""A Dask cluster that jobs can be handed to, and a connection that comes back when it was lost."""

import contextlib
import logging
import math
import shutil
import subprocess
import time
import warnings
from typing import Any, Self

import dask
from distributed import Client

from sofnn_torch.progress import say
from sofnn_torch.runs.parallel import NEED, SLURM
from sofnn_torch.runs.signals import SignalTrap
from sofnn_torch.terminal import plural

FIRST = 10.0  # seconds for the first connection
PATIENCE = 3600.0  # seconds without a connection before the client gives up
LONELY = 30.0  # seconds without a worker, after which that is told
EVERY = 5.0  # seconds between two looks at how many workers there are
RENEW = 30.0  # seconds between two looks at whether Slurm still runs them
LOGGERS = ("distributed", "distributed.client", "tornado", "tornado.application")
FAILURES = (OSError, TimeoutError, ValueError, RuntimeError)  # of a call without a connection


class Connection:
    """The client's side of a cluster.

    Args:
        where: `slurm`, or the address of a scheduler.
        workers: jobs at the same time, in Slurm.
        trap: a signal in it ends all waiting.

    Raises:
        ValueError: on entering: there is no such cluster.
    """

    def __init__(self, where: str, workers: int, trap: SignalTrap):
        self.where, self.workers, self.trap = where, workers, trap
        self.threads = 0  # jobs that the cluster can do at the same time
        self._looked = self._renewed = 0.0
        self._begin, self._told = time.monotonic(), False
        self._cluster: Any = None
        self._client: Client | None = None

    def __enter__(self) -> Self:
        for name in LOGGERS:  # what matters is said here, in one line
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            if self.where == SLURM:
                self._cluster = _slurm()
            self._client = self._connect(FIRST)
        except FAILURES as error:
            self.__exit__()
            raise ValueError(
                f"--cluster {self.where} cannot be used: {' '.join(str(error).split())[:300]}"
            ) from None
        return self

    def __exit__(self, *_: object) -> None:
        for each in (self._client, self._cluster):
            if each is not None:
                with contextlib.suppress(Exception):  # what is gone needs no farewell
                    each.close()

    def client(self) -> Client | None:
        """The client, connected (again); None if that failed, or because of a signal."""
        client = self._client
        if client is not None and client.status == "running":
            return client
        say(f"the connection to {self.where} is lost: trying to get it back")
        deadline, self._looked = time.monotonic() + PATIENCE, 0.0
        while time.monotonic() < deadline and not self.trap.number:
            if client is not None and client.status == "running":
                say(f"connected to {self.where} again")
                self._client = client
                return client
            if client is None or client.status == "closed":  # Dask's own patience is over
                with contextlib.suppress(*FAILURES):
                    client = self._connect(FIRST)
                    continue
            time.sleep(0.5)
        return None

    def look(self) -> int:
        """How many jobs the cluster can do at the same time; asked for now and then."""
        now = time.monotonic()
        if self._client is not None and now - self._looked > EVERY:
            self._looked = now
            with contextlib.suppress(*FAILURES):
                self.threads = sum(self._client.nthreads().values())
            if not self.threads and not self._told and now - self._begin > LONELY:
                self._told = True
                say(f"{self.where} has no workers yet")
        if self._cluster is not None and now - self._renewed > RENEW:
            self._renewed = now
            cores = int(dask.config.get("jobqueue.slurm.cores"))  # that one job has
            self._cluster.scale(jobs=math.ceil(self.workers / cores))  # also whose time was up
        return max(self.threads, self.workers if self._cluster else 1)

    def _connect(self, seconds: float) -> Client:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a table of versions, of which most do not matter
            client = Client(self._cluster or self.where, timeout=seconds, set_as_default=False)
            versions: Any = client.get_versions()
        ours = versions["client"]["host"]["python"].split(".")[:2]
        others = [
            worker["host"]["python"]
            for worker in versions["workers"].values()
            if worker["host"]["python"].split(".")[:2] != ours
        ]
        if others:
            client.close()
            raise ValueError(
                f"{plural(len(others), 'worker')} with Python {others[0]}, here {'.'.join(ours)}"
            )
        return client


def _slurm() -> Any:
    """A scheduler in this process, whose workers Slurm starts, as Dask's settings say.

    Raises:
        ValueError: there is no Slurm, or it does not take a job of these settings.
    """
    try:
        from dask_jobqueue import SLURMCluster
    except ModuleNotFoundError:
        raise ValueError(NEED) from None
    if shutil.which("sbatch") is None:
        raise ValueError("sbatch is not found")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the port of a dashboard, where there is another
        cluster = SLURMCluster()
    done = subprocess.run(
        ["sbatch", "--test-only"], input=cluster.job_script(), capture_output=True, text=True
    )
    if done.returncode:
        cluster.close()
        raise ValueError(done.stderr.strip() or "sbatch refuses the job")
    return cluster
