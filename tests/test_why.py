"""Why a policy did what it did, and what is doubtful in its rules: against hand and brute force."""

import csv
import math
import re

import numpy as np
import pytest
import torch
from conftest import quick_options, settings
from PIL import Image

from sofnn_torch import SGA, SOFNN, Config, QLearning, SGAConfig, Task, evaluate, training
from sofnn_torch.maze.robot import plan_of
from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import checks, played, why

AXES = Axis("x", "m", 0, 1), Axis("y", "m", 0, 1), Axis("heading", "rad", period=2 * math.pi)
TURNS = Task(AXES, ("right turn", "straight", "left turn"), discrete=True)
WIDTHS = [0.1, 0.1, 0.5]


def sga(*rules, task=TURNS):
    """A learner with a rule for each centre (3,) and mu."""
    inputs, outputs = SGA.layout(SGAConfig(), task)
    net = SOFNN(inputs, len(outputs), width=WIDTHS)
    for centre, mu in rules:
        net.add_rule(torch.tensor(centre), consequents=torch.tensor([mu, 0.1, 0.6]))
    return SGA(net, task, SGAConfig())


def random(kind, rules=60, seed=0, **settings):
    generator = torch.Generator().manual_seed(seed)
    settings = kind.Settings(**settings)
    inputs, outputs = kind.layout(settings, TURNS)
    net = SOFNN(inputs, len(outputs), width=WIDTHS)
    for _ in range(rules):
        x = torch.rand(3, generator=generator) * torch.tensor([1, 1, 2 * math.pi])
        net.add_rule(x, consequents=torch.randn(len(outputs), generator=generator))
    return kind(net, TURNS, settings)


# ------------------------------------------------------------------------------------------- why


def test_a_sentence_names_rules_place_and_opposition():
    east = [0.93, 0.5, 0.0]
    agent = sga((east, 1.0), ([0.93, 0.52, 0.0], 0.9), ([0.93, 0.44, 0.0], -0.9))
    reason = why.reason(agent, np.float32(east))
    text = why.sentence(agent, reason, plan_of("open"))
    assert text == (
        "turned left because rules 1 and 2, near the east wall and heading east, say so "
        "against rule 3 (right turn)."
    )
    firing = np.exp([0, -0.5 * 0.2**2, -0.5 * 0.6**2])
    shares = firing / firing.sum()
    assert reason.shares == pytest.approx(shares, rel=1e-4)
    assert reason.weights == pytest.approx(shares * [2 / 3, 0.9 - 1 / 3, -0.9 - 1 / 3], rel=1e-4)


def test_straight_is_a_compromise_where_neither_side_says_so():
    agent = sga(([0.5, 0.5, 0.7], -1.0), ([0.5, 0.5, -0.7], 1.0))
    reason = why.reason(agent, np.float32([0.5, 0.5, 0.0]))
    text = why.sentence(agent, reason, plan_of("open"))
    assert text.startswith("went straight, heading east, as a compromise")
    assert "(left turn, right turn)" in text or "(right turn, left turn)" in text


def test_numbers_are_explained_by_the_side_of_the_action():
    agent = sga(([0.5, 0.5, 0.0], -0.8), ([0.5, 0.6, 0.0], 0.4), task=Task(AXES, ("u",), False))
    reason = why.reason(agent, np.float32([0.5, 0.5, 0.0]))
    assert reason.values == pytest.approx([0.8, -0.4])
    assert "because rule 1" in why.sentence(agent, reason)
    assert "against rule 2 (u 0.40)" in why.sentence(agent, reason)


@pytest.mark.parametrize("kind", [SGA, QLearning])
def test_a_rule_is_for_an_action_where_it_would_choose_it_by_itself(kind):
    agent, rng = random(kind), np.random.default_rng(1)
    for state in rng.uniform([0, 0, -3], [1, 1, 3], (30, 3)).astype(np.float32):
        reason = why.reason(agent, state)
        alone = [vote == reason.action for vote in reason.votes]
        assert (reason.values > 0).tolist() == alone
        assert reason.shares.sum() == pytest.approx(1)


def test_rules_about_one_action_each_have_no_vote():
    agent = QLearning.for_env("CartPole-v1", coding="antecedent").learner
    agent.net.grow(torch.zeros(5))
    with pytest.raises(ValueError, match="use --at"):
        why.reason(agent, np.zeros(4, np.float32))


def test_the_nearest_wall_is_that_of_a_search_over_all_walls():
    plan, rng = plan_of("s"), np.random.default_rng(2)
    for x, y in rng.uniform(0.05, 0.95, (30, 2)):
        away, bearing = why.nearest_wall(plan, x, y)
        assert away == pytest.approx(plan.clearance(x, y))
        far = max(away + plan.robot_radius, 0)
        at = x + far * math.cos(bearing), y + far * math.sin(bearing)
        inside = [
            a - 1e-6 <= at[0] <= c + 1e-6 and b - 1e-6 <= at[1] <= d + 1e-6
            for a, b, c, d in plan.walls
        ]
        assert any(inside)
    assert [why.compass(math.radians(d)) for d in (0, 44, 91, -90, 180)] == [
        "east",
        "north-east",
        "north",
        "south",
        "west",
    ]


# ---------------------------------------------------------------------------------------- trials


def test_a_trial_is_the_one_that_evaluate_plays(few):
    _, agent, _, _, config = few
    records = evaluate.evaluate(config, agent, 3, seed=5)
    trial = played.trial(config, agent, 3, 5)
    assert (trial.record.steps, trial.record.reward) == (records[2].steps, records[2].reward)
    assert len(trial.states) == len(trial.actions) == records[2].decisions


def test_the_path_tells_each_decision(few, tmp_path, call):
    run, agent, _, _, config = few
    file = tmp_path / "path.csv"
    code, text, _ = call(run, "--path", file, "--why-trial", 2, "--seed", 7)
    assert code == 0 and "trial 2 of evaluate --seed 7" in text
    trial = played.trial(config, agent, 2, 7)
    rows = list(csv.DictReader(file.open()))
    assert [int(row["decision"]) for row in rows] == [*range(1, len(trial.states) + 1)]
    for row, state, action, info in zip(
        rows, trial.states, trial.actions, trial.infos, strict=True
    ):
        seen = np.float32([row["x_m"], row["y_m"], row["heading_rad"]])
        assert np.array_equal(seen, state)
        assert int(row["rule"]) == agent.strongest_rule(state) + 1
        assert row["action"] == config.task.actions[action]
        assert float(row["true_x_m"]) == info["true_pose"][0]
        x = torch.from_numpy(state)[None]
        assert float(row["firing"]) == pytest.approx(
            agent.net.firing_strengths(x).max().item(), rel=1e-4
        )
    assert float(rows[1]["x_m"]) != float(rows[0]["x_m"])


def test_the_command_explains_a_state_and_a_decision(few, tmp_path, call):
    run, picture = few[0], tmp_path / "spot.png"
    code, text, _ = call(run, "--why", 0.2, 0.15, 30, "--picture", picture)
    assert code == 0 and " because rule" in text and "growth threshold theta 0.4" in text
    assert Image.open(picture).size[0] > 800
    code, text, _ = call(run, "--why-trial", 1, "--decision", 2)
    assert code == 0 and "trial 1 of evaluate --seed 1000, without learning" in text
    assert "share" in text and "product" in text


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--why 0.1 0.1", "--why needs 3 numbers"),
        ("--why-trial 1", "--why-trial and --decision go together"),
        ("--decision 1", "--why-trial and --decision go together"),
        ("--why-trial 1 --decision 9999", "--decision must be at most"),
        ("--why 0.1 0.1 0 --check", "do not go together"),
        ("--path x.txt", "--path must end in .csv"),
    ],
)
def test_what_cannot_be_explained_is_one_line(few, call, flags, said):
    code, _, error = call(few[0], *flags.split())
    assert code == 2 and said in error and len(error.strip().splitlines()) == 1


# ---------------------------------------------------------------------------------------- checks


def test_the_overlap_of_two_rules_is_the_best_of_their_lesser_firing():
    agent, rng = sga(([0.4, 0.5, 3.0], 0.0), ([0.55, 0.45, -2.9], 0.0)), np.random.default_rng(3)
    pair = np.array([0]), np.array([1])
    found = checks.overlap(agent, *pair).item()
    states = rng.uniform([0.3, 0.4, 2.5], [0.7, 0.6, 3.9], (200_000, 3)).astype(np.float32)
    firing = agent.net.firing_strengths(torch.from_numpy(states)).detach().numpy()
    assert firing.min(1).max() == pytest.approx(found, abs=0.01)


def test_contradictions_are_all_near_pairs_with_opposite_votes(monkeypatch):
    monkeypatch.setattr(checks, "CHUNK", 7)
    agent = random(SGA, 60)
    mu, every = agent.net.consequents[:, 0].numpy(), np.arange(60)
    meeting, votes = checks.overlap(agent, every, every), np.digitize(mu, [-1 / 3, 1 / 3])
    pairs = [
        (a, b)
        for a in range(60)
        for b in range(a + 1, 60)
        if meeting[a, b] >= checks.OVERLAP and {votes[a], votes[b]} == {0, 2}
    ]
    found = checks.contradictions(agent, checks.leanings(agent), 3)
    assert found.count == len(pairs) > 0
    a, b = max(pairs, key=lambda pair: meeting[pair])
    assert f"rule {a + 1} " in found.examples[0] and f"rule {b + 1} " in found.examples[0]


def test_each_kind_is_found_where_it_is():
    agent = sga(
        ([0.15, 0.15, 0.0], 0.0),
        ([0.25, 0.15, 0.0], 1.0),
        ([0.25, 0.17, 0.0], -1.0),
        ([1.01, 0.5, 0.0], 0.0),
    )
    states = np.float32([[0.15, 0.15, 0.0], [0.2, 0.15, 0.0], [0.15, 0.15, 2.0]])
    found = {f.kind.partition(" ")[0]: f for f in checks.findings(agent, states, plan_of("open"))}
    assert found["pairs"].count == 1 and "rule 2" in found["pairs"].examples[0]
    assert found["rules"].kind == "rules centred in a wall or too close to one"
    assert found["rules"].examples == ("rule 4 at 1010, 500 mm",)
    assert found["gaps:"].count == 1 and "decision 3" in found["gaps:"].examples[0]
    usage = agent.usage(states) * 3
    assert checks.unused(usage, 3).count == int((usage < 0.01).sum()) == 1
    assert checks.outvoted(agent, usage, 3).count == 2


def test_another_task_is_checked_and_explained(tmp_path, call):
    config = Config(env="MountainCar-v0", agent="q", trials=1)
    run = training.train(config, quick_options(tmp_path, name="car"))
    code, text, _ = call(run, "--check")
    assert code == 0 and "gaps" in text and "wall" not in text
    picture = tmp_path / "spot.png"
    code, text, _ = call(run, "--why", -0.5, 0.01, "--picture", picture)
    assert code == 0 and re.search("chose (no )?push", text) and "position -0.50" in text
    assert Image.open(picture).size[0] > 500


def test_the_command_checks_a_run(few, call):
    code, text, _ = call(few[0], "--check")
    assert code == 0
    for kind in ("vote against each other", "outvoted", "take no part", "in a wall", "gaps"):
        assert kind in text


def test_wheels_are_explained_by_the_faster_one(tmp_path, call):
    config = settings("sga", trials=1, maze={"actions": "wheels", "max_steps": 40})
    run = training.train(config, quick_options(tmp_path, name="wheels"))
    code, text, _ = call(run, "--why", 0.15, 0.15, 0)
    assert code == 0 and "did " in text
    assert call(run, "--check")[0] == 0
