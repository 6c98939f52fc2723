"""The preset ``paper`` is the paper, and learners are made as the settings say."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from conftest import settings

from sofnn_torch.runs import presets
from sofnn_torch.runs.directory import flatten
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.settings import Config, MazeConfig, from_dict
from sofnn_torch.tasks.env import Spaces, look
from sofnn_torch.tasks.known import TUNED

# Section 5, as printed; a decay of 1 is equation 6, of 0 are equations 12-15.
PRINTED = {
    "sga": {
        "sga.gamma": 0.99,
        "sga.trace_decay": 1.0,
        "sga.rate_mean": 0.05,
        "sga.rate_deviation": 0.001,
        "sga.rate_centre": 0.001,
        "sga.rate_width": 0.001,
        "sga.one_minus_gamma": True,
        "maze.goal_reward": 1.0,
        "maze.collision_reward": -0.0001,
    },
    "q": {
        "q.gamma": 0.99,
        "q.trace_decay": 0.0,
        "q.temperature": 0.05,
        "q.rate_state": 0.1,
        "q.rate_action": 0.1,
        "q.rate_constant": 0.1,
        "q.rate_centre": 0.001,
        "q.rate_width": 0.001,
        "maze.goal_reward": 100.0,
        "maze.collision_reward": -0.1,
    },
    "both": {
        "maze.subgoal_reward": 0.5,
        "maze.step_reward": 0.0,
        "maze.hold": 10,
        "maze.max_steps": 20_000,
        "maze.motor_noise": 0.1,
        "net.grid": [12, 12, 8],
        "pose": "estimated",
    },
}
# Where the paper is silent: docs/paper.md.
READ = {
    "sga": {
        "sga.baseline": "constant",
        "sga.constant": 0.0,
        "sga.variance_scaled": False,
        "sga.sigma_initial": 0.3,
        "sga.value_limit": None,
        "sga.replays": 0,
    },
    "q": {
        "q.coding": "antecedent",
        "q.trace_cut": False,
        "q.trace_limit": None,
        "q.value_limit": None,
        "q.initial": 0.0,
        "q.replays": 0,
        "q.replay_every": 0,
    },
    "both": {
        "net.theta": 0.5,
        "net.growth": "rule",
        "net.width_position": 0.06,
        "net.width_heading": 0.45,
        "net.grid_action": 8,
        "maze.dead_reckoning": "literal",
        "maze.actions": "three",
    },
}


@pytest.mark.parametrize("numbers", [PRINTED, READ], ids=["printed", "read"])
@pytest.mark.parametrize("network", ["sofnn", "fixed"])
@pytest.mark.parametrize("agent", ["sga", "q"])
def test_the_preset_paper_has_the_numbers_of_the_paper(agent, network, numbers):
    config = flatten(asdict(Config(agent=agent, network=network, preset="paper")))
    expected = numbers[agent] | numbers["both"]
    assert {name: config[name] for name in expected} == expected


@pytest.mark.parametrize(("agent", "rules"), [("sga", 1152), ("q", 9216)])
def test_the_fixed_networks_have_as_many_rules_as_in_the_paper(agent, rules):
    assert make_agent(Config(agent=agent, network="fixed", preset="paper")).net.n_rules == rules


@pytest.mark.parametrize("seed", [0, 7])
@pytest.mark.parametrize("agent", ["sga", "q"])
def test_the_seed_of_the_settings_is_that_of_the_learner(agent, seed):
    expected = np.random.default_rng(seed).random(4)
    assert (make_agent(settings(agent, seed=seed)).rng.random(4) == expected).all()


def test_an_unknown_state_keeps_its_initial_value_where_the_policy_is_interpolated():
    net = make_agent(settings("sga", net={"interpolate": True})).net
    net.add_rule(torch.zeros(3), consequents=torch.tensor([0.5, 0.2, 0.1]))
    net.add_rule(torch.ones(3))
    assert net.consequents[1].tolist() == pytest.approx([0.5, 0.2, 0.65])


@pytest.mark.parametrize(
    ("agent", "network", "theta", "widths"),
    [
        ("sga", "sofnn", 0.4, (0.06, 0.45)),
        ("q", "sofnn", 0.3, (0.045, 0.4)),
        ("sga", "fixed", 0.4, (0.042, 0.39)),  # half of 1 m / 12 and of a turn / 8
        ("q", "fixed", 0.3, (0.042, 0.39)),
    ],
)
def test_the_sets_of_the_default_are_those_that_the_documents_print(agent, network, theta, widths):
    net = Config(agent=agent, network=network).net
    assert (net.theta, net.width_position, net.width_heading) == (theta, *widths)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("guarded", ("slide", "inside")),
        ("still", ("still", "inside")),
        ("literal", ("literal", "first")),
    ],
)
def test_a_run_from_before_the_infrared_sensors_is_told_what_it_was_told(old, new):
    data = asdict(Config())
    for name in ("bumps", "infrared_noise", "landmarks", "right_angles"):
        del data["maze"][name]
    maze = from_dict(data | {"maze": data["maze"] | {"dead_reckoning": old}}).maze
    assert (maze.dead_reckoning, maze.landmarks) == new
    assert maze.bumps == "contact" and not maze.right_angles
    assert from_dict(asdict(Config())) == Config()


def test_whole_numbers_beyond_all_floats_are_refused():
    with pytest.raises(ValueError, match=r"--maze.goal-reward must be a finite number"):
        MazeConfig(goal_reward=10**400)


def test_what_was_found_for_a_known_task_is_taken_by_q_learning_alone():
    tuned = {"net": {"width": (0.03,)}, "q": {"gamma": 0.9}}
    usual = Spaces(look("MountainCar-v0").axes, ("left", "right"), discrete=True)
    known = replace(usual, tuned=tuned)
    for agent, network in [("q", "sofnn"), ("q", "fixed"), ("sga", "sofnn"), ("sga", "fixed")]:
        before, after = (presets.task_tables(agent, network, found) for found in (usual, known))
        assert after["q"] == replace(before["q"], gamma=0.9)
        assert after["sga"] == before["sga"]
        growing = (agent, network) == ("q", "sofnn")  # a grid has its own widths
        assert after["net"] == (replace(before["net"], width=(0.03,)) if growing else before["net"])


@pytest.mark.parametrize("name", sorted(TUNED))
def test_what_was_found_for_a_known_task_is_a_setting_of_it(name):
    config = Config(env=name, agent="q")
    for table, values in TUNED[name].items():
        part = getattr(config, table)
        assert {k: getattr(part, k) for k in values} == dict(values)
