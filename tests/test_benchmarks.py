"""The benchmark of training runs to its end: what it compares is the same work."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import learning
import training


def test_training_is_measured_for_both_learners_and_both_physics(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(training, "SIZES", (30,))
    monkeypatch.setattr(training, "MAX_STEPS", 40)
    out = tmp_path / "training.json"
    monkeypatch.setattr(sys, "argv", ["training.py", "--repeats", "1", "--out", str(out)])
    training.main()
    rows = json.loads(out.read_text())["training"]
    assert [(row["physics"], row["learner"], row["steps"]) for row in rows] == [
        ("ours", "sga", 160),
        ("ours", "q", 160),
        ("reference", "sga", 40),
        ("reference", "q", 40),
    ]
    for row in rows:
        assert row["rules"] >= 30
        assert 0 < row["ratio"] < 1
        assert row["bare us/step"] < row["training us/step"]
    assert "reference" in capsys.readouterr().out  # the table


@pytest.mark.parametrize("name", ["sga", "q"])
def test_the_measured_learner_keeps_its_number_of_rules(name):
    agent = learning.learner(name, 50)
    decide = learning.decide(agent)
    for _ in range(3):
        decide()
    assert agent.net.n_rules == 50
    assert agent.net.refused > 0
