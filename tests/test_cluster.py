"""Jobs on a Dask cluster: whatever is killed, each seed ends with the bits of one left in peace."""

import contextlib
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import filelock
import psutil
import pytest
from conftest import assert_same_run, quick_options
from conftest import settings as short

from sofnn_torch.progress import Progress
from sofnn_torch.runs import checkpoint, jobs, parallel
from sofnn_torch.runs.jobs import PAUSED, Job
from sofnn_torch.runs.signals import Interrupted, SignalTrap

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
from sofnn_torch.cluster import client, connection, worker  # noqa: E402

SAME_DISK = worker._same_disk
ROOT = Path(__file__).parents[1]
SEEDS = range(3)
TRIALS = 12
FLAGS = (  # those of `config` and `quick_options`
    "--agent q --network fixed --net.grid 4 4 4 --maze.max-steps 5000 --q.replays 0 "
    "--q.replay-every 0 --quiet --checkpoint-every 2 --picture-every 0 --video-every 0"
)
NO_REPLAY = {"replays": 0, "replay_every": 0}
LIGHT = f"""
import os, sys
def work(path, arguments, after):
    path.mkdir(exist_ok=True)
    if arguments.get("crash"):
        os.abort()
    with open(path / "trials.csv", "a") as file:
        file.write("trial\\n" * (file.tell() == 0) + "1\\n")
        done = file.tell() > len("trial\\n1\\n1\\n")
    (path / "config.json").write_text("done" * done)
    return 0 if done else {PAUSED}
"""


@pytest.fixture
def light(tmp_path, monkeypatch):
    """A module whose jobs need no torch, found by the processes that do them."""
    (tmp_path / "light.py").write_text(LIGHT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(jobs.ENVIRONMENT, "PYTHONPATH", f"{tmp_path}:{ROOT}")
    return tmp_path / "runs"


def test_slices_of_a_run_come_back_and_a_crash_leaves_the_others(light, monkeypatch):
    """A real scheduler and worker; each job takes three slices, on a copy and then in place."""
    seen = iter([False, False, False])  # afterwards the workers see the disk
    monkeypatch.setattr(worker, "_same_disk", lambda *probe: next(seen, SAME_DISK(*probe)))
    with (
        distributed.LocalCluster(1, 2, processes=False, dashboard_address=":0") as cluster,
        SignalTrap() as trap,
    ):
        those = [Job(name, light / name, "light:work", {"crash": name == "b"}) for name in "abc"]
        bar = Progress("jobs", 9, quiet=True)
        done = list(parallel.together(those, 1, bar, trap, cluster.scheduler_address))
    assert sorted((job.name, code) for job, code, _ in done) == [("a", 0), ("b", -6), ("c", 0)]
    assert [(light / name / "config.json").read_text() for name in "ac"] == ["done"] * 2
    assert [(light / name / "trials.csv").read_text() for name in "ac"] == ["trial\n1\n1\n1\n"] * 2
    assert bar.done == 6
    assert sorted(path.name for path in light.iterdir()) == ["a", "c"]


def test_what_came_back_is_put_in_place_in_an_order_that_can_be_cut_off(tmp_path, monkeypatch):
    """A client that dies between any two files leaves a table that reaches to the checkpoint."""
    job = Job("run", tmp_path / "run", "")
    job.path.mkdir()
    client.put_in_place({"config.json": b"{}", "trials.csv": b"1", "checkpoint-1.pt": b"1"}, job)
    written = []
    monkeypatch.setattr(
        client.checkpoint, "write_atomically", lambda path, data: written.append(path.name)
    )
    client.put_in_place({"checkpoint-2.pt": b"2", "trials.csv": b"12", "best.pt": b""}, job)
    assert written == ["best.pt", "trials.csv", "checkpoint-2.pt"]
    assert {path.name for path in job.path.iterdir()} == {
        "config.json",
        "trials.csv",
        "checkpoint-1.pt",
    }


def test_a_cluster_that_is_not_there_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(connection, "FIRST", 0.2)
    with pytest.raises(ValueError, match=r"--cluster tcp://127\.0\.0\.1:1 cannot be used"):
        parallel.train(short(), quick_options(tmp_path), "0-1", 1, "tcp://127.0.0.1:1")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_dask_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sofnn_torch.cluster.client", None)
    with pytest.raises(ValueError, match=r"pip install 'sofnn-torch\[cluster\]'"):
        parallel.train(short(), quick_options(tmp_path), "0-1", 1, "tcp://127.0.0.1:1")


# -------------------------------------------------------------------- real processes, and kills


class Site:
    """A scheduler, workers and a cable to them, all of which can be killed and come again."""

    def __init__(self, folder: Path, workers: int = 2):
        self.folder, self.clock, self.over = folder, random.Random(0), threading.Event()
        self.kills = 0
        self.port, self.outside = _free_port(), _free_port()
        self.address = f"tcp://127.0.0.1:{self.outside}"
        self.lines: set[socket.socket] = set()
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port))
        deadline = time.monotonic() + 120
        while socket.socket().connect_ex(("127.0.0.1", self.port)):
            assert time.monotonic() < deadline and self.scheduler.poll() is None
            time.sleep(0.1)
        self.workers = [self._worker() for _ in range(workers)]
        threading.Thread(target=self._cable, daemon=True).start()

    def _start(self, kind: str, *words: str) -> subprocess.Popen:
        module = f"distributed.cli.dask_{kind}"
        with open(self.folder / f"{kind}.log", "a") as log:
            return subprocess.Popen(
                [sys.executable, "-m", module, "--no-dashboard", *words],
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                stdout=log,
                stderr=log,
                cwd=self.folder,
            )

    def _worker(self) -> subprocess.Popen:
        words = ("--nthreads", "1", "--no-nanny", "--local-directory", str(self.folder))
        return self._start("worker", f"tcp://127.0.0.1:{self.port}", *words, "--death-timeout", "9")

    def kill(self, what: str) -> None:
        """Kill a worker, the scheduler or the connection of the client, and start it again."""
        if what == "worker":
            turn = self.clock.randrange(len(self.workers))
            self.workers[turn].kill()
            self.workers[turn].wait()
        elif what == "scheduler":
            self.scheduler.kill()
            self.scheduler.wait()
            words = ("--host", "127.0.0.1", "--port", str(self.port))
            self.scheduler = self._start("scheduler", *words)
        else:
            for line in list(self.lines):
                with contextlib.suppress(OSError):
                    line.shutdown(socket.SHUT_RDWR)

    def trouble(self, what: str, runs: Path) -> None:
        """Kill again and again as the runs get on, and start workers that have ended."""
        next_kill = 1
        while not self.over.wait(0.2):
            self.workers = [w if w.poll() is None else self._worker() for w in self.workers]
            if sum(Job("", run, "").trials() for run in runs.glob("q-*")) >= next_kill:
                next_kill += self.clock.randint(2, 8)
                time.sleep(self.clock.uniform(0, 1))
                self.kill(what)
                self.kills += 1

    def _cable(self) -> None:
        """Connections of the client go through here."""
        with socket.create_server(("127.0.0.1", self.outside)) as server:
            while True:
                ours, _ = server.accept()
                try:
                    theirs = socket.create_connection(("127.0.0.1", self.port))
                except OSError:
                    ours.close()
                    continue
                self.lines |= {ours, theirs}
                for ends in ((ours, theirs), (theirs, ours)):
                    threading.Thread(target=self._pass_on, args=ends, daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(2**16):
                sink.sendall(data)
        for end in (source, sink):
            self.lines.discard(end)
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.over.set()
        for child in (*self.workers, self.scheduler):
            child.kill()
            child.wait()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@pytest.fixture
def site(tmp_path):
    """A scheduler and two workers."""
    (tmp_path / "site").mkdir()
    made = Site(tmp_path / "site")
    yield made
    made.close()


@pytest.fixture(params=["in place", "copies"])
def disk(request, monkeypatch):
    """Workers that see the client's disk, and such that do not and get slices of one trial."""
    if request.param == "copies":
        monkeypatch.setattr(client, "SLICE", 0.01)
        monkeypatch.setattr(client._Handler, "_probe", lambda self, parent: ("/nowhere", "else"))
    return request.param


def config(trials):
    return short("q", "fixed", trials=trials, maze={"max_steps": 5000}, q=NO_REPLAY)


@pytest.fixture(scope="module")
def peaceful(tmp_path_factory):
    """The runs that nothing disturbs."""
    folder = tmp_path_factory.mktemp("peaceful")
    assert parallel.train(config(TRIALS), quick_options(folder), f"0-{SEEDS[-1]}", 2) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("what", ["worker", "scheduler", "connection"])
def test_no_seed_is_lost_whatever_is_killed(what, disk, site, peaceful, tmp_path, capsys):
    runs = tmp_path / "runs"
    threading.Thread(target=site.trouble, args=(what, runs), daemon=True).start()
    code = parallel.train(config(TRIALS), quick_options(runs), f"0-{SEEDS[-1]}", 1, site.address)
    said = capsys.readouterr()
    assert (code, said.out.count(": done")) == (0, len(SEEDS)), said
    names = sorted(path.name for path in peaceful.iterdir())
    assert sorted(path.name for path in runs.iterdir()) == names
    for name in names:
        assert_same_run(runs / name, peaceful / name)
    assert site.kills > 2


@pytest.mark.slow
def test_a_seed_that_crashes_is_reported_and_the_others_finish(disk, site, tmp_path, capsys):
    """The process of one seed aborts as soon as its run is there."""
    threading.Thread(target=_abort, args=(str(tmp_path), "-s1"), daemon=True).start()
    assert (
        parallel.train(config(TRIALS), quick_options(tmp_path / "runs"), "0-2", 1, site.address)
        == 1
    )
    out, err = capsys.readouterr()
    assert sorted(out.split()) == sorted(
        word for seed in (0, 2) for word in (f"{tmp_path}/runs/q-fixed-estimated-s{seed}:", "done")
    )
    assert "seed 1: exit code -6 (killed)" in err and "1 of 3 seeds failed" in err


def _abort(begin: str, ending: str) -> None:
    """Abort the first process of a job whose path begins and ends so."""
    while True:
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                command = process.cmdline()
                if "sofnn_torch.runs.jobs" not in command:
                    continue
                if command[-1].startswith(begin) and command[-1].endswith(ending):
                    process.send_signal(signal.SIGABRT)
                    return
        time.sleep(0.2)


@pytest.mark.slow
def test_a_signal_stops_all_seeds_after_saving(disk, site, tmp_path, capsys):
    runs = tmp_path / "runs"

    def interrupt():
        _two_begun(runs)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(Interrupted):
        parallel.train(config(100_000), quick_options(runs), "0-3", 1, site.address)
    said = capsys.readouterr().err
    for run in runs.iterdir():
        assert f"--resume {run}" in said
        assert_saved(run)
    assert len(list(runs.iterdir())) >= 2 and said.count("seed ") == 4


@pytest.mark.slow
def test_a_client_that_is_killed_leaves_runs_that_save_and_stop(site, tmp_path):
    runs = tmp_path / "runs"
    words = f"{FLAGS} --trials 100000 --seeds 0-1 --cluster {site.address} --runs {runs}".split()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.Popen([sys.executable, "-m", "sofnn_torch.cli", *words], env=environment)
    _two_begun(runs)
    child.kill()
    child.wait()
    for run in runs.glob("q-*"):
        with filelock.FileLock(run / "run.lock", timeout=120):
            assert_saved(run)


def _two_begun(runs: Path) -> None:
    """Wait until two runs have done a trial."""
    deadline = time.monotonic() + 300
    while len(list(runs.glob("q-*/trials.csv"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)


def assert_saved(run: Path) -> None:
    """The checkpoint holds all that the table does."""
    _, state, problems = checkpoint.find_latest(run)
    assert not problems and state["trial"] == Job("", run, "").trials() > 0


# ---------------------------------------------------------------------------------------- Slurm

CONF = """
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=4000
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A Slurm of one node, this machine."""
    needed = ("munged", "slurmctld", "slurmd", "sbatch")
    if os.getuid() or not all(map(shutil.which, needed)):
        pytest.skip("needs root and the Debian package slurm-wlm")
    folder, host = tmp_path / "slurm", socket.gethostname().split(".")[0]
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o700)  # or munged refuses it
    (folder / "munge.key").write_bytes(random.randbytes(1024))
    (folder / "munge.key").chmod(0o400)
    ports = _free_port(), _free_port()
    conf = CONF.format(host=host, folder=folder, ports=ports, cores=os.cpu_count())
    (folder / "slurm.conf").write_text(conf)
    files = {"key": "key", "socket": "socket", "pid": "pid", "log": "log", "seed": "seed"}
    words = [f"--{name}-file={folder}/munge.{end}" for name, end in files.items()]
    words[1] = f"--socket={folder}/munge.socket"
    with contextlib.ExitStack() as stack:
        for command in (
            ["munged", "--force", "--foreground", *words],
            ["slurmctld", "-D", "-f", f"{folder}/slurm.conf"],
            ["slurmd", "-D", "-f", f"{folder}/slurm.conf"],
        ):
            log = stack.enter_context(open(folder / f"{command[0]}.out", "w"))
            child = subprocess.Popen(command, stdout=log, stderr=log)
            stack.callback(child.wait)
            stack.callback(child.terminate)
            time.sleep(1)
        monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        deadline = time.monotonic() + 60
        while "idle" not in _said("sinfo", "-h", "-o", "%t"):
            assert time.monotonic() < deadline, (folder / "slurmctld.out").read_text()
            time.sleep(0.5)
        yield folder
        _said("scancel", "--user", "root")


def _said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


@pytest.mark.slow
def test_slurm_trains_the_seeds_and_a_job_that_is_cancelled_is_no_loss(
    slurm, peaceful, tmp_path, monkeypatch
):
    """The real command with the settings of the example, on two workers of one core."""
    monkeypatch.setenv("DASK_CONFIG", str(ROOT / "examples" / "slurm.yaml"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    words = f"{FLAGS} --trials {TRIALS} --seeds 0-2 --cluster slurm --workers 2".split()
    command = [sys.executable, "-m", "sofnn_torch.cli", *words]
    child = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while len(list(tmp_path.glob("runs/*/trials.csv"))) < 2:
        assert child.poll() is None, child.communicate()
        time.sleep(0.5)
    first = _said("squeue", "-h", "-o", "%i", "-t", "running").split()
    assert len(first) == 2
    _said("scancel", first[0])
    out, err = child.communicate(timeout=900)
    assert (child.returncode, out.count(": done")) == (0, len(SEEDS)), err
    for run in peaceful.iterdir():
        assert_same_run(tmp_path / "runs" / run.name, run)
    later = _said("squeue", "-h", "-o", "%i", "-t", "all").split()
    assert set(later) - set(first)  # another came for the one that was cancelled


@pytest.mark.slow
def test_what_slurm_refuses_is_one_line(slurm, tmp_path, monkeypatch):
    (tmp_path / "own.yaml").write_text(
        "jobqueue: {slurm: {cores: 1, memory: 1 GB, queue: nonesuch, walltime: '00:10:00'}}"
    )
    for settings, said in (("own.yaml", "invalid partition"), ("none.yaml", "cores")):
        environment = os.environ | {"PYTHONPATH": str(ROOT), "DASK_CONFIG": settings}
        done = subprocess.run(
            [sys.executable, "-m", "sofnn_torch.cli", *"--seeds 0-1 --cluster slurm".split()],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert done.stderr.startswith("error: --cluster slurm cannot be used: ")
        assert said in done.stderr
        assert not (tmp_path / "runs").exists()
