"""Other learners in the maze: the same trials for all, a search that keeps its seeds apart."""

import json
import math

import numpy as np
import pytest

from sofnn_torch.studies import peers
from sofnn_torch.studies.peers import Options, Trial
from sofnn_torch.studies.results import read_table

GOOD, BAD = Trial(500, 60, True, 0.0), Trial(20_000, 2_000, False, 0.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Without the search for the optimum."""
    monkeypatch.setattr(peers, "optimum", lambda layout: 468.0)


def test_a_run_has_learned_after_ten_good_trials_in_a_row():
    assert math.isnan(peers.learned([GOOD] * 9 + [BAD] + [GOOD] * 9))
    assert peers.learned([BAD, GOOD, BAD] + [GOOD] * 12) == 13


def test_who_learned_at_all_is_better_and_fewer_steps_are_better():
    quick, slow = [GOOD] * 10, [BAD] * 30 + [GOOD] * 10
    never, hopeless = [BAD] * 10 + [GOOD] * 9, [BAD] * 19
    scores = [peers.score(trials) for trials in (quick, slow, never, hopeless)]
    assert scores == sorted(scores) and scores[:2] == [5_000, 605_000] and scores[2] > 1e7


def test_a_search_tries_the_best_quarter_again_and_takes_the_best_mean(monkeypatch):
    tried = []

    def learn(learner, settings, seed, options, enough):
        tried.append(seed)
        lucky = settings == first and seed == peers.FIRST
        return [GOOD] * (10 if lucky else 11 + (settings == first)), [], 0.0

    first = None
    monkeypatch.setattr(peers, "learn", learn)
    monkeypatch.setattr(peers, "score", lambda trials: float(len(trials)))
    _, tries = peers.search("tiles", Options(tries=8))
    first, before = tries[0]["settings"], len(tried)
    best, tries = peers.search("tiles", Options(tries=8))
    assert tried[before:] == [1000] * 8 + [1001] * 2 + [1002] * 2
    assert tries[0]["scores"] == [10, 12, 12] and best != first  # a lucky first try is found out


def test_every_learner_plays_and_the_page_has_a_row_for_each(tmp_path):
    options = Options(
        learners=("sga", "tiles"), seeds="0", tries=1, trials=1, max_steps=50, out=tmp_path
    )
    assert peers.run(options) == 0
    (ours, theirs), told = read_table(tmp_path / "peers.csv"), tmp_path / "peers.json"
    assert (ours["learner"], theirs["learner"]) == ("sga", "tiles")
    assert ours["trials"] == theirs["trials"] == 1
    assert len(json.loads(told.read_text())["tiles"]["tries"][0]["scores"]) == 3
    text = (tmp_path / "peers.md").read_text()
    assert all(peers.TITLES[name] in text for name in options.learners)
    assert "--learners tiles --seeds 0 --tries 1 --trials 1 --max-steps 50" in text
    assert peers.run(Options(learners=("q",), report_only=True, out=tmp_path)) == 0


@pytest.mark.parametrize(
    ("ours", "said"),
    [
        (12.0, "fewer, the goal reached"),
        (50.0, "fewer"),
        (110.0, "not clearly fewer or more"),
        (200.0, "more"),
    ],
)
def test_the_page_says_who_needs_fewer_steps(ours, said):
    spread = 0.1 * np.arange(-2, 3)
    rows = [
        {"learner": name, "steps_to_learn": size * (1 + x)}
        for name, size in (("sga", ours), ("q", ours), ("tiles", 100.0))
        for x in spread
    ]
    (text,) = peers._compared(rows)
    first = text.split("(ours): ")[1].partition(";")[0]
    assert first.startswith(f"{ours / 100:.2f} (") and first.endswith(f"), {said}")


@pytest.mark.parametrize("name", ["dqn", "ppo"])
def test_deep_learners_play_trials_of_the_maze(name):
    pytest.importorskip("stable_baselines3")
    options = Options(trials=3, decisions=30, max_steps=50)
    trials, greedy, _ = peers.learn(name, {}, 0, options)
    assert 1 <= len(trials) <= 3 and len(greedy) == peers.PLAYED
    assert all(0 < t.steps <= 10 * t.decisions for t in trials)


def test_no_data_is_one_line(tmp_path):
    with pytest.raises(ValueError, match="no data of peers"):
        peers.report(tmp_path)
