"""SGA against the closed forms of its gradients and hand-computed updates (eqs 4-8)."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sofnn_torch.learners.learner import Task
from sofnn_torch.learners.sga import SGA, SGAConfig, negative_log_likelihood
from sofnn_torch.maze.env import LEFT, RIGHT, STRAIGHT
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN

N, TAU = 3, 2 * math.pi
ADAPTIVE = {"rate_centre": 1e-3, "rate_width": 1e-3, "rate_mean": 0.05, "rate_deviation": 1e-3}


def learner(m=1, rules=30, seed=0, baseline="value", n_outputs=None, discrete=0, **settings):
    torch.manual_seed(seed)
    learned = int(baseline == "value")
    net = SOFNN(
        [Axis("x"), Axis("y"), Axis("heading", period=TAU)],
        n_outputs or 2 * m + learned,
        width=[0.3, 0.3, 1.0],
        theta=0.5,
        initial=0.3,
        block_size=8,
        dtype=torch.float64,
    )
    for _ in range(rules):
        consequents = torch.cat([torch.rand(m) - 0.5, 0.2 + torch.rand(m), torch.rand(learned)])
        centre, width = torch.rand(N) * 2 - 1, 0.2 + torch.rand(N)
        centre[2] *= math.pi
        net.add_rule(centre.double(), width.double(), consequents.double())
    names = tuple("abcdef"[: discrete or m])
    task = Task(net.axes, names, discrete=discrete > 0)
    settings = {"sigma_min": 0.03, "value_limit": None, "replays": 0} | settings
    return SGA(net, task, SGAConfig(baseline=baseline, **settings), seed)


def closed_form(net, x, action, m):
    """The gradients of ln pi by hand, in the notation of equations 4 and 5. Shape: (2n+2m, K)."""
    u, v, c = net.centres.T, net.widths.T, net.consequents.T
    difference = x[:, None] - u
    difference[2] = torch.remainder(difference[2] + math.pi, TAU) - math.pi
    firing = (-0.5 * (difference / v) ** 2).sum(0).exp()
    s = firing / firing.sum()
    gradient = torch.zeros(2 * N + 2 * m, net.n_rules, dtype=torch.float64)
    for j in range(m):
        mu, sigma = (s * c[j]).sum(), (s * c[m + j]).sum()
        by_mu = (action[j] - mu) / sigma**2
        by_sigma = ((action[j] - mu) ** 2 - sigma**2) / sigma**3
        bracket = by_mu * (c[j] - mu) + by_sigma * (c[m + j] - sigma)
        gradient[:N] += bracket * s * difference / v**2
        gradient[N : 2 * N] += bracket * s * difference**2 / v**3
        gradient[2 * N + j] = s * by_mu
        gradient[2 * N + m + j] = s * by_sigma
    return gradient


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    m=st.sampled_from([1, 2]),
    heading=st.floats(-math.pi, math.pi),
    grow=st.booleans(),
)
def test_autograd_eligibility_is_the_closed_form(seed, m, heading, grow):
    agent = learner(m, seed=seed, variance_scaled=False, baseline="constant", **ADAPTIVE)
    x = torch.tensor([0.3, -0.2, heading], dtype=torch.float64)
    if grow:
        agent.net.add_rule(x + 0.4)
    noise = np.random.default_rng(seed).standard_normal(m)
    agent.start(x.numpy())
    outputs = agent.net(x[None])[0].detach()
    action = outputs[:m] + outputs[m:] * torch.from_numpy(noise)
    expected = closed_form(agent.net, x, action, m)
    torch.testing.assert_close(agent.net.traces, expected, rtol=1e-6, atol=1e-6)


def test_variance_scaling_multiplies_each_action_by_its_variance():
    plain = learner(1, variance_scaled=False, baseline="constant", **ADAPTIVE)
    scaled = learner(1, variance_scaled=True, baseline="constant", **ADAPTIVE)
    x = np.array([0.1, 0.2, 0.3])
    plain.start(x)
    scaled.start(x)
    variance = plain.net(torch.from_numpy(x)[None])[0, 1].item() ** 2
    torch.testing.assert_close(scaled.net.traces, plain.net.traces * variance)


def test_the_learned_value_moves_no_antecedent():
    agent = learner(variance_scaled=False, **ADAPTIVE)
    x = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64)
    agent.start(x.numpy())
    mu, sigma, _ = agent.net(x[None])[0].tolist()
    action = torch.tensor([mu + sigma * np.random.default_rng(0).standard_normal()])
    torch.testing.assert_close(agent.net.traces[:-1], closed_form(agent.net, x, action, 1))
    torch.testing.assert_close(agent.net.traces[-1], agent.net.normalised_firing(x).detach())


def test_traces_accumulate_with_gamma_lambda():
    agent = learner(baseline="constant", gamma=0.9, trace_decay=0.5, sigma_max=9)
    x = np.array([0.1, 0.2, 0.3])
    agent.start(x)
    first = agent.net.traces.clone()
    agent.step(0.0, x, False)  # without reward nothing is learned: W, and so e, stay
    noise = np.random.default_rng(0).standard_normal(2)
    torch.testing.assert_close(
        agent.net.traces[-2], 0.45 * first[-2] + first[-2] * noise[1] / noise[0]
    )


def test_a_trial_begins_without_traces():
    agent = learner()
    agent.start(np.array([0.1, 0.2, 0.3]))
    x = np.array([0.4, -0.2, 0.8])
    agent.start(x)
    expected = agent.net.normalised_firing(torch.from_numpy(x)).detach()
    torch.testing.assert_close(agent.net.traces[-1], expected)


@pytest.mark.parametrize("factor", [True, False])
@pytest.mark.parametrize("terminated", [True, False])
def test_one_step_follows_equations_7_and_8(factor, terminated):
    rates = dict(ADAPTIVE, rate_mean=0.05, rate_deviation=0.002)
    agent = learner(
        baseline="constant", constant=0.25, gamma=0.99, one_minus_gamma=factor, sigma_max=9, **rates
    )
    agent.start(np.array([0.1, 0.2, 0.3]))
    before, traces = agent.net.table().detach().clone(), agent.net.traces.clone()
    agent.step(1.0, np.array([0.1, 0.2, 0.4]), terminated)
    alpha = torch.tensor([1e-3] * 6 + [0.05, 0.002])[:, None].double() * (0.01 if factor else 1)
    torch.testing.assert_close(agent.net.table().detach(), before + alpha * 0.75 * traces)


def test_rates_are_meant_for_an_action_in_its_own_unit():
    settings = {"rate_mean": 5e-4, "rate_deviation": 2e-4, "variance_scaled": False}
    agent = learner(rules=1, baseline="constant", action_range=0.1, sigma_max=9, **settings)
    agent.net.consequents[0] = torch.tensor([0.2, 0.5])
    agent.start(agent.net.centres[0].numpy().copy())
    # By hand: an action from -0.1 to 0.1, of mean 0.02 and deviation 0.05.
    noise, mean, deviation = np.random.default_rng(0).standard_normal(), 0.02, 0.05
    action = mean + deviation * noise
    mean += 5e-4 * (action - mean) / deviation**2
    deviation += 2e-4 * ((action - 0.02) ** 2 - 0.05**2) / 0.05**3
    agent.step(1.0, np.zeros(3), True)
    expected = torch.tensor([[mean, deviation]]).double() / 0.1
    torch.testing.assert_close(agent.net.consequents, expected)


def test_value_baseline_learns_by_the_td_error():
    agent = learner(gamma=0.9, rate_value=0.5)
    x, following = np.array([0.1, 0.2, 0.3]), np.array([0.4, -0.2, 0.8])
    agent.start(x)
    values = agent.net.consequents[:, -1].clone()
    s = agent.net.normalised_firing(torch.from_numpy(x)[None])[0]
    v = (s * values).sum()
    v_next = (agent.net.normalised_firing(torch.from_numpy(following)[None])[0] * values).sum()
    agent.step(0.2, following, False)
    expected = values + 0.5 * (0.2 + 0.9 * v_next - v) * s
    torch.testing.assert_close(agent.net.consequents[:, -1], expected)


def test_the_end_of_a_trial_has_no_following_value():
    agent = learner(rate_value=0.5)
    x = np.array([0.1, 0.2, 0.3])
    agent.start(x)
    before, s = (
        agent.net.consequents[:, -1].clone(),
        agent.net.normalised_firing(torch.tensor(x)[None])[0],
    )
    assert agent.step(1.0, x, True) is None
    expected = before + 0.5 * (1 - (s * before).sum()) * s
    torch.testing.assert_close(agent.net.consequents[:, -1], expected)


def test_the_factor_1_minus_gamma_is_not_for_the_value():
    agent = learner(gamma=0.9, one_minus_gamma=True, rate_value=0.5)
    x = np.array([0.1, 0.2, 0.3])
    agent.start(x)
    before, s = agent.net.consequents[:, -1].clone(), agent.net.traces[-1].clone()
    agent.step(1.0, x, True)
    expected = before + 0.5 * (1.0 - (s * before).sum()) * s
    torch.testing.assert_close(agent.net.consequents[:, -1], expected)


def single(value, **settings):
    """A learner of values alone with one rule of mu 0.2 and sigma 0.5, and the state there."""
    rates = {"rate_mean": 0.0, "rate_deviation": 0.0, "rate_value": 0.5}
    agent = learner(rules=1, gamma=0.9, **rates, **settings)
    agent.net.consequents[0] = torch.tensor([0.2, 0.5, value])
    return agent, agent.net.centres[0].numpy().copy()


BOUNDED = [(5.0, 2.0, 2.0), (1.0, 2.0, 1.0), (-1.0, 2.0, -1.0), (-5.0, 2.0, -2.0)]
BOUNDED += [(5.0, None, 5.0), (-5.0, None, -5.0)]


@pytest.mark.parametrize(("value", "limit", "counts"), BOUNDED)
def test_no_following_value_counts_for_more_than_the_limit(value, limit, counts):
    agent, x = single(value, value_limit=limit)
    agent.start(x)
    agent.step(0.2, x, False)
    error = 0.2 + 0.9 * counts - value
    assert agent.net.consequents[0, -1].item() == pytest.approx(value + 0.5 * error)
    assert agent.statistics()["learning/error_rms"] == pytest.approx(abs(error))


def test_a_trial_that_is_cut_off_ends_with_what_its_last_state_is_worth():
    agent, x, following = learner(seed=3), np.array([0.1, 0.2, 0.3]), np.array([0.4, -0.2, 0.8])
    twin = learner(seed=3)
    agent.start(x)
    twin.start(x)
    traces, dice = agent.net.traces.clone(), agent.rng.bit_generator.state
    assert agent.step(0.2, following, False, truncated=True) is None
    twin.step(0.2, following, False)
    assert torch.equal(agent.net.table(), twin.net.table())
    assert torch.equal(agent.net.traces, traces)  # no further action is chosen
    assert agent.rng.bit_generator.state == dice


def test_sigma_and_mu_stay_in_bounds():
    agent = learner(rate_mean=500, rate_deviation=500, sigma_min=0.05, sigma_max=0.7)
    x = np.array([0.1, 0.2, 0.3])
    agent.start(x)
    for k in range(50):
        agent.step((-1.0) ** k, x, False)
        c = agent.net.consequents
        assert c[:, 0].abs().max() <= 1
        assert c[:, 1].min() >= 0.05 - 1e-12
        assert c[:, 1].max() <= 0.7 + 1e-12


def test_sampled_actions_have_the_moments_of_equation_5():
    agent = learner(rules=1)
    agent.net.consequents[0, :2] = torch.tensor([0.1, 0.2])
    x = np.array([0.0, 0.0, 0.0])
    sample = np.array([agent.act(x, explore=True)[0] for _ in range(4000)])
    assert sample.mean() == pytest.approx(0.1, abs=0.015)
    assert sample.std() == pytest.approx(0.2, abs=0.01)
    assert agent.act(x)[0] == pytest.approx(0.1)


def test_the_negative_log_likelihood_is_that_of_the_normal_density():
    a, mu, sigma = torch.tensor([0.3, -1.0]), torch.tensor([0.1, 0.0]), torch.tensor([0.5, 2.0])
    expected = torch.distributions.Normal(mu, sigma).log_prob(a)
    constant = 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(-negative_log_likelihood(a, mu, sigma) - constant, expected)


@pytest.mark.parametrize(
    ("mean", "command"), [(-0.334, RIGHT), (-0.333, STRAIGHT), (0.333, STRAIGHT), (0.334, LEFT)]
)
def test_the_scalar_is_cut_into_three_actions(mean, command):
    agent = learner(rules=1, discrete=3)
    agent.net.consequents[0, 0] = mean
    assert agent.act(np.zeros(3)) == command
    assert agent.plan(np.zeros((1, 3))).choice.tolist() == [command]


@pytest.mark.parametrize("count", [2, 4, 5])
def test_any_number_of_discrete_actions_are_equal_parts_of_the_range(count):
    agent = learner(rules=1, discrete=count)
    for mean in np.linspace(-0.985, 0.985, 40):
        agent.net.consequents[0, 0] = mean
        expected = min(int((mean + 1) / 2 * count), count - 1)
        assert agent.act(np.zeros(3)) == expected
        assert agent.plan(np.zeros((1, 3))).choice.tolist() == [expected]


def test_acting_changes_nothing_and_adds_no_rule():
    agent = learner()
    before = agent.net.table().detach().clone()
    agent.act(np.array([50.0, 50.0, 0.0]), explore=True)
    torch.testing.assert_close(agent.net.table().detach(), before)


def test_a_restored_learner_continues_bit_for_bit():
    xs = np.random.default_rng(1).uniform(-1, 1, (60, 3))
    agent = learner(rules=0)
    agent.start(xs[0])
    for x in xs[1:30]:
        agent.step(0.01, x, False)
    assert agent.value != 0
    twin = learner(rules=0, seed=5)
    twin.load_state_dict(agent.state_dict())
    for x in xs[30:]:
        assert np.array_equal(agent.step(0.01, x, False), twin.step(0.01, x, False))
    assert torch.equal(agent.net.table(), twin.net.table())
    assert torch.equal(agent.net.traces, twin.net.traces)


def test_wrong_networks_and_bounds_are_refused():
    with pytest.raises(ValueError, match="outputs"):
        learner(n_outputs=5, rules=0)
    with pytest.raises(ValueError, match="sigma-min"):
        learner(sigma_min=0.5, sigma_max=0.1)


@pytest.mark.parametrize("part", ["centre", "width"])
def test_a_rate_moves_its_own_part_of_the_antecedents_alone(part):
    agent = learner(rules=5, baseline="constant", **{f"rate_{part}": 1e-3})
    before = {"centre": agent.net.centres.clone(), "width": agent.net.widths.clone()}
    agent.start(np.array([0.1, -0.2, 0.5]))
    agent.step(1.0, np.array([0.2, -0.2, 0.5]), True)
    after = {"centre": agent.net.centres, "width": agent.net.widths}
    assert [name for name in before if not torch.equal(before[name], after[name])] == [part]


def test_statistics_are_of_the_decisions_since_the_last_ones():
    agent = learner(rules=3, baseline="constant", rate_mean=0, rate_deviation=0, sigma_max=2)
    agent.net.max_rules = 3
    xs = [np.array([0.1 * i, -0.2, 0.5]) for i in range(4)]
    agent.start(xs[0])
    for x, reward in zip(xs[1:], (1.0, 2.0, 5.0), strict=True):
        agent.step(reward, x, False)
    outputs = agent.net(torch.tensor(np.array(xs))).detach()
    found = agent.statistics()
    assert found["policy/mu_mean"] == pytest.approx(outputs[:, 0].mean().item())
    assert found["policy/mu_deviation"] == pytest.approx(outputs[:, 0].numpy().std())
    assert found["policy/sigma_mean"] == pytest.approx(outputs[:, 1].mean().item())
    assert found["policy/sigma_min"] == pytest.approx(outputs[:, 1].min().item())
    assert found["learning/error_rms"] == pytest.approx(math.sqrt(30 / 3))
    assert not agent.statistics()
