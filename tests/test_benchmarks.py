"""The benchmarks run to their end and compare what they say they compare."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import compiled
import growth
import learning
import mazes
import neighbours
import reduce
import tasks
import training
import zoo

from sofnn_torch.maze.settings import POSE
from sofnn_torch.network.sofnn import SOFNN


@pytest.mark.slow
def test_training_is_measured_for_both_learners_and_both_physics(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(training, "SIZES", (30,))
    monkeypatch.setattr(training, "MAX_STEPS", 40)
    out = tmp_path / "training.json"
    monkeypatch.setattr(sys, "argv", ["training.py", "--repeats", "1", "--out", str(out)])
    training.main()
    rows = json.loads(out.read_text())["training"]
    assert [(row["physics"], row["replay"], row["learner"], row["steps"]) for row in rows] == [
        ("ours", "yes", "sga", 160),
        ("ours", "yes", "q", 160),
        ("ours", "no", "sga", 160),
        ("ours", "no", "q", 160),
        ("reference", "yes", "sga", 80),
        ("reference", "yes", "q", 80),
        ("reference", "no", "sga", 80),
        ("reference", "no", "q", 80),
    ]
    measured = ("ratio", "idle learner", "minimal passes", "bare us/step", "training us/step")
    for row in rows:
        assert row["rules"] >= 30
        assert all(0 < row[name] < math.inf for name in measured)
    assert "reference" in capsys.readouterr().out  # the table


@pytest.mark.parametrize("name", ["sga", "q"])
def test_the_stand_in_for_the_learner_drives_as_it_did(name, monkeypatch):
    monkeypatch.setattr(training, "MAX_STEPS", 40)
    begin, beside = training.fresh(name, 30, None, trials=2, replay=False), []
    commands, actions, _ = training.recorded_run(begin)
    stand_in = training.scripted(begin, actions, lambda: beside.append(None))
    again, same, begun = training.recorded_run(stand_in)
    assert sum(map(len, commands)) == 80
    assert (again, same) == (commands, actions)
    assert len(beside) == len(actions) and begun.agent.net.n_rules == 30


@pytest.mark.parametrize("name", ["sga", "q"])
def test_the_measured_learner_keeps_its_number_of_rules(name):
    agent = learning.learner(name, 50)
    decide = learning.decide(agent)
    for _ in range(3):
        decide()
    assert agent.net.n_rules == 50
    assert agent.net.refused > 0


def test_the_near_rules_miss_no_more_than_the_bound():
    widths, reach = [0.06, 0.06, 0.45], 7.0
    # In single precision rounding alone would be more than the bound.
    net = SOFNN(POSE, 3, width=widths, theta=0.4, dtype=torch.float64)
    xs = torch.from_numpy(learning.states(3_000, seed=3)).double()
    for x in xs:
        net.grow(x)
    cells = neighbours.Cells(net, reach * widths[0])
    missed = neighbours.error(net, cells, xs[:200])
    assert 0 < missed < net.n_rules * math.exp(-0.5 * reach**2) / net.theta
    near = [len(cells.near(x)[0]) for x in xs[:200]]
    assert min(near) < net.n_rules
    with torch.no_grad():
        net._consequents.copy_(torch.rand(3, net.n_rules))
    torch.testing.assert_close(cells.conclude(xs[0]), net(xs[:1])[0], rtol=0, atol=1e-7)


def test_the_decision_to_compile_learns_what_the_learner_learns():
    agents = [learning.learner("sga", 200) for _ in range(2)]
    for agent in agents:
        agent.net.usage.zero_()
    xs, noise = torch.from_numpy(learning.states(20, seed=4)), agents[0].rng.bit_generator.state
    agents[0].start(xs[0].numpy())
    for x in xs[1:]:
        agents[0].step(0.5, x.numpy(), False)
    agents[1].rng.bit_generator.state = noise
    decision = compiled.Decision(agents[1])
    for i, x in enumerate(xs):
        draw = torch.tensor([agents[1].rng.standard_normal()], dtype=torch.float32)
        # Before the first decision the traces are zero: the reward changes nothing.
        decision.step(torch.tensor(0.5 * (i > 0)), x, draw)
    assert agents[0].net.traces.abs().max() > 1e-3
    for name in ("consequents", "traces", "usage"):
        torch.testing.assert_close(
            *(getattr(agent.net, name) for agent in agents), rtol=1e-4, atol=1e-6
        )


def test_small_rule_bases_are_compared_with_the_full_one_of_their_seed():
    task = {"task": "maze", "agent": "sga", "freed": 0, "on_full": 0.5, "on_own": 0.75}
    steps = {(1, 0): 500, (1, 20): 510, (2, 0): 600, (2, 20): 660}
    rows = [
        task | {"seed": seed, "asked": asked, "rules": asked or 700, "steps": n, "outcome": 1.0}
        for (seed, asked), n in steps.items()
    ]
    rows[-1]["outcome"] = 0.99
    *_, full, small = reduce.table(rows).splitlines()
    assert full == "| maze, SGA | 700 | 100.00% | 0 of 2 |  | 0 |  |"
    assert small == "| maze, SGA | 20 | 99.50% | 1 of 2 | +6.0%, +10.0% | 0 | 50.0%, 75.0% |"


def test_tasks_are_measured_to_their_steps_with_replay_and_without(tmp_path, monkeypatch, capsys):
    out, runs = tmp_path / "tasks.json", tmp_path / "runs"
    flags = ["--env", "Pendulum-v1", "--seeds", "2", "--steps", "300", "--runs", str(runs)]
    monkeypatch.setattr(sys, "argv", ["tasks.py", *flags, "--out", str(out)])
    monkeypatch.setattr(tasks, "EPISODES", 2)
    tasks.main()
    cells = json.loads(out.read_text())
    assert [cell["replay"] for cell in cells] == ["with", "without"]
    assert all(seed["steps"] == 400 for cell in cells for seed in cell["seeds"])
    # Before the second trial there is nothing to replay: both arms begin alike.
    trials = [run.read_text().splitlines() for run in sorted(runs.glob("*/trials.csv"))]
    first, second = [lines[1] for lines in trials], [lines[2] for lines in trials]
    assert first[0] == first[2] != first[1] == first[3] and len(set(second)) == 4
    printed = capsys.readouterr().out
    monkeypatch.setattr(tasks, "train", None)  # what is there is not trained again
    tasks.main()
    monkeypatch.setattr(sys, "argv", ["tasks.py", "--table", str(out)])
    tasks.main()
    table = capsys.readouterr().out.splitlines()[-4:]
    assert table == printed.splitlines()[-4:]
    assert len(table[0].split("|")) == len(table[2].split("|"))


def test_mazes_are_measured_once_and_rows_of_others_stay(tmp_path, monkeypatch, capsys):
    out, runs = tmp_path / "mazes.json", tmp_path / "runs"
    flags = ["--seeds", "2", "--trials", "2", "--max-steps", "100", "--runs", str(runs)]
    for layout, agents in (("starts", ("sga",)), ("open", ("sga", "q")), ("open", ("sga", "q"))):
        told = ["--layout", layout, "--agent", *agents, "--out", str(out)]
        monkeypatch.setattr(sys, "argv", ["mazes.py", *flags, *told])
        mazes.main()
        if layout == "open":
            monkeypatch.setattr(tasks, "train", None)  # what is there is not trained again
    rows = json.loads(out.read_text())
    assert [(row["layout"], row["agent"]) for row in rows] == [
        ("open", "sga"),
        ("open", "q"),
        ("starts", "sga"),
    ]
    assert [seed["seed"] for seed in rows[0]["seeds"]] == [0, 1]
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["mazes.py", "--table", str(out)])
    mazes.main()
    head, _, first, *_ = capsys.readouterr().out.splitlines()
    assert len(head.split("|")) == len(first.split("|")) and first.startswith(
        "| `open` | 202 | SGA"
    )


def test_misses_of_a_maze_count_in_its_share_and_not_in_its_steps():
    played = [[200] * 20, [0] * 10 + [300] * 10]
    seeds = [{"seed": s, "rules": 5 + s, "seconds": 1.0, "played": p} for s, p in enumerate(played)]
    about = {"layout": "open", "agent": "q", "trials": 3, "optimum": 202.0}
    assert mazes.row(about | {"seeds": seeds}) == (
        "`open`,202,Q,3,2,100; 50,50,200; 300,5-6,1".split(",")
    )


def test_a_row_has_an_interval_from_five_seeds_on():
    def line(count):
        seeds = [
            {"seed": s, "steps": 1, "rules": 4 + s, "seconds": 1.0, "return": float(s)}
            for s in range(count)
        ]
        cell = {"env": "CartPole-v1", "agent": "q", "replay": "with", "steps": 1_000}
        return tasks.row(cell | {"seeds": seeds})

    assert "| 1,000 | 4 | 1.5 | - | 0.0 | 4-7 |" in line(4)
    assert "| 1,000 | 5 | 2.0 | - |" not in line(5) and "| 5 | 2.0 |" in line(5)


def test_rows_that_are_not_measured_again_stay(tmp_path):
    def cell(env, replay, reward):
        seeds = [{"return": reward}]
        return {"env": env, "agent": "q", "replay": replay, "steps": 9, "seeds": seeds}

    out = tmp_path / "tasks.json"
    out.write_text(json.dumps([cell("CartPole-v1", "with", 1), cell("Other-v0", "with", 2)]))
    new = [cell("CartPole-v1", "with", 3), cell("MountainCar-v0", "without", 4)]
    returns = [c["seeds"][0]["return"] for c in tasks.merged(new, out)]
    assert returns == [4, 3, 2]


@pytest.mark.parametrize(
    ("count", "dimensions", "shape"),
    [
        (81, 2, (9, 9)),
        (90, 2, (10, 9)),
        (16, 4, (2, 2, 2, 2)),
        (130, 4, (4, 4, 3, 3)),
        (1, 6, (1,) * 6),
    ],
)
def test_a_grid_has_about_as_many_rules_as_grew(count, dimensions, shape):
    assert growth.grid(count, dimensions) == shape


def test_growth_and_grid_are_searched_alike_and_compared_on_other_seeds(monkeypatch, tmp_path):
    asked = []

    def learned(config, steps, run):
        asked.append((config.network, config.seed, config.net.width, config.net.grid))
        best = 1.0 if config.network == "sofnn" else 0.7
        near = -abs(float(run.name.split("-")[-3]) - best)  # the factor of the widths
        return {"seed": config.seed, "steps": steps, "rules": 80 + config.seed, "return": near}

    monkeypatch.setattr(growth, "learned", learned)
    row = growth.compared("MountainCar-v0", growth.Options(seeds=5))
    assert (row["sofnn"]["factor"], row["fixed"]["factor"]) == (1.0, 0.7)
    assert row["fixed"]["shape"] == (9, 9)  # 82 grew in the median
    for network in ("sofnn", "fixed"):
        seeds = [seed for name, seed, *_ in asked if name == network]
        assert seeds == [100, 101] * 4 + [0, 1, 2, 3, 4]
    assert asked[-1] == ("fixed", 4, (0.0389, 0.0389), (9, 9))
    text = growth.table([row]).splitlines()
    assert len(text) == 4 and "80-84" in text[2] and "(9 x 9)" in text[3]
    growth.draw([row], tmp_path / "growth.png")
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_of_tasks_has_the_table_of_what_was_measured():
    root = Path(__file__).parents[1]
    cells = json.loads((root / "docs" / "results" / "tasks.json").read_text())
    assert cells and tasks.table(cells) in (root / "docs" / "tasks.md").read_text()


def test_the_table_of_tuned_agents_has_values_of_few_seeds_and_intervals_of_five():
    def rows(count, value):
        return [
            {"seed": i, "ours": None if value else -200.0, "return": value - i, "seconds": 3.0 + i}
            for i in range(count)
        ]

    few, many = zoo.table({"CartPole-v1 ppo": rows(2, 0.0), "Acrobot-v1 dqn": rows(5, 9.0)}).split(
        "\n"
    )[2:]
    assert few == "| CartPole-v1 | PPO | 2 | -200.0, -200.0 (50,000) | 0.0, -1.0 (100,000) | 4 |"
    assert many.startswith("| Acrobot-v1 | DQN | 5 |  | 7.0, ") and many.endswith("(100,000) | 5 |")


@pytest.mark.parametrize("env,algorithm", zoo.ZOO)
def test_tuned_agents_of_others_learn_and_play(env, algorithm, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.setitem(zoo.STEPS, env, 20)
    monkeypatch.setattr(zoo, "EPISODES", 1)
    row = zoo.learned(algorithm, env, 3, steps=40)
    assert row["seed"] == 3 and row["ours"] is not None and np.isfinite(row["return"])
