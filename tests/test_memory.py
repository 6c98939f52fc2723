"""Experience replay against brute force, one decision at a time."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from test_qlearning import CODINGS
from test_qlearning import learner as q_learner
from test_sga import BOUNDED, single
from test_sga import learner as sga_learner

from sofnn_torch.learners.memory import BATCH, ReplayMemory

STATES = np.array([[0.2, -0.3, 3.1], [0.1, 0.4, -3.0], [-0.5, 0.2, 0.7], [0.6, 0.6, 1.5]])
REWARDS = [0.3, -0.2, 1.0]


def play(agent):
    """Three decisions, the last of which ends the trial."""
    actions = [agent.start(STATES[0])]
    for reward, state, over in zip(REWARDS, STATES[1:], (False, False, True), strict=True):
        actions.append(agent.step(reward, state, over))
    return actions[:-1]


@pytest.fixture
def batch():
    """Which of the three decisions the first batch of a generator of seed 0 holds."""
    return np.random.default_rng(0).integers(3, size=BATCH)


def normalised(net, x):
    """Normalised firing by a loop over rules."""
    firing = []
    for u, v in zip(net.centres.numpy(), net.widths.numpy(), strict=True):
        d = np.array(x) - u
        d[2] = (d[2] + math.pi) % (2 * math.pi) - math.pi
        firing.append(math.exp(-0.5 * ((d / v) ** 2).sum()))
    return np.array(firing) / sum(firing)


def test_the_newest_decisions_stay():
    memory = ReplayMemory({"state": 2, "reward": 0}, capacity=3)
    for i in range(5):
        memory.add([i, i + 0.5, -i])
    assert len(memory) == 3
    assert sorted(memory.rows[:, 0]) == [2, 3, 4]
    seen = memory.sample(7, np.random.default_rng(0), torch.zeros(1))
    assert seen["state"].shape == (7, BATCH, 2) and seen["reward"].shape == (7, BATCH)
    torch.testing.assert_close(seen["state"][..., 1], 0.5 - seen["reward"])


def test_every_decision_is_as_likely():
    memory, rng = ReplayMemory({"state": 1}, capacity=50), np.random.default_rng(0)
    for i in range(20):
        memory.add([i])
    drawn = memory.sample(100, rng, torch.zeros(1))["state"]
    counts = drawn.flatten().int().bincount(minlength=20)
    assert len(counts) == 20 and stats.chisquare(counts.numpy()).pvalue > 0.001


def test_a_restored_memory_continues_alike():
    one, other = (ReplayMemory({"state": 2}, capacity=4) for _ in range(2))
    for i in range(6):
        one.add([i, -i])
    other.load_state_dict(one.state_dict())
    for memory in (one, other):
        memory.add([9, 9])
    np.testing.assert_array_equal(one.rows, other.rows)
    assert one.count == other.count == 7


@pytest.mark.parametrize("rows,count", [((3, 3), 3), ((3, 2), 5), ((5, 2), 5), ((0, 2), -1)])
def test_a_state_of_another_size_is_refused(rows, count):
    memory = ReplayMemory({"state": 2}, capacity=4)
    with pytest.raises(ValueError, match="do not fit"):
        memory.load_state_dict({"rows": torch.zeros(rows), "count": count})


@pytest.mark.parametrize("gap", [0.0, 0.4])
@pytest.mark.parametrize("coding", CODINGS)
def test_q_replay_is_the_bounded_sum_of_semi_gradients(coding, gap, batch):
    rates = {"rate_state": 0.1, "rate_action": 0.2, "rate_constant": 0.3}
    agent = q_learner(coding, replays=1, gamma=0.9, value_limit=0.1, action_gap=gap, **rates)
    play(agent)
    net, rows = agent.net, agent.memory.rows
    before, length = net.consequents.numpy().copy(), net.n_outputs
    total, mass, best = np.zeros_like(before), np.zeros_like(before), []
    for i in batch:
        features, (reward, continues), ahead = np.split(rows[i], [length, length + 2])
        s = normalised(net, features[: net.n_inputs])
        value, most = s @ before @ features, []
        for at in (features[:3], ahead):
            sets = [np.concatenate([at, code, [1.0]]) for code in agent.codes.numpy()]
            most.append(max(normalised(net, f[: net.n_inputs]) @ before @ f for f in sets))
        best.append(most[1])
        error = reward + 0.9 * continues * min(most[1], 0.1) - value
        error -= gap * max(most[0] - value, 0)
        total += error * np.outer(s, features)
        mass += np.outer(s, np.abs(features))
    assert min(best) < 0.1 < max(best)
    rate = np.array([0.1] * 3 + [0.2] * (length - 4) + [0.3])
    assert [reward for reward in rows[:3, length]] == REWARDS and rows[2, length + 1] == 0
    agent.rng = np.random.default_rng(0)
    agent._replay(agent.memory, agent.settings.replays)
    np.testing.assert_allclose(
        net.consequents.numpy(), before + rate * total / np.maximum(mass, 1), rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("scaled", [True, False])
def test_sga_replay_weighs_each_decision_by_its_likelihood(m, scaled, batch):
    agent = sga_learner(
        m,
        replays=1,
        gamma=0.9,
        variance_scaled=scaled,
        rate_mean=0.5,
        rate_deviation=0.02,
        sigma_max=9,
    )
    play(agent)
    net, rows = agent.net, agent.memory.rows
    with torch.no_grad():
        net._consequents.add_(0.1 * torch.randn_like(net._consequents))  # the policy has changed
    before = net.consequents.numpy().copy()
    total, mass, ratios = np.zeros_like(before), np.zeros(net.n_rules), []
    for i in batch:
        x, a, (then, reward, continues), ahead = np.split(rows[i], [3, 3 + m, 6 + m])
        s, out = normalised(net, x), normalised(net, x) @ before
        mu, sigma, value = out[:m], out[m : 2 * m], out[-1]
        now = (np.log(sigma) + 0.5 * ((a - mu) / sigma) ** 2).sum()
        ratios.append(math.exp(then - now))
        weight = min(1.0, ratios[-1])
        error = reward + 0.9 * continues * (normalised(net, ahead) @ before[:, -1]) - value
        scale = sigma**2 if scaled else np.ones(m)
        by_mu = scale * (a - mu) / sigma**2
        by_sigma = scale * ((a - mu) ** 2 - sigma**2) / sigma**3
        total += weight * error * np.outer(s, np.concatenate([by_mu, by_sigma, [1.0]]))
        mass += weight * s
    assert min(ratios) < 1 < max(ratios)  # some count in full, some do not
    change = total / np.maximum(mass, 1)[:, None] * ([0.5] * m + [0.02] * m + [1.0])
    expected = before + change
    expected[:, :m] = expected[:, :m].clip(-1, 1)
    expected[:, m : 2 * m] = expected[:, m : 2 * m].clip(0.03, 9)
    agent.rng = np.random.default_rng(0)
    agent._replay(agent.memory, agent.settings.replays)
    np.testing.assert_allclose(net.consequents.numpy(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("value", "limit", "counts"), BOUNDED)
def test_no_following_value_counts_for_more_than_the_limit_in_replay(value, limit, counts):
    agent, x = single(0.0, replays=1, value_limit=limit)
    agent.start(x)
    agent.step(0.2, x, False, truncated=True)
    agent.net.consequents[0, -1] = value
    agent.start(x)
    error = 0.2 + 0.9 * counts - value
    assert agent.net.consequents[0, -1].item() == pytest.approx(value + 0.5 * error)


def test_sga_remembers_the_action_that_it_sampled_not_the_clipped_one():
    agent, x = single(0.0, replays=1)
    agent.net.consequents[0, 0] = 0.99
    action = agent.start(x)
    agent.step(0.0, x, True)
    sampled = 0.99 + 0.5 * np.random.default_rng(0).standard_normal()
    assert action == 1 < sampled
    assert agent.memory.rows[0, 3] == pytest.approx(sampled)


@pytest.mark.parametrize("make", [q_learner, sga_learner])
def test_replays_begin_with_the_second_trial_and_leave_the_antecedents(make):
    agent = make(replays=2)
    antecedents = agent.net.centres.clone(), agent.net.widths.clone()
    agent.start(STATES[0])  # nothing to remember yet
    before = agent.net.consequents.clone()
    agent.start(STATES[0])
    torch.testing.assert_close(agent.net.consequents, before, rtol=0, atol=0)
    agent.step(1.0, STATES[1], True)
    before = agent.net.consequents.clone()
    agent.start(STATES[0])
    assert not torch.equal(agent.net.consequents, before)
    torch.testing.assert_close((agent.net.centres, agent.net.widths), antecedents, rtol=0, atol=0)


@pytest.mark.parametrize("make", [q_learner, sga_learner])
@pytest.mark.parametrize("every", [1, 2])
def test_a_batch_is_replayed_in_the_trial_after_every_so_many_decisions(make, every, monkeypatch):
    agent, after = make(replays=0, replay_every=every), []
    monkeypatch.setattr(agent, "_replay", lambda memory, n: after.append((memory.count, n)))
    play(agent)
    decisions = agent.memory.count
    assert after == [(count, 1) for count in range(every, decisions + 1, every)]
    assert agent.statistics()["learning/replayed"] == 64 * len(after)


@pytest.mark.parametrize("make", [q_learner, sga_learner])
def test_a_copy_made_by_state_replays_alike(make):
    one, other = make(replays=3), make(replays=3, seed=1)
    play(one)
    other.load_state_dict(one.state_dict())
    assert play(one) == play(other)
    torch.testing.assert_close(one.net.table(), other.net.table(), rtol=0, atol=0)


def test_sga_needs_the_learned_baseline_to_replay():
    for replay in ({"replays": 1}, {"replays": 0, "replay_every": 1}):
        with pytest.raises(ValueError, match="baseline"):
            sga_learner(baseline="constant", **replay)


@pytest.mark.parametrize("make", [q_learner, sga_learner])
def test_learners_remember_as_many_decisions_as_they_are_told(make):
    agent = make(replays=1, memory=2)
    play(agent)
    assert len(agent.memory) == len(agent.memory.rows) == 2


@pytest.mark.parametrize("make", [q_learner, sga_learner])
@pytest.mark.parametrize("ending", ["terminated", "truncated"])
def test_only_the_end_of_the_way_is_remembered_as_an_end(make, ending):
    agent = make(replays=1)
    agent.start(STATES[0])
    agent.step(0.5, STATES[1], ending == "terminated", ending == "truncated")
    seen = agent.memory.sample(1, np.random.default_rng(0), torch.zeros(1, dtype=torch.float64))
    assert (seen["reward"] == 0.5).all()
    assert (seen["continues"] == (ending == "truncated")).all()
