"""What a cluster costs: throughput of n workers, time that a job takes beyond its work, memory.

    python benchmarks/cluster.py                     # sleeping jobs on 1 to 32 workers; 1,000 jobs
    python benchmarks/cluster.py --trainings         # equal trainings on one core and on two

A real Dask scheduler and real workers on this machine. Sleeping jobs stand for workers on other
machines: a process that sleeps in the place of one that trains, so that only the machinery is
measured. Memory is that of the client, the scheduler and the worker, sampled while short jobs pass.
"""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import tyro

from sofnn_torch.progress import Progress
from sofnn_torch.runs import parallel
from sofnn_torch.runs.jobs import Job
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.signals import SignalTrap

HOME = Path(__file__).parents[1]
# Loaded by the workers: a process that sleeps in the place of one that trains.
SLEEP = """
import subprocess
from sofnn_torch.cluster import worker
def attend(job, *_, **__):
    return subprocess.run(["sleep", job.arguments["seconds"]]).returncode, ""
worker.attend = attend
"""
NOTHING = "def work(path, arguments, after):\n    return 0\n"


@dataclass(frozen=True)
class Options:
    """What is measured."""

    workers: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """Numbers of workers for the sleeping jobs."""
    seconds: float = 10.0
    """Length of a sleeping job."""
    each: int = 4
    """Sleeping jobs for each worker."""
    many: int = 1000
    """Short jobs, while memory is sampled; 0 for none."""
    trainings: bool = False
    """Equal trainings on one core and on two instead, which means something on an idle machine."""
    trials: int = 20
    """Trials of each training."""
    out: Path | None = None
    """Where the numbers go, a .json file."""


@contextlib.contextmanager
def cluster(workers: int, folder: Path, *words: str) -> Iterator[tuple[str, list[psutil.Process]]]:
    """A scheduler and a process with so many threads; the address and the processes."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    environment = os.environ | {"PYTHONPATH": f"{HOME}:{folder}"}
    common = ["--scheduler-file", str(file), "--no-dashboard"]
    own = ["--nthreads", str(workers), "--no-nanny", "--local-directory", str(folder), *words]
    with open(folder / "dask.log", "a") as log, contextlib.ExitStack() as stack:
        processes = []
        for kind, flags in (("scheduler", ["--port", "0"]), ("worker", own)):
            command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *common, *flags]
            child = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            stack.callback(child.wait)
            stack.callback(child.kill)
            processes.append(psutil.Process(child.pid))
            while not file.exists():
                time.sleep(0.1)
        yield json.loads(file.read_text())["address"], [psutil.Process(), *processes]


def done(jobs: list[Job], workers: int, address: str | None) -> Iterator[Job]:
    """Do the jobs, here or on a cluster; each when it is done."""
    with SignalTrap() as trap:
        bar = Progress("jobs", 0, quiet=True)
        for job, code, message in parallel.together(jobs, workers, bar, trap, address):
            if code:
                raise RuntimeError(f"{job.name}: {message}")
            yield job


def passed(jobs: list[Job], address: str, processes: list[psutil.Process]) -> list[tuple]:
    """Do the jobs: for each when it was done [s], and the memory of the processes [MB]."""
    begin, samples = time.perf_counter(), []
    for _ in done(jobs, 1, address):
        memory = [process.memory_info().rss / 1e6 for process in processes]
        samples.append((time.perf_counter() - begin, *memory))
    return samples


def sleeping(options: Options, folder: Path) -> list[dict[str, float]]:
    """Efficiency of sleeping jobs: the time that was slept over that of all workers."""
    rows = []
    for workers in options.workers:
        count = workers * options.each
        arguments = {"seconds": str(options.seconds)}
        jobs = [Job(str(i), folder / f"s{workers}" / str(i), "", arguments) for i in range(count)]
        with cluster(workers, folder, "--preload", "asleep") as (address, processes):
            passed([Job("0", folder / "first" / "0", "", {"seconds": "0"})], address, processes)
            took = passed(jobs, address, processes)[-1][0]
        efficiency = options.each * options.seconds / took
        rows.append({"workers": workers, "seconds": took, "efficiency": efficiency})
        print(f"{workers:3d} workers: {took:6.1f} s, efficiency {efficiency:.2f}", flush=True)
    return rows


def overhead(folder: Path) -> dict[str, float]:
    """Seconds of a job that does nothing, through the cluster and as a process alone."""
    (folder / "nothing.py").write_text(NOTHING)
    os.environ["PYTHONPATH"] = f"{HOME}:{folder}"
    jobs = [Job(str(i), folder / "nothing" / str(i), "nothing:work") for i in range(12)]
    with cluster(1, folder) as (address, processes):
        times = [time for time, *_ in passed(jobs, address, processes)]
    through = (times[-1] - times[1]) / (len(times) - 2)  # the first is on its way when they begin
    begin = time.perf_counter()
    for _ in jobs:
        command = [sys.executable, "-c", "import sofnn_torch.terminal"]
        subprocess.run(command, env=os.environ, check=True)
    alone = (time.perf_counter() - begin) / len(jobs)
    print(f"a job: {through:.2f} s, of which its imports take {alone:.2f} s", flush=True)
    return {"through": through, "imports": alone}


def memory(options: Options, folder: Path) -> list[tuple]:
    """Many short jobs: memory of client, scheduler and worker."""
    (folder / "many").mkdir()
    jobs = [
        Job(str(i), folder / "many" / str(i), "", {"seconds": "0.01"}) for i in range(options.many)
    ]
    with cluster(8, folder, "--preload", "asleep") as (address, processes):
        samples = passed(jobs, address, processes)
    for at in range(0, len(samples), max(1, len(samples) // 10)):
        print(_line(at, samples[at]), flush=True)
    print(_line(len(samples) - 1, samples[-1]), flush=True)
    return samples


def _line(at: int, sample: tuple) -> str:
    seconds, client, scheduler, worker = sample
    return (
        f"job {at + 1:5d} after {seconds:6.1f} s: client {client:6.1f} MB, "
        f"scheduler {scheduler:6.1f} MB, worker {worker:6.1f} MB"
    )


def trainings(options: Options, folder: Path) -> list[dict[str, Any]]:
    """Seconds of equal trainings, two for each worker: bare processes, `--workers`, the cluster."""
    config = dataclasses.asdict(Config(agent="q", trials=options.trials))
    keeping = {"picture_every": 0, "quiet": True}
    arguments = {"config": config, "options": keeping}
    rows: list[dict[str, Any]] = []
    for how in ("bare", "here", "cluster"):
        for workers in (1, 2):
            place = folder / f"{how}-{workers}"
            place.mkdir()
            names = [str(i) for i in range(2 * workers)]
            begin = time.perf_counter()
            if how == "bare":
                bare(names, workers, place, options.trials)
            else:
                jobs = [Job(i, place / i, parallel.WORK, arguments) for i in names]
                with contextlib.ExitStack() as stack:
                    where = None
                    if how == "cluster":
                        where, _ = stack.enter_context(cluster(workers, folder))
                    begin = time.perf_counter()
                    list(done(jobs, workers, where))
            took = time.perf_counter() - begin
            rows.append({"how": how, "workers": workers, "seconds": took})
            efficiency = rows[-workers]["seconds"] / took
            print(f"{how}, {workers} at a time: {took:.1f} s, efficiency {efficiency:.2f}")
    return rows


def bare(names: list[str], workers: int, place: Path, trials: int) -> None:
    """The same trainings with nothing of ours around them: what the machine itself allows."""
    flags = f"--agent q --trials {trials} --picture-every 0 --quiet --runs {place}".split()
    for at in range(0, len(names), workers):
        some = names[at : at + workers]
        command = [sys.executable, str(HOME / "train.py"), *flags, "--name"]
        running = [subprocess.Popen([*command, name], stdout=subprocess.DEVNULL) for name in some]
        if any(process.wait() for process in running):
            raise RuntimeError("a training failed")


def main() -> None:
    """Measure what was asked for."""
    options = tyro.cli(Options, description=__doc__)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "asleep.py").write_text(SLEEP)
        if options.trainings:
            found: dict[str, Any] = {"trainings": trainings(options, folder)}
        else:
            found = {"overhead": overhead(folder), "sleeping": sleeping(options, folder)}
            found["memory"] = memory(options, folder) if options.many else []
    if options.out:
        options.out.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
