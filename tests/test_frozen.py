"""A frozen policy leaves loops, and is the learned one where there are none."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from test_qlearning import learner as q_learner
from test_sga import learner as sga_learner

from sofnn_torch.learners.frozen import FrozenPolicy

NORTH, EAST = np.array([0.5, 0.5, 1.6]), np.array([0.5, 0.5, 0.8])


def contradiction():
    """A Q-learner that turns left in the east and right in the north, and so for ever."""
    agent = q_learner("onehot", rules=0)
    for state, values in ((EAST, [80.0, 81.0, 82.0]), (NORTH, [82.0, 80.0, 81.0])):
        consequents = torch.tensor([0.0] * 3 + values + [0.0]).double()
        agent.net.add_rule(torch.tensor(state), torch.full((3,), 0.1).double(), consequents)
    return agent


def spy(agent, places):
    """Record how much each decision at a series of places explores."""
    explored, act = [], agent.act
    agent.act = lambda observation, explore: explored.append(explore) or act(observation, explore)
    policy = FrozenPolicy(agent)
    for place in places:
        policy.act(place)
    return explored


def test_each_decision_at_a_rule_after_the_fourth_doubles_the_chance_there():
    assert spy(contradiction(), [EAST] * 5 + [NORTH] + [EAST] * 2) == [0] * 4 + [1, 0, 3, 7]
    assert spy(contradiction(), [EAST] * 17)[-3:] == [1023] * 3


def test_the_stochastic_policy_begins_with_its_own_chance():
    agent = contradiction()
    explored, agent.act = [], lambda observation, explore: explored.append(explore)
    policy = FrozenPolicy(agent, explore=True)
    for _ in range(6):
        policy.act(EAST)
    assert explored == [1, 1, 1, 1, 2, 4]


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
    assert min(taken) > 7  # the first turns are the greedy ones
    assert np.median(taken) < 25 and max(taken) < 45


@pytest.mark.parametrize("make", [q_learner, sga_learner])
def test_a_way_without_returns_is_that_of_the_learned_policy(make):
    agent = make(rules=40)
    centres = agent.net.centres.numpy()
    ways = [c for i, c in enumerate(centres) if agent.strongest_rule(c) == i]
    assert len(ways) > 10
    policy = FrozenPolicy(agent)
    assert [policy.act(c) for c in ways] == [agent.act(c) for c in ways]


def test_a_hotter_roulette_and_a_wider_normal_density():
    agent = q_learner(temperature=0.5)
    x = np.array([0.2, -0.3, 0.5])
    values = agent.action_values(agent._tensor(x), agent._firing(agent._tensor(x))).numpy()
    chances = np.exp((values - values.max()) / 2.0)  # four times hotter
    counts = np.bincount([agent.act(x, 4) for _ in range(6000)], minlength=3)
    assert stats.chisquare(counts, 6000 * chances / chances.sum()).pvalue > 1e-3

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
