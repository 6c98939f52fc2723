"""Studies: arms make sound settings, runs are shared and kept, data become tables and figures."""

import dataclasses
import io
import json
import math
import sys

import numpy as np
import pytest
from PIL import Image

from sofnn_torch import cli, evaluate, training
from sofnn_torch.figures import read_column
from sofnn_torch.guard import Divergence
from sofnn_torch.reproduce import (
    __main__ as command,
)
from sofnn_torch.reproduce import (
    claims,
    collecting,
    drawing,
    report,
    results,
    robustness,
    running,
    studies,
)
from sofnn_torch.reproduce.studies import STUDIES, Times, changed, essence, settings

OPTIMUM = 468
TINY = {"trials": 3, "maze.max_steps": 40, "net.grid": (3, 3, 3)}
ARMS = [(study, arm) for study, entry in STUDIES.items() for arm in entry.arms]


def job(tmp_path, name="run", conditions=False, **changes):
    config = settings({"agent": "sga"} | TINY | changes)
    return running.Job(tmp_path / name, config, conditions)


def done(work):
    """Do a job in this process, as the child would."""
    return running.work(*running._command(work)[3:])


# ------------------------------------------------------------------------------------ studies


@pytest.mark.parametrize(("study", "arm"), ARMS)
def test_every_arm_is_a_set_of_valid_settings(study, arm):
    entries = STUDIES[study].arms[arm]
    config = settings(entries, seed=3, **TINY)
    assert config.seed == 3 and config.maze.max_steps == 40
    assert arm.startswith(f"{config.agent}-")
    reference = {"section5", "paper", "robustness"}
    own = set(entries) - {"agent", "network", "preset", "pose"}
    assert bool(own) != (study in reference or arm.endswith("-default"))


def test_a_factor_follows_the_preset():
    base, scaled = settings({"agent": "q"}), settings({"agent": "q", "net.theta": Times(0.5)})
    assert scaled == dataclasses.replace(
        base, net=dataclasses.replace(base.net, theta=base.net.theta / 2)
    )


@pytest.mark.parametrize("name", ["net.thetta", "theta", "preset.theta"])
def test_a_change_of_no_setting_is_refused(name):
    with pytest.raises((ValueError, AttributeError), match="preset|theta"):
        settings({"agent": "q", name: 1.0})


CHANGES = {"net.grid": (5, 6, 7), "q.trace_limit": None, "q.trace_cut": False, "q.initial": 0.5}
CHANGES |= {"net.growth": "input", "pose": "true", "net.theta": Times(0.123456789)}


def test_changes_are_printed_as_flags_that_mean_the_same():
    arm = {"agent": "q", "network": "fixed", "preset": "paper"} | CHANGES
    words = ["--agent", "q", "--network", "fixed", "--preset", "paper", *changed(arm).split()]
    assert cli.parse(words).config == settings(arm)


def test_settings_without_effect_do_not_make_another_run():
    same = [{}, {"sga.gamma": 0.5}, {"net.grid": (5, 5, 5)}, {"net.width_action": 0.7}]
    other = [{"q.gamma": 0.5}, {"net.theta": 0.6}, {"seed": 1}, {"trials": 9}, {"network": "fixed"}]
    keys = [essence(settings({"agent": "q"} | change)) for change in same + other]
    assert len(set(keys[: len(same)])) == 1
    assert len(set(keys)) == 1 + len(other)


# --------------------------------------------------------------------------------------- runs


def test_studies_share_equal_runs_and_leave_others_alone(tmp_path):
    changes = {"trials": 2}
    taken = tmp_path / "growth-q-rule-s0"
    taken.mkdir()  # of other settings
    jobs = running.plan(tmp_path, ["growth", "robustness"], "", [0, 1], changes)
    names = [work.path.name for work in jobs]
    assert len(set(names)) == len(names)
    assert "growth-q-rule-s0-2" in names and "growth-q-rule-s1" in names
    assert not any(name.startswith("robustness-q-sofnn") for name in names)  # has it as q-rule
    assert {work.path.name for work in jobs if work.conditions} == {
        *("growth-q-rule-s0-2", "growth-q-rule-s1", "growth-sga-rule-s0", "growth-sga-rule-s1"),
        *(f"robustness-{agent}-fixed-estimated-s{s}" for agent in ("sga", "q") for s in (0, 1)),
    }
    assert [w.path.name for w in running.plan(tmp_path, ["growth"], "sga-in", [4], {})] == [
        "growth-sga-input-s4"
    ]


def test_a_run_is_trained_and_evaluated_and_then_kept(tmp_path, monkeypatch):
    work = job(tmp_path)
    assert done(work) == 0 and work.done()
    steps = read_column(work.path / "trials.csv", "steps")
    assert len(steps) == 3
    data = json.loads((work.path / "evaluation.json").read_text())
    assert len(data["greedy"]) == len(data["sampled"]) == running.EPISODES
    config, agent, _, _ = evaluate.load(work.path)
    again = evaluate.evaluate(config, agent, running.EPISODES, True, data["seed"])
    assert data["sampled"] == [dataclasses.asdict(record) for record in again]
    monkeypatch.setattr(training, "train", None)
    monkeypatch.setattr(training, "resume", None)
    assert done(work) == 0
    assert running.find_runs(tmp_path) == {essence(work.config): work.path}
    (found,) = running.plan(tmp_path, ["section5"], "sga-sofnn-est", [0], TINY)
    assert found == dataclasses.replace(work, conditions=False) and found.done()


def test_a_killed_run_goes_on(tmp_path):
    work = job(tmp_path)
    options = training.RunOptions(tmp_path, work.path.name, quiet=True)
    training.train(dataclasses.replace(work.config, trials=2), options)
    before = (work.path / "trials.csv").read_text()
    settings_file = work.path / "config.json"
    settings_file.write_text(settings_file.read_text().replace('"trials": 2', '"trials": 3'))
    assert done(work) == 0
    after = (work.path / "trials.csv").read_text()
    assert after.startswith(before) and after.count("\n") == 4


def test_the_last_trial_is_played_again_to_the_bit(tmp_path):
    work = job(tmp_path)
    training.train(work.config, training.RunOptions(tmp_path, "run", quiet=True))
    record, path = running.last_trial(work.path)
    assert record.steps == read_column(work.path / "trials.csv", "steps")[-1]
    assert record.pose_error == read_column(work.path / "trials.csv", "pose_error")[-1]
    assert len(path.true) == record.decisions + 1


def test_a_crash_is_reported_and_the_others_finish(tmp_path, monkeypatch, capsys):
    script = "import os, pathlib, sys; p = pathlib.Path(sys.argv[1]); p.mkdir(parents=True); "
    script += "p.name == 'b' and os.abort(); (p / 'evaluation.json').write_text('')"
    monkeypatch.setattr(running, "WORK", script)
    jobs = [job(tmp_path, name) for name in "abc"]
    assert running.execute(jobs, workers=1) == 1
    assert [work.done() for work in jobs] == [True, False, True]
    assert f"failed: {tmp_path / 'b'}" in capsys.readouterr().err


def test_what_cannot_be_done_is_one_line(tmp_path, capsys):
    work = job(tmp_path)
    work.path.mkdir()
    (work.path / "config.json").write_text("{}")
    assert done(work) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_a_divergence_is_a_result(tmp_path, monkeypatch):
    def diverges(config, options):
        (options.runs / options.name).mkdir()
        raise Divergence("trial 1 diverged")

    monkeypatch.setattr(training, "train", diverges)
    work = job(tmp_path, conditions=True)
    assert done(work) == 0 and work.done()
    row = collecting._row(work.path, work.config, OPTIMUM)
    assert row["status"] == "diverged" and math.isnan(row["trials_to_learn"])
    assert (row["greedy_success"], row["greedy_steps"]) == (0, 40)


@pytest.mark.parametrize(
    ("steps", "learned"),
    [
        ([700] * 10, 10),
        ([700] * 9, math.nan),
        ([900] + [700] * 9 + [702] + [701] * 10, 21),  # 702 = 1.5 x 468 is not under it
        ([700] * 9 + [20_000] + [700] * 12, 20),
    ],
)
def test_trials_to_learn(steps, learned):
    arrived = [n < 20_000 for n in steps]
    assert collecting.trials_to_learn(steps, arrived, OPTIMUM) == pytest.approx(
        learned, nan_ok=True
    )


def test_short_trials_that_fail_are_not_learning():
    assert math.isnan(collecting.trials_to_learn([40] * 20, [False] * 20, OPTIMUM))


def test_other_conditions(tmp_path, monkeypatch):
    conditions = {"noise": {0: {"motor_noise": 0.0}}, "scatter": {1: {"start": 1.0}}}
    monkeypatch.setattr(robustness, "CONDITIONS", conditions)
    work = job(tmp_path, conditions=True)
    assert done(work) == 0
    rows = json.loads((work.path / "conditions.json").read_text())
    assert [(row["group"], row["policy"]) for row in rows] == [
        (group, policy) for group in conditions for policy in ("greedy", "sampled")
    ]
    assert {row["steps"] for row in rows} == {40}


def test_the_scattered_start_is_near_the_start_and_seeded():
    config = settings({"agent": "sga"})
    starts = []
    for seed in (1, 1, 2):
        env = robustness.changed_maze(config, {"start": 0.5}, seed)
        infos = [env.reset(seed=0)[1] for _ in range(20)]
        starts.append(np.array([info["true_pose"] for info in infos]))
        for info in infos:
            assert info["estimated_pose"] == pytest.approx(info["true_pose"], abs=1e-9)
        env.close()
    offset = np.abs(starts[0] - env.unwrapped.plan.start)
    assert (offset <= 0.5 * np.array(robustness.START_SPREAD) + 1e-9).all()
    assert (offset.max(0) > 0.3 * np.array(robustness.START_SPREAD)).all()
    assert (starts[0] == starts[1]).all() and (starts[0] != starts[2]).any()
    noisy = robustness.changed_maze(config, {"motor_noise": 0.3, "wheel_base_scale": 1.03}, 0)
    assert noisy.unwrapped.noise.level == 0.3 and noisy.unwrapped.maze is not None
    noisy.close()
