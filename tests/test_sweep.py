"""Sweeps: what a space may say, what a try is worth, and that nothing is lost or drawn twice."""

import dataclasses
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import settings as short
from hypothesis import given
from hypothesis import strategies as st

from sofnn_torch import Config, evaluate, terminal
from sofnn_torch.cli import parse
from sofnn_torch.runs import checkpoint, preset_files
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.session import RunOptions
from sofnn_torch.sweep import __main__ as sweep
from sofnn_torch.sweep import space, tries
from sofnn_torch.sweep.__main__ import Options
from sofnn_torch.training import train

optuna = pytest.importorskip("optuna")
ROOT = Path(__file__).parents[1]
SPACE = """
[q]
temperature = { low = 0.0005, high = 0.05, log = true }
[net]
theta = [0.3, 0.5]
width = { times = [0.5, 2.0] }
"""
WORDS = "--env CartPole-v1 --agent q --trials 3 --seeds 0,1 --space space.toml --episodes 2".split()


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("space.toml").write_text(SPACE)
    return tmp_path


def search(tries, *words):
    """Call the command in this process."""
    return sweep.run(terminal.parse(Options, [*WORDS, "--tries", str(tries), *words], ""))


def tried(out="runs/sweep-q-sofnn-CartPole-v1"):
    """What was tried and what it was worth."""
    backend = optuna.storages.journal.JournalFileBackend(f"{out}/journal.log")
    study = optuna.load_study(study_name="sweep", storage=optuna.storages.JournalStorage(backend))
    return [(t.state.name, t.params, t.value, t.intermediate_values) for t in study.trials]


def test_the_best_try_is_written_for_train_py_and_a_sweep_goes_on_as_if_never_stopped(here, capsys):
    assert search(2) == 0 and search(3) == 0
    out = Path("runs/sweep-q-sofnn-CartPole-v1")
    results, said = tried(), capsys.readouterr().out
    assert [state for state, *_ in results] == ["COMPLETE"] * 3
    best = max(range(3), key=lambda number: results[number][2])
    config = parse(["--settings", str(out / "best.toml")]).config
    runs = [out / f"try-{best}-s{seed}" for seed in (0, 1)]
    loaded = [evaluate.load(run) for run in runs]
    assert [each.config for each in loaded] == [dataclasses.replace(config, seed=s) for s in (0, 1)]
    *_, line = (line for line in said.splitlines() if line.startswith("best: train.py "))
    assert parse(line.split()[2:]).config == config
    returns = [
        record.reward
        for each, seed in zip(loaded, (1000, 1001), strict=True)
        for record in evaluate.evaluate(each.config, each.agent, 2, seed=seed)
    ]
    assert results[best][2] == pytest.approx(sum(returns) / 4)
    before = sorted(here.rglob("*"))
    assert search(3) == 0 and sorted(here.rglob("*")) == before  # nothing is left to do
    assert search(3, "--out", "whole") == 0
    assert tried("whole") == results


def test_a_try_that_was_cut_short_goes_on_where_it_was(here, monkeypatch, capsys):
    """The process ends before the second run of the second try is judged."""
    real, count = tries.judge, []

    def dying(runs, goal):
        count.append(1)
        if len(count) == 2:
            raise KeyboardInterrupt
        return real(runs, goal)

    monkeypatch.setattr(tries, "judge", dying)
    with pytest.raises(KeyboardInterrupt):
        search(2)
    assert [state for state, *_ in tried()] == ["COMPLETE", "RUNNING"]
    shutil.rmtree("runs/sweep-q-sofnn-CartPole-v1/try-1-s1")
    assert search(2) == 0
    assert "try 1 was cut short: it goes on" in capsys.readouterr().err
    assert search(2, "--out", "whole") == 0
    assert tried("whole") == tried()


class Trial:
    """What a run asks of Optuna, which here gives up at a step."""

    def __init__(self, end):
        self.end, self.told, self.number = end, {}, 0
        self.study = type("Study", (), {"trials": [optuna.trial.create_trial(value=0.0)]})

    def report(self, value, step):
        self.told[step] = value

    def should_prune(self):
        return max(self.told) >= self.end


GOAL = tries.Goal("return", 2, None)


def test_a_hopeless_run_ends_with_a_trial_and_is_saved(tmp_path):
    run, trial, seen = tmp_path / "run", Trial(1003), []
    with pytest.raises(tries.Hopeless):
        tries.learn(short(trials=8), run, GOAL, trial, 1000, seen.append)
    assert seen == [1, 2, 3] and sorted(trial.told) == [1001, 1002, 1003]
    assert checkpoint.find_latest(run)[1]["trial"] == 3


def test_a_run_ends_with_the_trial_that_completes_its_budget(tmp_path):
    goal, seen = dataclasses.replace(GOAL, budget=250), []  # of trials with 120 steps at most
    for _ in range(2):  # the second time nothing is left to do
        tries.learn(short(trials=8), tmp_path / "run", goal, Trial(99), 0, seen.append)
    _, state, _ = checkpoint.find_latest(tmp_path / "run")
    assert seen == [1, 2, 3] and state["trial"] == 3 and state["total_steps"] == 360


def test_steps_are_those_of_failed_trials_too(tmp_path):
    config = short(trials=1)
    run = train(config, RunOptions(runs=tmp_path, quiet=True, picture_every=0, video_every=0))
    assert tries.judge([run, run], tries.Goal("steps", 3, None)) == config.maze.max_steps


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("network", ["sofnn", "fixed"])
@pytest.mark.parametrize("env", ["maze", "CartPole-v1"])
def test_every_learner_has_a_space_whose_ends_are_settings(agent, network, env):
    entries = {"agent": agent, "network": network, "env": env}
    found = space.ranges(space.built_in(Config(**entries)), entries, "built in")
    assert len(found) >= 5 and all(range_.low < range_.high for range_ in found.values())


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_the_search_for_what_the_paper_does_not_print_leaves_what_it_prints(agent):
    file = Path(__file__).parents[1] / f"benchmarks/completed_{agent}.toml"
    found = space.ranges(preset_files.read(file), {"agent": agent, "preset": "paper"}, file.name)
    printed = {"sga.rate_mean", "sga.rate_deviation", "sga.gamma", "q.temperature", "q.gamma"}
    printed |= {"q.rate_state", "q.rate_action", "q.rate_constant", "maze.goal_reward", "trials"}
    assert len(found) >= 8 and not printed & found.keys()


@pytest.mark.parametrize(
    "file,env",
    [
        ("continuous", "MountainCarContinuous-v0"),
        ("mountain_car", "MountainCar-v0"),
        ("cart_pole", "CartPole-v1"),
        ("acrobot", "Acrobot-v1"),
    ],
)
def test_the_spaces_of_the_tasks_hold_what_was_found_there(file, env):
    path = Path(__file__).parents[1] / f"benchmarks/{file}.toml"
    entries = {"agent": "q", "env": env}
    found = space.ranges(preset_files.read(path), entries, path.name)
    usual = flatten(dataclasses.asdict(Config(**entries)))
    for name, range_ in found.items():
        value = list(usual[name]) if isinstance(usual[name], list | tuple) else usual[name]
        value = value[0] if isinstance(value, list) and not range_.choices else value
        inside = value in range_.choices if range_.choices else range_.low <= value <= range_.high
        assert inside, name


@given(st.floats(1e-6, 1e3), st.floats(1.01, 100), st.booleans(), st.integers(0, 9))
def test_a_number_is_within_its_range_and_has_few_digits(low, factor, log, seed):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    range_ = space.Range(low=low, high=low * factor, log=log)
    value = range_.suggest(study.ask(), "x")
    assert low <= value <= low * factor
    assert value in (low, low * factor) or float(f"{value:.3g}") == value


@pytest.mark.parametrize(
    "text,message",
    [
        ("", "no setting to search for"),
        ("net.tetha = [1]", "'net.tetha' is no setting of a run"),
        ("[net]\ntheta = 0.3", "net.theta: needs a list of choices, { low = , high = }"),
        ("[net]\ntheta = []", "net.theta: needs a list of choices"),
        ("net.theta = { low = 0.1 }", "net.theta: needs a list of choices"),
        ("net.theta = { low = 0.5, high = 0.1 }", "net.theta: low must be below high"),
        ("net.theta = { low = 0.5, high = 1.5 }", "--net.theta must lie between 0 and 1, got 1.5"),
        ("net.theta = { low = 'a', high = 1 }", "low and high must be numbers"),
        ("net.theta = { low = 0.1, high = 0.5, step = 0 }", "step must be a positive number"),
        ("q.replays = { low = 0, high = 9, log = true }", "above 0 with log"),
        ("q.replays = { low = 0.5, high = 9.5 }", "--q.replays must be a whole number, got 0.5"),
        ("q.replays = { times = [1] }", "q.replays: "),
        ("sga.gamma = [0.9]", "sga.gamma: it has no effect with --agent q"),
        ("maze.hold = [1, 2]", "maze.hold: it has no effect with --env CartPole-v1"),
    ],
)
def test_what_is_wrong_in_a_space_is_one_line(text, message, here):
    Path("space.toml").write_text(text)
    with pytest.raises(ValueError, match=r"space\.toml: ") as error:
        search(1)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    "words,message",
    [
        (["--trials", "5"], "holds a sweep with another trials"),
        (["--seeds", "0"], "holds a sweep with another seeds"),
        (["--objective", "steps"], "holds a sweep with another objective"),
        (["--out", "."], "--out . holds something that is no sweep"),
        (["--out", "space.toml"], "--out space.toml cannot be used"),
    ],
)
def test_a_sweep_is_only_gone_on_with_by_the_same_command(words, message, here, monkeypatch):
    monkeypatch.setattr(sweep, "_take", lambda *_: None)
    search(1)
    with pytest.raises(ValueError, match=message):
        search(1, *words)
    assert search(2) == 0  # more tries are no other sweep


def test_a_missing_optuna_is_one_line(here, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ValueError, match=r"pip install 'sofnn-torch\[sweep\]'"):
        search(1)
    assert not Path("runs").exists()


def process(*words):
    command = [sys.executable, "-m", "sofnn_torch.sweep", *WORDS, *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.slow
def test_a_sweep_that_is_killed_again_and_again_ends_as_one_that_never_was(here):
    begin = time.monotonic()
    assert process("--tries", "8", "--out", "whole").wait(600) == 0
    took = time.monotonic() - begin
    clock, code, kills = random.Random(0), None, 0
    while code != 0:
        child = process("--tries", "8")
        try:
            code = child.wait(took * clock.uniform(0.3, 0.8) * 1.1**kills)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
            kills += 1
    assert 0 < kills < 30
    assert tried() == tried("whole")


@pytest.mark.slow
def test_several_processes_share_the_tries(here):
    children = [process("--tries", "6") for _ in range(3)]
    time.sleep(0.1)
    assert [child.wait(600) for child in children] == [0] * 3
    results = tried()
    assert [state for state, *_ in results if state in ("COMPLETE", "PRUNED")] == [
        state for state, *_ in results
    ]
    assert len(results) == 6 == len({str(params) for _, params, *_ in results})
