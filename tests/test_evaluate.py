"""Evaluation: intervals, table, files, and one clear line for what is wrong."""

import dataclasses
import json
import math
import runpy
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from sofnn_torch import evaluate, terminal
from sofnn_torch.maze.rendering import RenderingError
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.training import RunOptions, train

MEASURES = {"collisions": 1, "subgoals": 2, "pose_error": 0.003, "pose_error_max": 0.01}
RECORD = TrialRecord(1, 500, 60, 500, 1.0, True, 100, MEASURES)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two short trials; tests must not write into it."""
    config = Config(agent="sga", network="sofnn")
    config = replace(config, trials=2, maze=replace(config.maze, max_steps=120))
    runs = tmp_path_factory.mktemp("runs")
    return train(config, RunOptions(runs=runs, picture_every=0, quiet=True))


@pytest.fixture(autouse=True)
def quick_optimum(monkeypatch):
    """The search for the optimum takes seconds and has its own tests."""
    optimum = type("Optimum", (), {"steps": 400})
    monkeypatch.setattr(evaluate, "optimal_steps", lambda plan, hold: optimum)


def call(monkeypatch, *arguments):
    """Run the command line; its exit code."""
    monkeypatch.setattr("sys.argv", ["evaluate", *map(str, arguments)])
    try:
        evaluate.main()
    except SystemExit as stop:
        return stop.code
    return 0


def test_bootstrap_interval_covers_the_true_mean_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    samples = rng.exponential(1.0, (100, 30))
    intervals = [evaluate.mean(sample) for sample in samples]
    covered = sum(e.low <= 1.0 <= e.high for e in intervals)
    assert 85 <= covered <= 99
    assert all(e.low < e.value < e.high for e in intervals)


@pytest.mark.parametrize("values", [[], [7.0], [7.0, 7.0, 7.0]])
def test_means_without_a_spread_claim_no_more_than_they_know(values):
    estimate = evaluate.mean(values)
    if values:
        assert estimate.value == 7.0
    if len(values) == 3:
        assert (estimate.low, estimate.high) == (7.0, 7.0)
    else:
        assert math.isnan(estimate.low)


def test_wilson_interval_of_nine_in_ten():
    estimate = evaluate.proportion(9, 10)  # Wilson's formula with z = 1.95996
    assert dataclasses.astuple(estimate) == pytest.approx((0.9, 0.5958, 0.9821), abs=1e-4)


def test_steps_to_the_goal_leave_out_the_trials_that_missed_it():
    records = [RECORD, replace(RECORD, steps=600), replace(RECORD, steps=20_000, success=False)]
    rows = evaluate.summarise(records, optimum=440)
    assert rows["steps_to_goal"].value == 550
    assert rows["steps_over_optimum"].value == 1.25
    assert rows["steps"].value == pytest.approx(7033.3, abs=0.1)
    assert rows["success"].value == pytest.approx(2 / 3)


def test_a_policy_that_never_arrives_still_gets_a_table(capsys):
    rows = evaluate.summarise([replace(RECORD, success=False)] * 3, optimum=440)
    evaluate.Console(width=100).print(evaluate.table(rows))
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert "500.0" in printed  # steps of all trials
    assert "mm" in printed
    assert evaluate.plain(rows["steps_to_goal"]) == {"value": None, "low": None, "high": None}


def test_the_command_prints_a_table_and_leaves_the_run_alone(
    trained, tmp_path, monkeypatch, capsys
):
    before = {p: p.read_bytes() for p in trained.iterdir()}
    results = []
    for name in ("a.json", "b.json"):
        file = tmp_path / name
        assert call(monkeypatch, trained, "--episodes", 3, "--explore", "--json", file) == 0
        results.append(file.read_text())
    assert results[0] == results[1]  # the same seed, the same trials
    table = capsys.readouterr().out
    assert "2 trials learned" in table and f"written: {file}" in table
    assert "over the kinematic optimum" in table
    data = json.loads(results[0])
    assert [trial["trial"] for trial in data["trials"]] == [1, 2, 3]
    assert data["results"]["success"]["value"] == 0
    assert data["config"]["maze"]["max_steps"] == 120
    assert {p: p.read_bytes() for p in trained.iterdir()} == before


def test_evaluation_neither_learns_nor_grows(trained):
    config, agent, _, _ = evaluate.load(trained)
    table = agent.net.table().detach().clone()
    records = evaluate.evaluate(config, agent, episodes=2, explore=True)
    assert len(records) == 2
    assert agent.net.table().shape == table.shape
    assert (agent.net.table() == table).all()


def test_the_seed_decides_the_motor_noise(trained):
    config, agent, _, _ = evaluate.load(trained)
    agent.act = lambda observation, explore: 1  # goes straight, and draws nothing
    one, again, other = (evaluate.evaluate(config, agent, 1, seed=seed) for seed in (5, 5, 6))
    assert one == again != other


def test_the_seed_decides_the_sampled_actions(trained):
    config, agent, _, _ = evaluate.load(trained)
    still = replace(config, maze=replace(config.maze, motor_noise=0.0))
    one, again, other = (
        evaluate.evaluate(still, agent, 1, explore=True, seed=seed) for seed in (5, 5, 6)
    )
    assert one == again != other


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_taken(trained, tmp_path, capsys):
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("config.json", "checkpoint-0.pt", "checkpoint-2.pt"):
        (copy / name).write_bytes((trained / name).read_bytes())
    newest = copy / "checkpoint-2.pt"
    newest.write_bytes(newest.read_bytes()[:-10])
    with pytest.raises(ValueError, match="no rule"):
        evaluate.load(copy)  # what is left has learned nothing
    (line,) = capsys.readouterr().err.splitlines()
    assert "checkpoint-2.pt: damaged" in line and "use an earlier" not in line
    assert line.endswith("; checkpoint-0.pt is used instead")


def test_a_checkpoint_file_stands_for_its_run(trained, tmp_path, monkeypatch, capsys):
    file = trained / "checkpoint-2.pt"
    lone = tmp_path / "lone.pt"
    lone.write_bytes(file.read_bytes())
    for path in (trained, file, lone):
        config, agent, used, state = evaluate.load(path)
        assert config.maze.max_steps == 120 and state["trial"] == 2 and agent.net.n_rules
        assert used == (file if path == trained else path)
    assert call(monkeypatch, lone, "--episodes", "1") == 0
    assert f"{lone}: 2 trials learned" in capsys.readouterr().out
    assert call(monkeypatch, lone, "--best") == 2
    assert "--best chooses a checkpoint of a run directory" in capsys.readouterr().err


def test_video_shows_the_maze(trained, tmp_path):
    config, agent, _, _ = evaluate.load(trained)
    config = replace(config, maze=replace(config.maze, max_steps=10))
    try:
        evaluate.write_video(tmp_path / "v.mp4", config, agent, 0, explore=False)
    except RenderingError as error:
        pytest.skip(str(error))
    frames = list(imageio.imiter(tmp_path / "v.mp4"))
    assert len(frames) == 6
    assert frames[0].std() > 10  # something is to be seen


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "not a run directory"),
        ([], "RUN is missing: Directory of the run, "),
        (["RUN", "--epsodes", "3"], "did you mean --episodes?"),
        (["RUN", "--episodes", "many"], "--episodes"),
        (["RUN", "--episodes", "0"], "--episodes must be at least 1"),
        (["RUN", "--seed", "-1"], "--seed must not be negative"),
        (["RUN", "--video", "film.avi"], ".mp4 or .gif"),
        (["RUN", "--json", "nowhere/result.json"], "not a file in an existing directory"),
        (["RUN", "--best"], "best.pt: cannot be read"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(
    trained, tmp_path, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(tmp_path)
    arguments = [trained if word == "RUN" else word for word in arguments]
    assert call(monkeypatch, *arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line


@pytest.mark.parametrize(
    ("arguments", "message"), [([], "RUN is missing"), (["nowhere"], "not a run directory")]
)
def test_the_pictures_of_the_readme_need_a_run(monkeypatch, capsys, arguments, message):
    file = Path(__file__).parents[1] / "docs" / "make_images.py"
    monkeypatch.setattr("sys.argv", [file.name, *arguments])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(file), run_name="__main__")
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and message in line


def test_a_checkpoint_of_other_settings_is_refused(trained, tmp_path, monkeypatch, capsys):
    copy = tmp_path / "run"
    copy.mkdir()
    (copy / "checkpoint-2.pt").write_bytes((trained / "checkpoint-2.pt").read_bytes())
    settings = json.loads((trained / "config.json").read_text())
    settings["config"]["net"]["theta"] = 0.7
    (copy / "config.json").write_text(json.dumps(settings))
    assert call(monkeypatch, copy) == 2
    line = capsys.readouterr().err
    assert "net.theta" in line and "train anew" not in line


@pytest.mark.parametrize(
    "framed",
    [
        "╭─ Unrecognized options ──╮\n│ Unrecognized options: --n │\n│ ─────────────────── │\n"
        "│ Perhaps you meant:       │\n│     --name STR            │\n╰─────────────────────╯\n",
        " Unrecognized options \n -------------------- \n Unrecognized options: --n \n"
        " -------------------- \n Perhaps you meant: \n     --name STR \n",
    ],
)
def test_framed_messages_become_one_line_with_any_encoding(framed):
    assert terminal._first_message(framed) == "Unrecognized options: --n; did you mean --name?"
