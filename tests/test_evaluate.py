"""Evaluation: intervals, table, files, and one clear line for what is wrong."""

import dataclasses
import errno
import json
import math
import os
import runpy
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from conftest import settings

from sofnn_torch import evaluate, terminal
from sofnn_torch.maze.rendering import RenderingError
from sofnn_torch.pictures import film
from sofnn_torch.pictures.film import mp4
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
    monkeypatch.setattr(evaluate, "mean_optimum", lambda plan, hold: 400)


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


def test_the_interval_of_nine_in_ten_is_exact():
    estimate = evaluate.proportion(9, 10)
    assert dataclasses.astuple(estimate) == pytest.approx((0.9, 0.5550, 0.9975), abs=1e-4)
    for share, most in ((estimate.low, 1), (estimate.high, 9)):  # each tail is 2.5 %
        counts = [k for k in range(11) if (k >= 9) == (most == 1)] + [9] * (most == 9)
        tail = sum(math.comb(10, k) * share**k * (1 - share) ** (10 - k) for k in set(counts))
        assert tail == pytest.approx(0.025, abs=1e-9)


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
    assert evaluate.as_json(rows["steps_to_goal"]) == {"value": None, "low": None, "high": None}


def test_the_table_is_in_the_units_that_it_names(capsys):
    known = {"pose_error": 0.0123, "pose_error_max": 0.0456, "heading_error": math.pi / 8}
    rows = evaluate.summarise(
        [replace(RECORD, measures=MEASURES | {"collisions": 3} | known)] * 2, optimum=400
    )
    evaluate.Console(width=100).print(evaluate.table(rows))
    lines = [line.split("│") for line in capsys.readouterr().out.splitlines() if "│" in line]
    printed = {line[1].strip(): line[2].strip() for line in lines}
    assert printed == {
        "trials that reached the goal, %": "100.0",
        "steps to the goal": "500.0",
        "over the kinematic optimum": "1.250",
        "return": "1.00",
        "collisions per trial": "3.00",
        "position error, mean, mm": "12.30",
        "position error, largest, mm": "45.60",
        "heading error, mean, degrees": "22.50",
    }


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
        (["RUN", "--video", "mp4"], ".mp4 or .gif"),
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


def frames(count=30):
    dice = np.random.default_rng(0)
    return (dice.integers(0, 255, (64, 64, 3), np.uint8) for _ in range(count))


def test_a_film_has_all_its_frames(tmp_path):
    (tmp_path / "film.mp4").write_bytes(mp4(frames()))
    assert len(list(imageio.imiter(tmp_path / "film.mp4"))) == 30


@pytest.mark.parametrize(
    "script,message",
    [
        ("echo Unknown encoder libx264 >&2; exit 1", "ffmpeg failed (Unknown encoder libx264)"),
        ("head -c 9 >/dev/null; printf 'No space left\\nmore' >&2; exit 1", "(No space left)"),
        ("kill -9 $$", "ffmpeg failed (-9)"),
    ],
)
def test_a_film_that_cannot_be_made_says_so_in_one_line(script, message, tmp_path, monkeypatch):
    fake = tmp_path / "ffmpeg"
    fake.write_text(f"#!/bin/sh\n{script}\n")
    fake.chmod(0o755)
    monkeypatch.setattr(film.imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(fake))
    with pytest.raises(OSError) as refusal:
        mp4(frames())
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_film_without_an_encoder_says_so(monkeypatch):
    monkeypatch.setattr(film.imageio_ffmpeg, "get_ffmpeg_exe", lambda: "/no/ffmpeg")
    with pytest.raises(OSError, match="ffmpeg cannot be started"):
        mp4(frames())


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_a_film_for_a_full_disk_says_so_in_one_line(ending, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(evaluate, "film", lambda *_, **__: frames(3))
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match=r"No space left on device: '\S+/film\.\w+'"):
        evaluate.write_video(tmp_path / f"film.{ending}", settings(), None, 0, False)
    assert not list(tmp_path.iterdir())


def test_every_row_of_the_table_is_its_own_quantity_in_its_printed_unit():
    records = [
        replace(
            RECORD,
            steps=500 + 100 * late,
            measures={
                "collisions": 2 + late,
                "subgoals": 9,
                "pose_error": 0.004,
                "pose_error_max": 0.012,
                "heading_error": math.radians(3),
            },
        )
        for late in (False, True)
    ]
    records.append(replace(records[0], steps=20_000, success=False))
    view = evaluate.table(evaluate.summarise(records, optimum=440))
    names, values = ([*column.cells] for column in view.columns[:2])
    assert dict(zip(names, values, strict=True)) == {
        "trials that reached the goal, %": "66.7",
        "steps to the goal": "550.0",
        "  over the kinematic optimum": "1.250",
        "steps of all trials": "7033.3",
        "return": "1.00",
        "collisions per trial": "2.33",
        "position error, mean, mm": "4.00",
        "position error, largest, mm": "12.00",
        "heading error, mean, degrees": "3.00",
    }


@pytest.mark.parametrize(
    ("flags", "explore", "policy"), [([], False, "mean"), (["--explore"], True, "sampled")]
)
def test_the_policy_that_is_named_is_the_one_that_plays_and_is_filmed(
    trained, tmp_path, monkeypatch, capsys, flags, explore, policy
):
    played, filmed = [], []

    def frames(config, agent, seed, explore, **_):
        filmed.append((seed, explore))
        return iter([np.zeros((32, 32, 3), np.uint8)] * 2)

    def evaluated(config, agent, episodes, explore, seed, *_, **__):
        played.append((episodes, seed, explore))
        return [RECORD]

    monkeypatch.setattr(evaluate, "evaluate", evaluated)
    monkeypatch.setattr(evaluate, "film", frames)
    file = tmp_path / "result.json"
    for suffix, form in ((".MP4", b"ftyp"), (".Gif", b"GIF89a")):
        film = tmp_path / f"film{suffix}"
        words = [trained, "--seed", 4, "--episodes", 3, "--json", file, "--video", film]
        assert call(monkeypatch, *words, *flags) == 0
        assert form in film.read_bytes()[:12]
    assert played == [(3, 4, explore)] * 2 and filmed == [(4, explore)] * 2
    assert f"with {policy} actions" in capsys.readouterr().out
    result = json.loads(file.read_text())
    assert (result["policy"], result["seed"], result["trials_learned"]) == (policy, 4, 2)
    assert result["versions"]["instructions"]


def test_the_best_checkpoint_is_played_if_asked_for(trained, tmp_path):
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("config.json", "checkpoint-2.pt"):
        (copy / name).write_bytes((trained / name).read_bytes())
    (copy / "best.pt").write_bytes((trained / "checkpoint-2.pt").read_bytes())
    assert evaluate.load(copy)[2] == copy / "checkpoint-2.pt"
    assert evaluate.load(copy, best=True)[2] == copy / "best.pt"
