"""Disks that fill up, directories that vanish, numbers that diverge: nothing is lost."""

import builtins
import dataclasses
import errno
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import doomed
import filelock
import pytest
from conftest import equal, quick_options, settings

from sofnn_torch import cli, training
from sofnn_torch.pictures import tensorboard
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.checkpoint import CheckpointError
from sofnn_torch.runs.directory import Run, load_config
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.guard import Divergence
from sofnn_torch.runs.places import default_name, numbered
from sofnn_torch.runs.signals import NUMBERS, Interrupted, SignalTrap
from sofnn_torch.studies import __main__ as studies
from sofnn_torch.studies import change, peers
from sofnn_torch.sweep import __main__ as sweep
from sofnn_torch.training import play

NAME = default_name(settings())
ROOT = Path(__file__).parents[1]


@pytest.fixture
def reference(tmp_path):
    """A run of four trials that nothing disturbed."""
    return training.train(settings(), quick_options(tmp_path / "reference"))


@pytest.fixture
def between_trials(monkeypatch):
    """Runs a function before the trial of a given number."""

    def plan(**actions):
        real, trial = training.play, 0

        def scripted(*arguments, **keywords):
            nonlocal trial
            trial += 1
            if action := actions.get(f"before_{trial}"):
                action()
            return real(*arguments, **keywords)

        monkeypatch.setattr(training, "play", scripted)

    return plan


def same_end(ours, theirs):
    a, b = (checkpoint.find_latest(run)[1] for run in (ours, theirs))
    assert equal(a, b)
    assert (ours / "trials.csv").read_bytes() == (theirs / "trials.csv").read_bytes()


def warnings(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]


# --------------------------------------------------------------------------------- disk and files


def mounted(directory, options):
    """A small file system of its own, or a skip where that is not allowed."""
    directory.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(directory)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no tmpfs can be mounted here: {done.stderr.strip()}")
    return directory


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 512 KiB."""
    if not shutil.which("mount"):
        pytest.skip("no mount command")
    disk = mounted(tmp_path / "disk", "size=512k")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def fill(disk):
    """Take all the space that is left."""
    with open(disk / "filler", "wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError as error:
            assert error.errno == errno.ENOSPC


def test_a_disk_full_for_a_while_costs_nothing(small_disk, reference, between_trials, capsys):
    between_trials(
        before_2=lambda: fill(small_disk), before_4=lambda: (small_disk / "filler").unlink()
    )
    run = training.train(settings(), quick_options(small_disk))
    same_end(run, reference)
    assert len([line for line in warnings(capsys) if "No space left" in line]) >= 1
    assert not list(run.glob(".*.tmp"))


def test_a_full_disk_keeps_the_old_checkpoint_and_saves_elsewhere(
    small_disk, reference, between_trials, tmp_path, monkeypatch
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    between_trials(before_2=lambda: fill(small_disk))
    with pytest.raises(OSError, match=r"trial 4 is saved outside it.*--resume \S+checkpoint-4\.pt"):
        training.train(settings(), quick_options(small_disk))
    assert checkpoint.find_latest(small_disk / NAME)[1]["trial"] == 0
    (rescued,) = tmp_path.glob("sofnn-rescue-*/*.pt")
    assert equal(checkpoint.load(rescued), checkpoint.find_latest(reference)[1])


def test_a_disk_that_is_full_from_the_start_is_named(small_disk):
    fill(small_disk)
    with pytest.raises(ValueError, match="No space left"):
        training.train(settings(), quick_options(small_disk))
    assert [path.name for path in small_disk.iterdir()] == ["filler"]


def test_a_read_only_disk_is_named_at_the_start(small_disk):
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(ValueError, match="Read-only file system"):
        training.train(settings(), quick_options(small_disk))


def test_a_disk_that_is_read_only_for_a_while_costs_nothing(
    options, reference, monkeypatch, capsys
):
    # Open files forbid a real remount, so every open for the second trial's record is refused.
    real, calls = Run.record, 0

    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    def record(run, row):
        nonlocal calls
        calls += 1
        with pytest.MonkeyPatch.context() as patch:
            if calls == 2:
                patch.setattr(builtins, "open", refuse)
            real(run, row)

    monkeypatch.setattr(Run, "record", record)
    same_end(training.train(settings(), options), reference)
    (line,) = warnings(capsys)
    assert "Read-only file system" in line


def without_privilege(*words):
    """The command of a training that obeys the permissions of files, as root would not."""
    command = [sys.executable, str(ROOT / "train.py"), *words, "--quiet", "--picture-every", "0"]
    command += ["--video-every", "0", "--checkpoint-every", "1"]
    command += ["--maze.max-steps", "120", "--sga.replays", "10"]  # as conftest.settings
    if os.geteuid() == 0:
        if not shutil.which("setpriv"):
            pytest.skip("root cannot give up its privilege here")
        command = ["setpriv", "--bounding-set", "-dac_override", *command]
    return command


def test_a_directory_without_write_permission_is_named_at_the_start(tmp_path):
    tmp_path.chmod(0o555)
    done = subprocess.run(
        without_privilege("--runs", str(tmp_path)), capture_output=True, text=True, timeout=300
    )
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and "Permission denied" in line
    assert not list(tmp_path.iterdir())


def test_a_directory_that_turns_read_only_costs_nothing(tmp_path):
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with subprocess.Popen(
        without_privilege("--runs", str(runs), "--trials", "100000"),
        env=os.environ | {"TMPDIR": str(elsewhere), "OMP_NUM_THREADS": "1"},
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        try:
            wait_for(runs / NAME / "checkpoint-3.pt")
            (runs / NAME).chmod(0o555)
            first = child.stderr.readline()
            child.send_signal(signal.SIGTERM)
            _, messages = child.communicate(timeout=300)
        finally:
            child.kill()
    assert "Permission denied" in first and "will try again" in first
    assert child.returncode == 1 and "Traceback" not in messages
    (runs / NAME).chmod(0o755)
    (rescued,) = elsewhere.glob("sofnn-rescue-*/*.pt")
    assert f"--resume {rescued}" in messages
    trial = checkpoint.load(rescued)["trial"]
    assert trial > checkpoint.find_latest(runs / NAME)[1]["trial"]
    config = settings(trials=trial)
    undisturbed = training.train(config, quick_options(tmp_path / "undisturbed"))
    ours, theirs = checkpoint.load(rescued), checkpoint.find_latest(undisturbed)[1]
    assert equal(ours | {"config": theirs["config"]}, theirs)


def test_an_old_checkpoint_that_stays_is_no_failure_to_save(
    options, reference, between_trials, capsys
):
    run = options.runs / NAME

    def refuse_removal():  # what is no file cannot be unlinked
        (run / "checkpoint-1.pt").unlink()
        (run / "checkpoint-1.pt").mkdir()

    between_trials(before_2=refuse_removal)
    training.train(settings(), dataclasses.replace(options, keep=1, checkpoint_every=1))
    same_end(run, reference)
    assert not warnings(capsys)
    assert {path.name for path in run.glob("*.pt")} == {"checkpoint-4.pt", "checkpoint-1.pt"}


@pytest.mark.parametrize("when", ["before_1", "before_3", "before_4"])
def test_a_deleted_directory_is_made_anew(when, options, reference, between_trials, capsys):
    run = options.runs / NAME
    between_trials(**{when: lambda: shutil.rmtree(run)})
    assert training.train(settings(), options) == run
    same_end(run, reference)
    assert load_config(run) == load_config(reference)
    (line,) = warnings(capsys)
    assert "was deleted" in line


def test_all_runs_deleted_are_made_anew(options, reference, between_trials):
    between_trials(before_3=lambda: shutil.rmtree(options.runs))
    same_end(training.train(settings(), options), reference)


def test_a_later_run_of_the_same_name_is_not_touched(options, reference, between_trials):
    run = options.runs / NAME

    def replace():
        shutil.rmtree(run)
        shutil.copytree(reference, run)

    between_trials(before_3=replace)
    elsewhere = training.train(settings(), options)
    assert elsewhere.name == f"{NAME}-2"
    same_end(elsewhere, reference)
    for path in reference.glob("*.pt"):
        assert (run / path.name).read_bytes() == path.read_bytes()


def test_a_damaged_table_is_written_anew(options, reference, between_trials):
    table = options.runs / NAME / "trials.csv"
    between_trials(before_3=lambda: table.write_text("gone"))
    same_end(training.train(settings(), options), reference)


def test_a_second_process_is_refused(options):
    run = training.train(settings(trials=2), options)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    with filelock.FileLock(run / "run.lock"):  # as the first process holds it
        with pytest.raises(ValueError, match="another process works on it"):
            training.resume(run, options, trials=4)
        assert {path.name: path.read_bytes() for path in run.iterdir()} == before
    assert training.resume(run, options, trials=4) == run


def test_a_run_that_another_process_trains_is_refused_until_it_is_killed(options):
    run = options.runs / NAME
    child = doomed.start(settings(trials=100_000), options, run)
    wait_for(run / "checkpoint-2.pt")
    with pytest.raises(ValueError, match="another process works on it"):
        training.resume(run, options)
    child.kill()
    assert doomed.finish(child) == -signal.SIGKILL
    done = checkpoint.find_latest(run)[1]["trial"]
    training.resume(run, options, trials=done + 1)
    assert checkpoint.find_latest(run)[1]["trial"] == done + 1


def wait_for(path):
    deadline = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} never came"
        time.sleep(0.01)


def test_a_failed_resume_gives_the_run_back(options):
    run = training.train(settings(trials=2), options)
    (run / "checkpoint-2.pt").write_bytes(b"")
    with pytest.raises(CheckpointError):
        training.resume(run, options)
    with filelock.FileLock(run / "run.lock", timeout=0):
        pass


# --------------------------------------------------------------------------------------- starting


def test_any_number_of_simultaneous_starts_make_as_many_runs(tmp_path):
    together = threading.Barrier(8)

    def start():
        together.wait()
        with Run.create(numbered(tmp_path / "runs" / "run"), settings(), keep=3) as run:
            run.begin({"trial": 0})
        run.close()
        return run.path

    with ThreadPoolExecutor(8) as pool:
        made = [future.result() for future in [pool.submit(start) for _ in range(8)]]
    assert len(set(made)) == 8 and sorted((tmp_path / "runs").iterdir()) == sorted(made)
    assert all((run / "checkpoint-0.pt").exists() and load_config(run) for run in made)


def test_the_same_name_given_twice_is_refused_and_leaves_nothing(options):
    named = dataclasses.replace(options, name="run")
    training.train(settings(trials=1), named)
    before = (options.runs / "run" / "trials.csv").read_bytes()
    with pytest.raises(ValueError, match=r"exists: choose another --name, or go on with --resume"):
        training.train(settings(trials=1), named)
    assert [path.name for path in options.runs.iterdir()] == ["run"]
    assert (options.runs / "run" / "trials.csv").read_bytes() == before


def test_an_empty_directory_is_no_obstacle(options):
    (options.runs / NAME).mkdir(parents=True)
    assert training.train(settings(trials=1), options) == options.runs / NAME


def test_a_start_that_fails_half_way_leaves_nothing(tmp_path):
    with pytest.raises(KeyError), Run.create([tmp_path / "run"], settings(), keep=3) as run:
        run.begin({})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "kind,count",
    [
        pytest.param(kind, n, marks=[pytest.mark.slow] * (n % 2))  # every second one by default
        for kind, last in (("file", 14), ("fsync", 5))
        for n in range(1, last + 1)
    ],
)
def test_a_crash_at_any_instant_of_starting_leaves_a_whole_run_or_none(kind, count, tmp_path):
    config, options, run = settings(trials=1), quick_options(tmp_path / "runs"), tmp_path / "runs"
    run = run / NAME
    assert doomed.finish(doomed.start(config, options, run, (kind, count))) == -signal.SIGKILL
    if run.exists():
        assert load_config(run) == config and checkpoint.find_latest(run)
    assert doomed.finish(doomed.start(config, options, run)) == 0
    assert checkpoint.find_latest(run)[1]["trial"] == 1
    assert list(options.runs.iterdir()) == [run]  # nothing is left behind


# ---------------------------------------------------------------------------------------- signals


@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_between_trials_saves_what_is_done(number, options, between_trials):
    between_trials(before_4=lambda: os.kill(os.getpid(), number))
    handlers = [signal.getsignal(n) for n in NUMBERS]
    with pytest.raises(Interrupted) as caught:
        training.train(settings(), quick_options(options.runs, checkpoint_every=100))
    assert caught.value.number == number and caught.value.run == options.runs / NAME
    assert checkpoint.find_latest(options.runs / NAME)[1]["trial"] == 3
    assert [signal.getsignal(n) for n in NUMBERS] == handlers


def test_a_hangup_that_is_ignored_stays_ignored():
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with SignalTrap() as trap:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not trap.number
    finally:
        signal.signal(signal.SIGHUP, former)


@pytest.mark.parametrize("kind", [ValueError, RuntimeError, MemoryError])
def test_a_bug_in_a_trial_saves_what_is_done_and_is_not_hidden(
    kind, options, reference, between_trials
):
    def fail():
        raise kind("a bug")

    between_trials(before_4=fail)
    # A ValueError would pass for bad input of the user.
    with pytest.raises(RuntimeError if kind is ValueError else kind, match="a bug"):
        training.train(settings(), quick_options(options.runs, checkpoint_every=100))
    training.resume(options.runs / NAME, options)
    same_end(options.runs / NAME, reference)


# ------------------------------------------------------------------------------------- monitoring


def test_training_goes_on_without_tensorboard(options, reference, monkeypatch, capsys):
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(tensorboard, "EventFile", refuse)
    run = training.train(settings(), options)
    same_end(run, reference)
    (line,) = warnings(capsys)
    assert "TensorBoard" in line and "Permission denied" in line


def test_training_goes_on_without_gl(options, reference, monkeypatch, capsys):
    def refuse(*_, **__):
        raise RuntimeError("no GL context")

    monkeypatch.setattr(tensorboard, "film", refuse)
    run = training.train(settings(), dataclasses.replace(options, video_every=1))
    same_end(run, reference)
    (line,) = warnings(capsys)
    assert "video" in line and "no GL context" in line


# ---------------------------------------------------------------------------------------- numbers


def parts(config):
    agent, env = make_agent(config), make_env(config)
    env.reset(seed=0)
    play(env, agent)
    return agent, env


def poisoned(env, decision, change):
    """The environment, whose result at a decision is changed."""
    real, count = env.step, 0

    def step(action):
        nonlocal count
        count += 1
        result = real(action)
        return change(*result) if count == decision else result

    env.step = step
    return env


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("part", ["centres", "widths", "consequents"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_parameters_that_are_not_finite_are_named(agent, part, value):
    learner, env = parts(settings(agent))
    getattr(learner.net, part)[0, 0] = value
    with pytest.raises(Divergence, match=f"{part} of .* rules, as in rule 1: "):
        play(env, learner)


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_traces_that_are_not_finite_are_named(agent):
    learner, env = parts(settings(agent))

    def change(*result):
        learner.net.traces[-1, 0] = math.nan
        return result

    with pytest.raises(Divergence, match=r"(traces|consequents) of .* rules"):
        play(poisoned(env, 3, change), learner)


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_observation_that_is_not_finite_is_named(agent, value):
    learner, env = parts(settings(agent))

    def change(observation, *rest):
        observation[1] = value
        return observation, *rest

    with pytest.raises(Divergence, match="observation"):
        play(poisoned(env, 3, change), learner)


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_a_reward_that_is_not_finite_is_noticed(agent):
    learner, env = parts(settings(agent))

    def change(observation, _, *rest):
        return observation, math.nan, *rest

    with pytest.raises(Divergence):
        play(poisoned(env, 3, change), learner)


def test_unstable_physics_is_named():
    learner, env = parts(settings())

    def change(*result):
        env.unwrapped.physics.data.qvel[:] = 1e12
        return result

    with pytest.raises(Divergence, match=r"MuJoCo warns of BADQ|observation"):
        play(poisoned(env, 3, change), learner)


def test_other_errors_stay_what_they_are():
    learner, env = parts(settings())

    def change(*_):
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        play(poisoned(env, 3, change), learner)


def test_a_divergence_can_be_played_again(options):
    config = settings("q", q={"rate_action": 1e3}, maze={"max_steps": 1000})
    with pytest.raises(Divergence, match=r"trial \d+ diverged: .*divergence-\d+\.pt") as first:
        training.train(config, options)
    run = options.runs / default_name(config)
    (file,) = run.glob("divergence-*.pt")
    assert f"trial {checkpoint.load(file)['trial'] + 1} diverged" in str(first.value)
    with pytest.raises(Divergence) as second:
        training.play_again(file)
    assert checkpoint.load(file)["reason"] == str(second.value)
    assert str(second.value) in str(first.value)


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize(
    "net", [{"theta": 0.999}, {"width_position": 1e-3}, {"width_heading": 1e-3}]
)
def test_extreme_growth_ends_at_the_cap(agent, net, options, capsys):
    # Where a rule is alone for many decisions, traces would add up to steps that diverge.
    parts = {"net": net | {"max_rules": 20}, "maze": {"max_steps": 500}, agent: {"trace_decay": 0}}
    config = settings(agent, trials=2, **parts)
    run = training.train(config, options)
    state = checkpoint.find_latest(run)[1]
    assert state["network"]["rules"] == 20
    (line,) = warnings(capsys)
    assert "20 rules" in line and "--net.max-rules" in line
    blocks = [v for k, v in state["agent"]["net"].items() if "blocks" in k]
    assert blocks and all(block.isfinite().all() for block in blocks)


@pytest.mark.parametrize("name", ["width_position", "width_heading"])
@pytest.mark.parametrize("width", [1e-6, 0.0, -1.0, math.nan, 1e-300])
def test_impossible_widths_are_refused(name, width, options):
    with pytest.raises(ValueError, match="width"):
        training.train(settings(net={name: width}), options)
    assert not options.runs.exists()


@pytest.mark.slow
def test_no_gl_at_all_is_one_warning(tmp_path):
    """A process whose GL library cannot be loaded trains and records without video."""
    command = [sys.executable, "train.py", "--runs", str(tmp_path), "--trials", "2", "--quiet"]
    command += ["--video-every", "1", "--picture-every", "0", "--maze.max-steps", "50"]
    # An X display that is not there: GLFW loads and fails.
    environment = os.environ | {"MUJOCO_GL": "glfw", "DISPLAY": ":987", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert sum("no video" in line for line in done.stderr.splitlines()) == 1, done.stderr
    assert checkpoint.find_latest(tmp_path / NAME)[1]["trial"] == 2


@pytest.mark.parametrize(
    ("main", "words"),
    [
        (cli.main, "--trials 1 --runs {}"),
        (cli.main, "--trials 1 --seeds 0-1 --runs {}"),
        (sweep.main, "--env CartPole-v1 --agent q --trials 1 --tries 1 --out {}"),
        (studies.main, "--study growth --seeds 0 --trials 1 --out {}"),
        (studies.main, "--study growth --seeds 0 --trials 1 --out free --runs {}"),
        (change.main, "--seeds 0 --out {}"),
        (peers.main, "--learners tiles --seeds 0 --out {}"),
    ],
)
@pytest.mark.parametrize("below", ["", "/deeper"])
def test_a_file_in_the_place_of_a_directory_is_said_before_anything_is_done(
    main, words, below, tmp_path, monkeypatch, capsys
):
    if main is sweep.main:
        pytest.importorskip("optuna")
    monkeypatch.chdir(tmp_path)
    Path("notes").write_text("mine")
    monkeypatch.setattr(sys, "argv", ["command", *words.format(f"notes{below}").split()])
    with pytest.raises(SystemExit) as stop:
        sys.exit(main())
    (line,) = capsys.readouterr().err.splitlines()
    assert (stop.value.code, line.endswith("cannot be used (notes is a file)")) == (2, True), line
    assert Path("notes").read_text() == "mine"
