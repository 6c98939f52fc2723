"""A world that changes and changes back: what is measured, and that worlds stay apart."""

import math

import numpy as np
import pytest

from sofnn_torch.maze.robot import Physics, plan_of
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies import change, peers
from sofnn_torch.studies.peers import Trial
from sofnn_torch.studies.results import read_table

GOOD, BAD = Trial(480, 50, True, 0.0), Trial(20_000, 2_000, False, 0.0)
SHORT = {"before": 1, "during": 1, "after": 1, "max_steps": 60, "workers": 1}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Without the search for the optimum, and few greedy trials."""
    monkeypatch.setattr(peers, "optimum", lambda layout: 468.0)
    monkeypatch.setattr(change, "PLAYED", 2)


def test_each_change_is_of_the_world_and_of_nothing_else():
    config = Config(agent="q")
    before = plan_of("s")
    wall, goal, wheel = (change.world(config, name).maze for name in ("wall", "goal", "wheel"))
    assert change.world(config, None) == config
    assert plan_of(goal.layout).goals == [(0.1, 0.45)] != before.goals
    moved = np.abs(np.array(plan_of(wall.layout).walls) - np.array(before.walls)).sum(0)
    assert plan_of(wall.layout).goals == before.goals and moved.max() == pytest.approx(0.06)
    assert wheel.wheel_radius_scale * 0.9 == 1 and wheel.layout == config.maze.layout
    assert len(Physics(goal.layout).plan.subgoals) == 2


def test_recovery_counts_the_trials_before_ten_good_ones():
    assert change.recovered([GOOD] * 10, "s") == 0
    assert change.recovered([BAD, GOOD, BAD] + [GOOD] * 10, "s") == 3
    assert math.isnan(change.recovered([GOOD] * 9 + [BAD], "s"))


def test_a_life_has_a_row_for_each_change_and_starts_each_from_what_was_learned():
    options = change.Options(changes=("wall", "wheel"), **SHORT)
    rows = change.lives("q-sofnn", 0, options)
    alone = change.lives("q-sofnn", 0, change.Options(changes=("wall",), **SHORT))
    assert repr(rows[0]) == repr(alone[0])  # NaN is not equal to itself
    assert [row["change"] for row in rows] == ["wall", "wheel"]
    assert rows[0]["rules"] == rows[1]["rules"] > 0
    assert rows[0]["learned"] == 0 and math.isnan(rows[0]["recovered"])


def test_finished_seeds_are_kept_and_the_page_has_every_learner(tmp_path, monkeypatch):
    options = change.Options(
        learners=("sga-sofnn", "tiles"), changes=("goal",), seeds="0", out=tmp_path, **SHORT
    )
    assert change.run(options) == 0
    first = (tmp_path / "change.csv").read_text()
    text = (tmp_path / "change.md").read_text()
    assert all(change.LEARNERS[name] in text for name in options.learners)
    assert "--learners sga-sofnn tiles --changes goal --seeds 0 --before 1" in text
    monkeypatch.setattr(change, "lives", None)  # nothing is left to do
    assert change.run(options) == 0
    assert (tmp_path / "change.csv").read_text() == first
    assert len(read_table(tmp_path / "change.csv")) == 2


def test_a_page_without_data_is_one_line(tmp_path):
    with pytest.raises(ValueError, match="no data"):
        change.run(change.Options(report_only=True, out=tmp_path))
