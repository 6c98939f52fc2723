"""Learning curves of one's own runs: which are one group, what is drawn, what is written."""

import csv
import dataclasses
import json
import re

import numpy as np
import pytest

from sofnn_torch import Config, plot
from sofnn_torch.maze.settings import MazeConfig
from sofnn_torch.pictures import figures
from sofnn_torch.runs import directory
from sofnn_torch.runs.settings import NetworkConfig


def write_run(place, steps, **settings):
    """A run directory with these steps, as a training leaves it."""
    place.mkdir(parents=True)
    config = {"config": dataclasses.asdict(Config(**settings))}
    (place / "config.json").write_text(json.dumps(config))
    rows = [f"{i},{value},{value % 7 == 0}" for i, value in enumerate(steps, 1)]
    (place / "trials.csv").write_text("\n".join(["trial,steps,success", *rows, ""]))
    return place


@pytest.fixture
def runs(tmp_path):
    for seed in range(3):
        write_run(tmp_path / f"a{seed}", [100 + seed] * 20, seed=seed, trials=20 + seed)
    write_run(tmp_path / "b", [50] * 12, agent="q", seed=0, trials=12)
    return tmp_path


def test_runs_that_differ_in_seed_and_trials_are_one_group(runs):
    groups = plot.group(plot.find([runs]))
    names = {name: [run.name for run in found] for name, found in groups.items()}
    assert names == {"sga": ["a0", "a1", "a2"], "q": ["b"]}


def test_groups_are_named_by_as_few_settings_as_tell_them_apart(tmp_path):
    for theta in (0.3, 0.4):
        net = NetworkConfig(theta=theta)
        write_run(tmp_path / f"s{theta}", [9], net=net)
        write_run(tmp_path / f"f{theta}", [9], net=net, network="fixed")
    names = set(plot.group(plot.find([tmp_path])))
    assert names == {f"{n}, net.theta {t}" for n in ("sofnn", "fixed") for t in (0.3, 0.4)}


def test_what_follows_from_another_setting_is_in_no_name(tmp_path):
    for agent in ("sga", "q"):  # whose presets have other rewards
        for theta in (0.3, 0.4):
            net = NetworkConfig(theta=theta)
            write_run(tmp_path / f"{agent}{theta}", [9], agent=agent, net=net)
    names = set(plot.group(plot.find([tmp_path])))
    assert names == {f"{agent}, net.theta {t}" for agent in ("sga", "q") for t in (0.3, 0.4)}


def test_a_map_of_ones_own_has_a_short_name(tmp_path):
    for name, row in (("a", "......"), ("b", ".....#")):
        maze = MazeConfig(layout="\n".join(["cell 0.1", ">....G", *10 * [row]]))
        write_run(tmp_path / name, [9], maze=maze)
    names = list(plot.group(plot.find([tmp_path])))
    assert len(set(names)) == 2 and all(re.fullmatch(r"maze.layout own \w{8}", n) for n in names)


def test_more_groups_than_can_be_told_apart_and_other_tasks_have_panels_of_their_own(
    tmp_path, capsys, monkeypatch
):
    for i in range(7):
        write_run(tmp_path / f"r{i}", [100 + i] * (10 + i), net=NetworkConfig(theta=0.1 * (i + 1)))
    write_run(tmp_path / "car", [120] * 9, env="MountainCar-v0")
    drawn = []
    monkeypatch.setattr(figures, "saved", lambda figure, kind: drawn.append(figure) or b"")
    monkeypatch.setattr(figures, "read_column", lambda file, _: np.full(9, 120.0))
    plot.run(plot.Options(runs=(tmp_path,), out=tmp_path / "x.png", csv=tmp_path / "x.csv"))
    car, first, second = drawn[0].axes
    assert [len(ax.get_legend().get_texts()) for ax in drawn[0].axes] == [1, 5, 2]
    assert first.get_ylim() == second.get_ylim() and first.get_xlim() == second.get_xlim()
    assert [ax.get_title() for ax in drawn[0].axes] == ["MountainCar-v0", "maze", ""]
    assert first.get_ylabel() == "steps to the goal" and car.get_ylabel() == "reward"
    said = capsys.readouterr().out
    assert said.count("mean of the last 10 trials") == 2 and "(8 runs)" in said
    groups = {row["group"] for row in csv.DictReader((tmp_path / "x.csv").open())}
    assert groups == {"sga, sofnn"} | {f"net.theta {0.1 * (i + 1)}" for i in range(7)}


def test_a_single_group_is_named_by_its_learner(tmp_path):
    assert list(plot.group([write_run(tmp_path / "x", [9])])) == ["sga, sofnn"]


def test_a_run_that_is_given_twice_is_drawn_once(runs, monkeypatch):
    monkeypatch.chdir(runs)
    found = plot.find([runs, runs / "a0", plot.Path("b")])
    assert [run.name for run in found] == ["a0", "a1", "a2", "b"]


@pytest.mark.parametrize("change", ["edited", "reduced"])
def test_a_copy_with_other_rules_is_no_further_seed(change, tmp_path):
    write_run(tmp_path / "r", [9, 8])
    copy = write_run(tmp_path / "copy", [9, 8])
    saved = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(saved | {"earlier": [{change: {}}]}))
    names = {k: [r.name for r in v] for k, v in plot.group(plot.find([tmp_path])).items()}
    assert names == {"made trained": ["r"], f"made {change}": ["copy"]}


def test_runs_without_a_trial_are_left_out_and_said(runs, capsys):
    (write_run(runs / "new", []) / "trials.csv").unlink()  # as rules --new makes it
    write_run(runs / "young", [])
    plot.run(plot.Options(runs=(runs,), out=runs / "x.png"))
    out, err = capsys.readouterr()
    assert "(4 runs)" in out
    assert (
        err == f"{runs / 'new'}: no trial yet, left out\n{runs / 'young'}: no trial yet, left out\n"
    )
    with pytest.raises(ValueError, match="no run has a trial yet"):
        plot.run(plot.Options(runs=(runs / "young",), out=runs / "y.png"))


@pytest.mark.parametrize("window", [1, 3, 100])
def test_each_point_is_the_mean_of_the_trials_until_there(window):
    values = np.random.default_rng(0).normal(size=30)
    expected = [values[max(0, i + 1 - window) : i + 1].mean() for i in range(30)]
    np.testing.assert_allclose(plot.smoothed(values, window), expected)


def test_the_picture_the_table_and_the_curves_are_written(runs, capsys):
    out, curves = runs / "curves.SVG", runs / "curves.csv"
    plot.run(plot.Options(runs=(runs,), smooth=2, out=out, csv=curves))
    said = capsys.readouterr().out
    assert said.count("written") == 2 and "(4 runs)" in said
    row = next(line for line in said.splitlines() if " sga " in line)
    assert [cell.strip() for cell in row.strip("│").split("│")] == [
        *("sga", "3", "20", "101", "100", "102")
    ]
    assert out.read_bytes()[:200].count(b"<?xml") == 1
    rows = list(csv.DictReader(curves.open()))
    assert len(rows) == 3 * 20 + 12
    assert rows[-1] == {"task": "maze", "group": "q", "run": "b", "trial": "12", "value": "50.0"}


def test_another_quantity_is_a_column_of_the_trials(runs):
    plot.run(plot.Options(runs=(runs,), quantity="success", out=runs / "x.png"))
    assert (runs / "x.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="no trial with a column 'rules'"):
        plot.run(plot.Options(runs=(runs,), quantity="rules", out=runs / "y.png"))
    assert not (runs / "y.png").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"runs": ()}, "no run: give"),
        ({"runs": ("nowhere",)}, "not a run directory"),
        ({"runs": (".",)}, "holds none"),
        ({"out": plot.Path("x.gif")}, "--out must end"),
        ({"csv": plot.Path("x.txt")}, "--csv must end"),
        ({"out": plot.Path("nowhere/x.png")}, "existing directory"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = {"runs": (write_run(tmp_path / "held" / "r", [9]),)} | options
    options["runs"] = tuple(map(plot.Path, options["runs"]))
    with pytest.raises(ValueError, match=message):
        plot.run(plot.Options(**options))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("runs", r"runs: not a run directory \(it holds runs: take one, such as runs/first\)"),
        ("runs/frist", r"runs/frist: not a run directory \(did you mean runs/first\?\)"),
        ("first", r"first: not a run directory \(did you mean runs/first\?\)"),
        ("nowhere", r"nowhere: not a run directory \(config.json: No such file or directory\)"),
    ],
)
def test_who_names_no_run_hears_which_may_be_meant(name, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "runs" / "first", [9])
    with pytest.raises(ValueError, match=f"^{message}$"):
        directory.load_config(plot.Path(name))
