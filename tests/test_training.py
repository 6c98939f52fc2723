"""The trial loop: what it records, and that nothing but settings decides what is learned."""

import csv
import dataclasses
import json
import os
import random
import threading

import doomed
import numpy as np
import psutil
import pytest
import torch
from conftest import equal, quick_options, scalars, settings

from sofnn_torch import training
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.directory import load_config
from sofnn_torch.runs.factory import make_env
from sofnn_torch.runs.session import arithmetic, build
from sofnn_torch.training import RunOptions, play


def end_of(run):
    return checkpoint.find_latest(run)[1]


def rows_of(run):
    with open(run / "trials.csv", newline="") as file:
        return list(csv.DictReader(file))


# ------------------------------------------------------------------------------------- a trial


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_a_trial_is_recorded_as_it_was(agent):
    learner, env = build(settings(agent))
    steps, rewards, bumps = [], [], []
    real = env.step

    def step(action):
        result = real(action)
        rewards.append(result[1])
        bumps.append(result[4]["collision"])
        steps.append(result[4]["steps"])
        return result

    env.step = step
    record, path = play(env, learner)
    assert record.steps == sum(steps) == 120 and record.decisions == len(steps)
    assert record.reward == pytest.approx(sum(rewards)) and record.measures["collisions"] == sum(
        bumps
    )
    assert path.true.shape == path.estimated.shape == (len(steps) + 1, 3)
    distance = np.linalg.norm((path.true - path.estimated)[1:, :2], axis=1)
    assert record.measures["pose_error"] == pytest.approx(distance.mean())
    assert record.measures["pose_error_max"] == pytest.approx(distance.max())
    assert record.rules == learner.net.n_rules > 1
    assert not record.success and record.statistics


def test_a_heading_error_is_taken_the_short_way_round():
    learner, env = build(settings())
    real = env.step

    def step(action):
        observation, reward, terminated, truncated, info = real(action)
        info["true_pose"] = np.array([0.0, 0.0, np.pi - 0.1])
        info["estimated_pose"] = np.array([0.0, 0.0, -np.pi + 0.1])
        return observation, reward, terminated, truncated, info

    env.step = step
    record, _ = play(env, learner)
    assert record.measures["heading_error"] == pytest.approx(0.2)


@pytest.mark.parametrize("agent", ["sga", "q"])
@pytest.mark.parametrize("explore", [False, True])
def test_a_trial_without_learning_changes_nothing_but_random_numbers(agent, explore):
    learner, env = build(settings(agent))
    play(env, learner)
    before = checkpoint.snapshot(learner, env)["agent"]
    record, _ = play(env, learner, learn=False, explore=explore)
    after = checkpoint.snapshot(learner, env)["agent"]
    assert equal(before["net"], after["net"]) and record.statistics == {}
    assert equal(before["memory"], after["memory"])
    # Without exploration chance enters only where the policy comes back to a rule.
    assert not (explore and equal(before["rng"], after["rng"]))


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_the_learner_is_told_that_a_trial_was_cut_off_not_that_it_ended(agent, monkeypatch):
    learner, env = build(settings(agent))
    told, answers, real = [], [], learner.step

    def step(reward, observation, *ends):
        told.append(ends)
        answers.append(real(reward, observation, *ends))
        return answers[-1]

    monkeypatch.setattr(learner, "step", step)
    record, _ = play(env, learner)
    assert told == [(False, False)] * (record.decisions - 1) + [(False, True)]
    assert answers[-1] is None and None not in answers[:-1]


def test_a_trial_without_learning_is_played_by_the_frozen_policy(monkeypatch):
    learner, env = build(settings(net={"max_rules": 1}, maze={"max_steps": 600}))
    play(env, learner)
    explored, act = [], learner.act
    monkeypatch.setattr(learner, "act", lambda x, explore: explored.append(explore) or act(x))
    play(env, learner, learn=False, explore=False)
    assert explored[:15] == [0] * 15
    assert [e for e in explored if e][:4] == [1, 3, 7, 15]  # always at the only rule


def test_short_trials_without_the_goal_leave_the_errors_of_the_value_bounded():
    learner, env = build(settings(seed=4, maze={"max_steps": 60}))
    errors = [play(env, learner)[0].statistics["learning/error_rms"] for _ in range(40)]
    assert max(errors) < 3


# --------------------------------------------------------------------------------------- a run


def test_the_table_holds_every_trial_to_the_last_bit(options):
    config = settings(trials=3)
    run = training.train(config, options)
    agent, env = build(config)
    rows = rows_of(run)
    assert [int(row["trial"]) for row in rows] == [1, 2, 3]
    for row in rows:
        record, _ = play(env, agent)
        for name, value in record.row().items():
            if name not in ("trial", "total_steps"):
                assert row[name] == str(value), name
    assert int(rows[-1]["total_steps"]) == sum(int(row["steps"]) for row in rows)


def test_table_and_curves_agree(options):
    run = training.train(settings(trials=3), options)
    curve = scalars(run)["1_result/steps"]
    assert curve == [(int(row["trial"]), float(row["steps"])) for row in rows_of(run)]


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_equal_seeds_give_equal_runs(agent, tmp_path, same_run):
    runs = [training.train(settings(agent), quick_options(tmp_path / name)) for name in "ab"]
    same_run(*runs)


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_other_seeds_give_other_runs(agent, options):
    ends = [end_of(training.train(settings(agent, seed=seed), options)) for seed in (0, 1)]
    assert not equal(ends[0]["env"]["physics"], ends[1]["env"]["physics"])
    assert not equal(ends[0]["agent"]["net"], ends[1]["agent"]["net"])


def test_learner_and_maze_draw_different_numbers():
    agent, env = build(settings())
    assert agent.rng.random(4).tolist() != env.unwrapped.np_random.random(4).tolist()


def test_the_generators_of_the_process_have_no_influence(tmp_path, same_run):
    runs = []
    for seed in (1, 2):
        random.seed(seed)
        np.random.seed(seed)
        torch.manual_seed(seed)
        runs.append(training.train(settings(), quick_options(tmp_path / str(seed))))
    same_run(*runs)


@pytest.mark.parametrize("agent", ["sga", "q"])
def test_the_number_of_threads_has_no_influence_without_replay(agent, tmp_path, same_run):
    parts = {"net": {"grid": (16, 16, 8)}, agent: {"replays": 0, "replay_every": 0}}  # 2048 rules
    config = settings(agent, "fixed", trials=2, **parts)
    for threads in (1, 4):
        options = quick_options(tmp_path, name=str(threads), threads=threads)
        assert doomed.finish(doomed.start(config, options, tmp_path / str(threads))) == 0
    same_run(tmp_path / "1", tmp_path / "4")


def test_tiny_numbers_count_as_zero_in_training_only():
    def tiny() -> float:
        return (torch.tensor(1e-30) * 1e-10).item()

    assert tiny() > 0
    with arithmetic(), arithmetic():
        assert tiny() == 0
    assert tiny() > 0


def test_a_resume_with_other_threads_says_so(options, capsys):
    run = training.train(settings(trials=2), options)
    training.resume(run, dataclasses.replace(options, threads=2), trials=3)
    torch.set_num_threads(1)
    assert "threads was 1, is 2" in capsys.readouterr().err
    earlier = json.loads((run / "config.json").read_text())["earlier"]
    assert [session["versions"]["threads"] for session in earlier] == ["1"]


def test_more_trials_go_on_as_one_longer_run(tmp_path):
    short = training.train(settings(trials=3), quick_options(tmp_path / "a"))
    training.resume(short, quick_options(tmp_path / "a"), trials=5)
    long = training.train(settings(trials=5), quick_options(tmp_path / "b"))
    assert equal(end_of(short), end_of(long))
    assert (short / "trials.csv").read_bytes() == (long / "trials.csv").read_bytes()
    assert load_config(short).trials == 5


def test_a_finished_run_is_left_alone(options, capsys):
    run = training.train(settings(trials=2), options)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    assert training.resume(run, options) == run
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before
    assert "--trials" in capsys.readouterr().err


def test_fewer_trials_than_done_are_refused(options):
    run = training.train(settings(trials=3), options)
    with pytest.raises(ValueError, match="has 3 trials already"):
        training.resume(run, options, trials=2)


def test_checkpoints_come_and_go(tmp_path):
    options = quick_options(tmp_path, checkpoint_every=1, keep=2)
    run = training.train(settings(trials=4), options)
    assert sorted(path.name for path in run.glob("*.pt")) == ["checkpoint-3.pt", "checkpoint-4.pt"]


def test_the_best_ten_trials_are_kept(options, monkeypatch):
    steps = [100 - trial if trial <= 12 else 110 for trial in range(1, 15)]
    real, played = training.play, iter(steps)

    def scripted(*arguments, **keywords):
        record, path = real(*arguments, **keywords)
        return dataclasses.replace(record, success=True, steps=next(played)), path

    monkeypatch.setattr(training, "play", scripted)
    run = training.train(settings(trials=14), options)
    best = checkpoint.load(run / "best.pt")
    assert best["trial"] == 12 and best["best"] == [10, -sum(steps[2:12])]
    assert end_of(run)["best"] == best["best"]


def test_names_of_runs_are_never_taken_twice(options):
    runs = [training.train(settings(trials=1), options) for _ in range(3)]
    base = "sga-sofnn-estimated-s0"
    assert [run.name for run in runs] == [base, f"{base}-2", f"{base}-3"]


def test_a_given_name_is_never_overwritten(options):
    options = dataclasses.replace(options, name="mine")
    run = training.train(settings(trials=1), options)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    with pytest.raises(ValueError, match=r"exists.*--resume"):
        training.train(settings(trials=1), options)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


def test_settings_are_there_before_the_first_trial(options, monkeypatch):
    seen = []

    def look(*_, **__):
        seen.extend(path.name for path in (options.runs / "sga-sofnn-estimated-s0").iterdir())
        raise RuntimeError("enough")

    monkeypatch.setattr(training, "play", look)
    with pytest.raises(RuntimeError, match="enough"):
        training.train(settings(), options)
    assert {"config.json", "checkpoint-0.pt"} <= set(seen)


@pytest.mark.parametrize(
    "change",
    [{"checkpoint_every": 0}, {"keep": 0}, {"picture_every": -1}, {"threads": 0}]
    + [{"name": name} for name in ("", ".", "..", "a/b", "/tmp", " ")],
)
def test_impossible_options_are_refused(change):
    with pytest.raises(ValueError, match=f"--{next(iter(change))}".replace("_", "-")):
        RunOptions(**change)


def test_a_hundred_mazes_leave_nothing_behind():
    config = settings()

    def live():
        env = make_env(config)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()

    live()
    process = psutil.Process()
    files, threads = process.num_fds(), threading.active_count()
    for _ in range(100):
        live()
    assert (process.num_fds(), threading.active_count()) == (files, threads)


def test_a_run_leaves_no_file_or_thread_open(options):
    training.train(settings(trials=1), options)
    process = psutil.Process()
    files, threads = process.num_fds(), threading.active_count()
    for _ in range(5):
        training.train(settings(trials=1), options)
    assert (process.num_fds(), threading.active_count()) == (files, threads)


def test_the_run_directory_holds_nothing_else(options):
    run = training.train(settings(trials=2), options)
    kinds = {name.partition("-")[0].partition(".")[0] for name in os.listdir(run)}
    assert kinds == {"config", "trials", "checkpoint", "events", "run"}
    assert os.listdir(options.runs) == [run.name]
