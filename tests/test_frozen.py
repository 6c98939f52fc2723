"""A frozen policy leaves loops, and is the learned one where there are none."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy import stats
from test_qlearning import learner as q_learner
from test_sga import learner as sga_learner

from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.learners.learner import Task
from sofnn_torch.maze.settings import MazeConfig
from sofnn_torch.network.axes import named

AXES = MazeConfig().axes
NORTH, EAST = np.array([0.5, 0.5, 1.6]), np.array([0.5, 0.5, 0.8])


def patient(agent):
    """With the cure for loops of the maze."""
    agent.task = dataclasses.replace(agent.task, axes=AXES, patience=15)
    return agent


def contradiction():
    """A Q-learner that turns left in the east and right in the north, and so for ever."""
    agent = patient(q_learner("onehot", rules=0))
    for state, values in ((EAST, [80.0, 81.0, 82.0]), (NORTH, [82.0, 80.0, 81.0])):
        consequents = torch.tensor([0.0] * 3 + values + [0.0]).double()
        agent.net.add_rule(torch.tensor(state), torch.full((3,), 0.1).double(), consequents)
    return agent


def watched(agent, places, **options):
    """How much each decision at a series of places explores, and the policy afterwards."""
    explored, act = [], agent.act
    agent.act = lambda observation, explore: explored.append(explore) or act(observation, explore)
    policy = FrozenPolicy(agent, **options)
    for place in places:
        policy.act(place)
    return explored, policy


def spy(agent, places):
    """How much each decision at a series of places explores."""
    return watched(agent, places)[0]


def test_after_fifteen_decisions_without_a_new_state_the_chance_doubles_rule_by_rule():
    assert spy(contradiction(), [EAST] * 18) == [0] * 15 + [1, 3, 7]
    assert spy(contradiction(), [EAST, NORTH] * 10) == [0] * 16 + [1, 1, 3, 3]
    assert spy(contradiction(), [EAST] * 28)[-5:] == [511] + [1023] * 4


def test_a_rule_keeps_its_chance_and_after_a_new_state_the_count_begins_anew():
    explored = spy(contradiction(), [EAST] * 17 + [NORTH] + [EAST] * 16)
    assert explored == [0] * 15 + [1, 3] + [0] + [3] * 14 + [7, 15]


def test_states_are_the_same_within_a_fortieth_of_the_range_of_each_input_and_whole_turns():
    agent = contradiction()
    widest = [axis.high - axis.low for axis in AXES]
    for i, near in enumerate(np.array(widest) / 40):
        step = np.eye(3)[i] * near
        still = spy(agent, [EAST + (k % 2) * 0.99 * step for k in range(20)])
        assert any(still) and not any(spy(agent, [EAST + k * 1.01 * step for k in range(20)])), i
    turned = [EAST + [0, 0, 2 * math.pi * k] for k in range(20)]
    assert any(spy(agent, turned))


def test_patience_needs_axes_with_ends():
    with pytest.raises(ValueError, match="patience needs axes"):
        Task(named(2), ("left", "right"), discrete=True, patience=15)


def test_a_plain_policy_has_no_cure():
    explored, policy = watched(contradiction(), [EAST] * 40, plain=True)
    assert explored == [0] * 40 and policy.freed == 0


def test_the_stochastic_policy_begins_with_its_own_chance():
    explored, policy = watched(contradiction(), [EAST] * 17, explore=True)
    assert explored == [1] * 15 + [2, 4] and policy.freed == 2


def test_a_loop_is_left_within_a_few_turns():
    taken = []
    for seed in range(50):
        agent, place = contradiction(), EAST
        agent.rng = np.random.default_rng(seed)
        policy, turns = FrozenPolicy(agent), 0
        while policy.act(place) == (2 if place is EAST else 0):
            place = NORTH if place is EAST else EAST
            turns += 1
            assert turns < 100
        taken.append(turns)
    assert min(taken) > 16  # the first turns are the greedy ones
    assert np.median(taken) < 35 and max(taken) < 55


@pytest.mark.parametrize("make", [q_learner, sga_learner])
def test_a_way_without_returns_is_that_of_the_learned_policy(make):
    agent = patient(make(rules=40))
    east = [EAST + [0.002 * k, 0, 0] for k in range(200)]  # 2 mm a decision along a wall
    turning = [EAST + [0, 0, 0.02 * k] for k in range(200)]
    policy = FrozenPolicy(agent)
    assert [policy.act(c) for c in east + turning] == [agent.act(c) for c in east + turning]
    assert policy.freed == 0


def test_a_hotter_roulette_and_a_wider_normal_density():
    agent = q_learner(temperature=0.5)
    x = np.array([0.2, -0.3, 0.5])
    values = agent.action_values(agent._tensor(x), agent._firing(agent._tensor(x))).numpy()
    chances = np.exp((values - values.max()) / 2.0)  # four times hotter
    counts = np.bincount([agent.act(x, 4) for _ in range(2000)], minlength=3)
    assert stats.chisquare(counts, 2000 * chances / chances.sum()).pvalue > 1e-3

    agent = sga_learner(rules=1)
    agent.net.consequents[0, :2] = torch.tensor([0.1, 0.02])
    sample = np.array([agent.act(x, 5)[0] for _ in range(4000)])
    assert sample.mean() == pytest.approx(0.1, abs=0.01)
    assert sample.std() == pytest.approx(0.1, abs=0.005)


def test_the_strongest_rule_is_the_nearest_in_widths():
    for agent in (q_learner("antecedent", rules=30), q_learner("onehot"), sga_learner()):
        x = np.array([0.4, 0.1, 3.0])
        inputs = [x] if agent.net.n_inputs == 3 else [np.append(x, a) for a in (-1, 0, 1)]
        distances = []
        for y in inputs:
            d = y - agent.net.centres.numpy()
            d[:, 2] = (d[:, 2] + math.pi) % (2 * math.pi) - math.pi
            distances.append(((d / agent.net.widths.numpy()) ** 2).sum(1))
        assert agent.strongest_rule(x) == np.min(distances, 0).argmin()
