"""Q-learning against the paper's closed forms, the roulette's law and brute force (eqs 9-15)."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sofnn_torch.learners.learner import Task
from sofnn_torch.learners.qlearning import QConfig, QLearning
from sofnn_torch.maze.spaces import wheel_speeds
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN

N, TAU = 3, 2 * math.pi
CODINGS = ["scalar", "wheels", "onehot", "antecedent"]
RATES = {
    "rate_state": 0.1,
    "rate_action": 0.2,
    "rate_constant": 0.3,
    "rate_centre": 0.01,
    "rate_width": 0.02,
}


def learner(
    coding="onehot", rules=25, seed=0, segments=3, n_outputs=None, actions="three", **settings
):
    torch.manual_seed(seed)
    inputs = N + (coding == "antecedent")
    length = {"scalar": 1, "wheels": 2, "onehot": segments, "antecedent": 1}[coding]
    outputs = n_outputs or N + length + 1
    net = SOFNN(
        [Axis("x"), Axis("y"), Axis("heading", period=TAU), Axis("action")][:inputs],
        outputs,
        width=[0.3, 0.3, 1.0, 0.5][:inputs],
        theta=0.5,
        block_size=8,
        dtype=torch.float64,
    )
    for _ in range(rules):
        centre = torch.rand(inputs).double() * 2 - 1
        centre[2] *= math.pi
        net.add_rule(centre, 0.2 + torch.rand(inputs).double(), torch.randn(outputs).double())
    settings = {"value_limit": None, "replays": 0, "replay_every": 0, "action_gap": 0.0} | settings
    names = ("right", "straight", "left") if actions == "three" else ("steer",)
    task = Task(net.axes[:N], names, actions == "three", wheel_speeds)
    return QLearning(net, task, QConfig(coding=coding, segments=segments, **settings), seed)


def closed_form(net, x, features):
    """Gradient of Q by the paper's equations 14 and 15, with x_i read as a_i for c_a."""
    u, v, c = net.centres.T, net.widths.T, net.consequents.T
    difference = x[:, None] - u
    difference[2] = torch.remainder(difference[2] + math.pi, TAU) - math.pi
    firing = (-0.5 * (difference / v) ** 2).sum(0).exp()
    s = firing / firing.sum()
    f = features @ c
    q = (s * f).sum()
    centres = (1 / v) * (difference / v) * s * (f - q)
    widths = (1 / v) * (difference / v) ** 2 * s * (f - q)
    return q, torch.cat([centres, widths, s * features[:, None]])


def chosen(agent, command, x):
    """Features (x, a, 1) and network input of the action that was taken, from the command."""
    scalar = agent.representatives[command] if agent.task.discrete else float(command[0])
    if agent.coding == "onehot":
        code = [float(j == command) for j in range(agent.segments)]
    elif agent.coding == "wheels":
        code = [1 - abs(scalar) - 0.4 * scalar, 1 - abs(scalar) + 0.4 * scalar]
    else:
        code = [scalar]
    code = torch.tensor(code, dtype=torch.float64)
    state = torch.cat([x, code]) if agent.coding == "antecedent" else x
    return torch.cat([x, code, torch.ones(1).double()]), state


@pytest.mark.parametrize("coding", ["scalar", "antecedent"])
def test_the_number_that_is_drawn_in_a_segment_is_learned_from_where_three_can_be_done(coding):
    agent, drawn = learner(coding, temperature=1e6), []
    for _ in range(60):
        segment = agent.start(np.zeros(3))
        number = agent.decision[3]
        low, high = agent.edges[segment]
        assert low <= number <= high
        drawn.append(number)
    assert len(set(drawn)) == 60 and min(drawn) < -0.9 and max(drawn) > 0.9


def test_rules_that_hold_an_action_grow_where_it_was_drawn():
    agent = learner("antecedent", rules=0, temperature=1e6)
    for _ in range(20):
        agent.start(np.zeros(3))
    places = agent.net.centres[:, 3].sort().values
    assert len(places) >= 3 and not set(places.tolist()) & {-1.0, 1.0}


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    coding=st.sampled_from(CODINGS),
    heading=st.floats(-math.pi, math.pi),
)
def test_autograd_is_the_closed_form_of_equations_14_and_15(seed, coding, heading):
    actions = "three" if coding in ("onehot", "wheels") else "steer"
    agent = learner(coding, seed=seed, actions=actions, trace_limit=None, **RATES)
    x = torch.tensor([0.2, -0.3, heading], dtype=torch.float64)
    command = agent.start(x.numpy())
    features, state = chosen(agent, command, x)
    q, gradient = closed_form(agent.net, state, features)
    # The environment takes float32 actions; the learner works with the unrounded one.
    tolerance = 1e-6 if actions == "three" else 1e-5
    assert agent.value == pytest.approx(q.item(), rel=tolerance, abs=tolerance)
    torch.testing.assert_close(agent.net.traces, gradient, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("gap", [0.0, 0.4])
@pytest.mark.parametrize("greedy", [True, False])
def test_one_step_is_the_semi_gradient_update_with_the_brute_force_maximum(greedy, gap):
    agent = learner("wheels", gamma=0.9, trace_decay=0.0, trace_limit=None, action_gap=gap, **RATES)
    agent._draw = lambda values: (values.index((max if greedy else min)(values)), 0.0)
    x, following = torch.tensor([0.2, -0.3, 0.5]).double(), torch.tensor([0.3, 0.1, -2.0]).double()
    command = agent.start(x.numpy())
    features, _ = chosen(agent, command, x)
    q, gradient = closed_form(agent.net, x, features)
    here, best = (
        max(closed_form(agent.net, at, chosen(agent, j, at)[0])[0].item() for j in range(3))
        for at in (x, following)
    )
    assert (here - q.item() < 1e-9) == greedy
    before = agent.net.table().detach().clone()
    agent.step(0.5, following.numpy(), False)
    rates = [0.01] * N + [0.02] * N + [0.1] * N + [0.2] * 2 + [0.3]
    error = 0.5 + 0.9 * best - q.item() - gap * (here - q.item())
    expected = before + torch.tensor(rates).double()[:, None] * error * gradient
    torch.testing.assert_close(agent.net.table().detach(), expected)


@pytest.mark.parametrize("coding", CODINGS)
def test_the_next_action_is_chosen_where_the_antecedents_have_moved_to(coding):
    agent, seen = learner(coding, **RATES), []
    values = agent.action_values
    agent.action_values = lambda *given: seen.append(values(*given)) or seen[-1]
    following = torch.tensor([0.3, 0.1, -2.0]).double()
    agent.start(np.array([0.2, -0.3, 0.5]))
    agent.step(0.5, following.numpy(), False)
    for j in range(3):
        features, state = chosen(agent, j, following)
        q, _ = closed_form(agent.net, state, features)
        assert seen[-1][j].item() == pytest.approx(q.item(), rel=1e-9)


@pytest.mark.parametrize("rates", [{}, RATES], ids=["fixed", "learned"])
@pytest.mark.parametrize("coding", CODINGS)
def test_a_decision_counts_once_in_the_use_of_the_rules(coding, rates):
    agent = learner(coding, **rates)
    agent.start(np.zeros(3))
    for _ in range(3):
        agent.step(0.1, np.array([0.1, 0.2, 0.3]), False)
    assert agent.net.usage.sum().item() == pytest.approx(4)


def test_a_trial_that_is_cut_off_ends_with_what_its_last_state_is_worth():
    agent, twin = learner(gamma=0.9), learner(gamma=0.9)
    x, following = np.array([0.2, -0.3, 0.5]), np.array([0.3, 0.1, -2.0])
    agent.start(x)
    twin.start(x)
    traces, dice = agent.net.traces.clone(), agent.rng.bit_generator.state
    assert agent.step(0.5, following, False, truncated=True) is None
    twin.step(0.5, following, False)
    assert torch.equal(agent.net.table(), twin.net.table())
    assert torch.equal(agent.net.traces, traces)  # no further action is chosen
    assert agent.rng.bit_generator.state == dice


@pytest.mark.parametrize("beyond", [-0.1, 0.1])
def test_no_following_value_counts_for_more_than_the_limit(beyond):
    x, following = np.array([0.2, -0.3, 0.5]), np.array([0.3, 0.1, -2.0])
    other = learner()
    state = other._tensor(following)
    best = other.action_values(state, other._firing(state)).max().item()
    agent = learner(gamma=0.9, value_limit=best + beyond)
    agent.start(x)
    expected = 0.5 + 0.9 * (best + min(beyond, 0.0)) - agent.value
    agent.step(0.5, following, False)
    assert agent.statistics()["learning/error_rms"] == pytest.approx(abs(expected))


@pytest.mark.parametrize("coding", CODINGS)
def test_action_values_agree_with_rule_by_rule_sums(coding):
    agent = learner(coding)
    x = torch.tensor([0.2, -0.3, 0.5]).double()
    values = agent.action_values(x, agent._firing(x))
    for j in range(3):
        features, state = chosen(agent, j, x)
        q, _ = closed_form(agent.net, state, features)
        assert values[j].item() == pytest.approx(q.item(), rel=1e-9)


def test_the_roulette_follows_equation_11():
    agent = learner(temperature=0.7)
    values = [0.3, 1.0, -0.4]
    draws = np.bincount([agent._roulette(values) for _ in range(6000)], minlength=3)
    p = np.exp(np.array(values) / 0.7)
    assert stats.chisquare(draws, 6000 * p / p.sum()).pvalue > 1e-3


def test_the_roulette_survives_large_values():
    agent = learner(temperature=1e-3)
    assert agent._roulette([1e6, 1e6 - 1, -1e9]) == 0


@pytest.mark.parametrize("learns", [True, False])
def test_actions_are_uniform_inside_their_segment(learns):
    agent = learner("scalar", actions="steer", segments=4, temperature=1e9)
    decide = agent.start if learns else lambda x: agent.act(x, explore=1)
    sample = np.array([decide(np.zeros(3))[0] for _ in range(1000)])
    assert stats.kstest(sample, "uniform", args=(-1, 2)).pvalue > 1e-3


@pytest.mark.parametrize("learns", [True, False])
def test_points_are_the_actions_themselves_from_end_to_end(learns):
    agent = learner(actions="steer", segments=5, points=True, temperature=1e9)
    decide = agent.start if learns else lambda x: agent.act(x, explore=1)
    assert {float(decide(np.zeros(3))[0]) for _ in range(200)} == {-1.0, -0.5, 0.0, 0.5, 1.0}
    assert agent.choices == ("-1.00", "-0.50", "+0.00", "+0.50", "+1.00")
    best = np.float32(agent.representatives)[agent.plan(np.zeros((1, 3))).choice]
    assert agent.act(np.zeros(3)) == best


def test_a_scalar_action_is_drawn_inside_its_segment_also_for_three_actions():
    agent, sample = learner("scalar", temperature=1e9), []
    for _ in range(1000):
        command = agent.start(np.zeros(3))
        a = (agent.net.traces[-2, 0] / agent.net.traces[-1, 0]).item()  # gradients S a and S
        assert command == int(1.5 * (a + 1))
        sample.append(a)
    assert stats.kstest(sample, "uniform", args=(-1, 2)).pvalue > 1e-3


def test_the_first_rule_is_that_of_going_straight():
    agent = learner("antecedent", rules=0)
    agent.start(np.array([0.1, 0.2, 0.3]))
    assert agent.net.centres[0].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.0])


def test_a_linear_scalar_action_never_prefers_the_middle():
    for seed in range(30):
        agent = learner("scalar", seed=seed)
        assert agent.act(np.array([0.1, 0.2, 0.3])) != 1


@pytest.mark.parametrize("coding", ["onehot", "wheels", "antecedent"])
def test_other_codings_can_prefer_the_middle(coding):
    agents = [learner(coding, seed=seed) for seed in range(40)]
    assert 1 in [agent.act(np.array([0.1, 0.2, 0.3])) for agent in agents]


@pytest.mark.parametrize("cut", [True, False])
def test_traces_decay_by_gamma_lambda_and_are_cut_at_other_than_greedy_actions(cut):
    agent = learner(temperature=1e6, trace_decay=0.9, gamma=0.8, trace_cut=cut, trace_limit=None)
    x = np.array([0.1, 0.2, 0.3])
    agent.start(x)
    for _ in range(40):
        before = agent.net.traces.clone()
        agent.step(0.0, x, False)
        s = agent.net.normalised_firing(torch.from_numpy(x)[None])[0]
        carried = agent.net.traces[-1] - s  # the row of c always has the gradient S
        kept = 0.0 if cut and not agent._log["greedy"][-1] else 0.72
        torch.testing.assert_close(carried, kept * before[-1])
    assert len(set(agent._log["greedy"])) == 2


def test_traces_stay_within_their_limit():
    agent = learner(rules=1, trace_decay=1.0, gamma=1.0, trace_cut=False, trace_limit=1.0)
    agent.start(np.zeros(3))
    for _ in range(10):
        agent.step(0.0, np.zeros(3), False)
    assert agent.net.traces[-1].max() == 1.0


def test_a_trial_begins_without_traces():
    agent, x = learner(), np.array([0.4, -0.2, 0.8])
    agent.start(np.array([0.1, 0.2, 0.3]))
    agent.start(x)
    expected = agent.net.normalised_firing(torch.from_numpy(x)).detach()
    torch.testing.assert_close(agent.net.traces[-1], expected)


@pytest.mark.parametrize("coding", ["onehot", "antecedent"])
def test_a_grown_learner_restores_bit_for_bit(coding):
    xs = np.random.default_rng(1).uniform(-1, 1, (60, 3))
    agent = learner(coding, rules=0, rate_constant=0.1)
    agent.start(xs[0])
    for x in xs[1:30]:
        agent.step(-1.0, x, False)
    assert agent.value != 0
    twin = learner(coding, rules=0, seed=4, rate_constant=0.1)
    twin.load_state_dict(agent.state_dict())
    for x in xs[30:]:
        assert agent.step(-1.0, x, False) == twin.step(-1.0, x, False)
    assert torch.equal(agent.net.table(), twin.net.table())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_outputs": 5}, "outputs"),
        ({"coding": "onehot", "segments": 4}, "needs a network with 3 inputs and 7 outputs"),
        ({"temperature": 0.0}, "temperature"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        learner(**settings)


@pytest.mark.parametrize("part", ["centre", "width"])
def test_a_rate_moves_its_own_part_of_the_antecedents_alone(part):
    agent = learner(rules=5, **{f"rate_{part}": 1e-3})
    before = {"centre": agent.net.centres.clone(), "width": agent.net.widths.clone()}
    agent.start(np.array([0.1, -0.2, 0.5]))
    agent.step(1.0, np.array([0.2, -0.2, 0.5]), True)
    after = {"centre": agent.net.centres, "width": agent.net.widths}
    assert [name for name in before if not torch.equal(before[name], after[name])] == [part]


def test_statistics_are_of_the_decisions_since_the_last_ones():
    agent = learner(rules=3, temperature=1e3)  # all actions about as likely
    greedy, values = [], []

    def note(x):
        with torch.no_grad():
            firing = agent.net.normalised_firing(torch.from_numpy(x))
            worth = agent.action_values(torch.from_numpy(x), firing).tolist()
        values.append(agent.value)
        greedy.append(agent.value == pytest.approx(max(worth)))

    agent.rates.zero_()
    agent.net.max_rules = 3
    xs = [np.array([0.1 * i, -0.2, 0.5]) for i in range(30)]
    agent.start(xs[0])
    note(xs[0])
    for x in xs[1:]:
        agent.step(1.0, x, False)
        note(x)
    found = agent.statistics()
    assert 0 < sum(greedy) < 30
    assert found["policy/greedy_share"] == pytest.approx(sum(greedy) / 30)
    assert found["policy/value_mean"] == pytest.approx(sum(values) / 30, rel=1e-5)
    assert found["policy/value_max"] == pytest.approx(max(values), rel=1e-5)
    assert not agent.statistics()


def test_the_values_of_wheels_are_named_by_the_wheels_that_they_belong_to():
    agent = learner("wheels")
    names = [output.name for output in agent.outputs]
    right, straight, left = (
        dict(zip(names[N:], code.tolist(), strict=False)) for code in agent.codes
    )
    assert names[N:] == ["c wheel left", "c wheel right", "c"]
    assert right["c wheel left"] > right["c wheel right"]
    assert straight["c wheel left"] == straight["c wheel right"]
    assert left["c wheel left"] < left["c wheel right"]
