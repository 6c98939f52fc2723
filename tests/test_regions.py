"""What a policy can do in a region: bounds against brute force, proofs against samples."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from sofnn_torch import SGA, SOFNN, Config, QConfig, QLearning, SGAConfig, Task
from sofnn_torch.network.axes import Axis
from sofnn_torch.rules import regions
from sofnn_torch.rules.__main__ import Options, region_of

AXES = Axis("x", "m", 0, 1), Axis("y", "m", 0, 1), Axis("heading", "rad", period=2 * math.pi)
TASK = Task(AXES, ("right", "straight", "left"), discrete=True)


def learner(kind, rules=80, seed=0, **settings):
    """A learner with rules at random poses and consequents of all sizes."""
    generator = torch.Generator().manual_seed(seed)
    settings = QConfig(**settings) if kind is QLearning else SGAConfig(**settings)
    inputs, outputs = kind.layout(settings, TASK)
    net = SOFNN(inputs, len(outputs), width=[0.15, 0.15, 0.6] + [0.3] * (len(inputs) - 3))
    scale = torch.tensor([1.0, 1.0, 2 * math.pi] + [1.0] * (len(inputs) - 3))
    for _ in range(rules):
        net.add_rule(torch.rand(len(inputs), generator=generator) * scale)
    net.consequents.normal_(generator=generator).mul_(0.5)
    return kind(net, TASK, settings)


def sampled(rng, low, high, count):
    return rng.uniform(low, high, (count, 3)).astype(np.float32)


def test_firing_strengths_stay_within_their_ends_in_any_box():
    rng, agent = np.random.default_rng(0), learner(SGA)
    centres, widths = agent.net.centres.double().numpy(), agent.net.widths.double().numpy()
    for _ in range(40):
        low = rng.uniform([-0.2, -0.2, -7], [1, 1, 7])
        high = low + rng.uniform(0, [0.4, 0.4, 2 * math.pi])
        least, most = regions.strengths(low[None], high[None], centres, widths, AXES)
        inside = torch.from_numpy(rng.uniform(low, high, (500, 3)))
        strengths = agent.net.double().firing_strengths(inside).detach().numpy()
        # The ends are over the greatest upper end: their ratio to the strengths is one number.
        scale = np.exp(_log_greatest(low, high, centres, widths))
        assert (strengths <= most * scale * (1 + 1e-4)).all()
        assert (strengths >= least * scale * (1 - 1e-4)).all()


def _log_greatest(low, high, centres, widths):
    """Logarithm of the greatest strength that any rule has in a box, by clipping its centre."""
    best = -math.inf
    for u, v in zip(centres, widths, strict=True):
        for turn in range(-4, 5):
            moved = u + [0, 0, 2 * math.pi * turn]
            best = max(best, -0.5 * (((np.clip(moved, low, high) - moved) / v) ** 2).sum())
    return best


def test_the_greatest_mean_is_that_of_all_corners_of_the_weights():
    rng = np.random.default_rng(1)
    for _ in range(50):
        least = rng.uniform(0, 1, (1, 6)) * rng.integers(0, 2, 6)
        most, values = least + rng.uniform(0, 1, (1, 6)), rng.normal(size=6)
        corners = [np.where(c, most[0], least[0]) for c in itertools.product([0, 1], repeat=6)]
        expected = max((w @ values) / w.sum() for w in corners if w.sum() > 0)
        assert regions.greatest_mean(least, most, values)[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (SGA, {}),
        (SGA, {"baseline": "constant", "replays": 0}),
        (QLearning, {}),
        (QLearning, {"coding": "scalar"}),
    ],
)
def test_no_proof_is_false_and_every_example_is_true(kind, settings):
    rng, proved, shown = np.random.default_rng(2), 0, 0
    agent = learner(kind, **settings)
    for _ in range(12):
        low = rng.uniform([0, 0, -3], [0.9, 0.9, 3])
        high = low + [0.08, 0.08, 0.4]
        answers = regions.actions_within(agent, low, high, most=3000)
        taken = set(agent.plan(sampled(rng, low, high, 2000)).choice.tolist())
        for j, answer in enumerate(answers):
            if answer.possible is False:
                assert j not in taken
                proved += 1
            elif answer.possible:
                assert agent.plan(answer.example[None].astype(np.float32)).choice[0] == j
                assert (answer.example >= low - 1e-6).all() and (
                    answer.example <= high + 1e-6
                ).all()
                shown += 1
    assert proved > 6 and shown >= 12


def steering(rules=80, seed=0):
    """SGA whose action is a vector of two numbers."""
    task, generator = Task(AXES, ("speed", "turn"), False), torch.Generator().manual_seed(seed)
    net = SOFNN(AXES, len(SGA.layout(SGAConfig(), task)[1]), width=[0.15, 0.15, 0.6])
    for _ in range(rules):
        net.add_rule(torch.rand(3, generator=generator) * torch.tensor([1.0, 1.0, 2 * math.pi]))
    net.consequents[:, :2].uniform_(-1, 1, generator=generator)
    return SGA(net, task, SGAConfig())


def test_no_action_leaves_the_ends_that_were_proved_and_they_are_close():
    rng, agent = np.random.default_rng(4), steering()
    for _ in range(6):
        low = rng.uniform([0, 0, -3], [0.9, 0.9, 3])
        high = low + [0.08, 0.08, 0.4]
        actions = agent.plan(sampled(rng, low, high, 5000)).actions
        for i, found in enumerate(regions.ranges_within(agent, low, high)):
            least, greatest = actions[:, i].min(), actions[:, i].max()
            assert found.low <= min(least, found.least)
            assert found.high >= max(greatest, found.greatest)
            assert found.high - found.greatest < 0.03 and found.least - found.low < 0.03
            assert found.least < least + 0.02 and found.greatest > greatest - 0.02


def test_a_search_for_ends_that_is_given_up_has_wider_ones_but_no_wrong_ones():
    agent, (low, high) = steering(), ([0, 0, 0], [1, 1, 6])
    wide, narrow = (regions.ranges_within(agent, low, high, most)[0] for most in (1, 5000))
    assert -1 <= wide.low <= narrow.low < narrow.least < narrow.greatest < narrow.high <= wide.high


def test_ranges_are_for_vectors_and_choices_for_the_rest():
    for ask, agent in ((regions.ranges_within, learner(SGA)), (regions.actions_within, steering())):
        with pytest.raises(ValueError, match=r"vectors|discrete actions"):
            ask(agent, [0, 0, 0], [1, 1, 1])


@pytest.mark.slow
def test_a_million_states_contradict_no_proof():
    rng, agent, proofs = np.random.default_rng(3), learner(SGA, 200), 0
    for _ in range(100):
        low = rng.uniform([0, 0, -3], [0.9, 0.9, 3])
        high = low + [0.05, 0.05, 0.3]
        answers = regions.actions_within(agent, low, high)
        taken = set(agent.plan(sampled(rng, low, high, 10_000)).choice.tolist())
        impossible = {j for j, answer in enumerate(answers) if answer.possible is False}
        assert not impossible & taken
        proofs += len(impossible)
    assert proofs > 50


def test_one_rule_decides_everywhere():
    net = SOFNN(AXES, len(SGA.layout(SGAConfig(), TASK)[1]), width=0.1)
    net.add_rule(torch.zeros(3))
    net.consequents.copy_(torch.tensor([[0.9, 0.3, 0.0]]))
    answers = regions.actions_within(SGA(net, TASK, SGAConfig()), [0, 0, -4], [1, 1, 2])
    assert [answer.possible for answer in answers] == [False, False, True]


def test_a_search_that_is_given_up_decides_nothing_falsely():
    agent = learner(SGA, 80)
    answers = regions.actions_within(agent, [0, 0, 0], [1, 1, 6], most=1)
    assert {answer.possible for answer in answers} <= {True, None}


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0, 0], [1, 1], "two ends for each of 3"),
        ([0, 1, 0], [1, 0, 0], "lower one first"),
        ([0, 0, 0], [1, 1, 7], "whole turn of heading"),
        ([0, 0, -math.inf], [1, 1, 0], "finite"),
    ],
)
def test_what_is_no_region_is_one_line(low, high, message):
    with pytest.raises(ValueError, match=message):
        regions.actions_within(learner(SGA), low, high)


def test_actions_that_are_inputs_of_the_rules_are_refused():
    with pytest.raises(ValueError, match="no input of the rules"):
        regions.actions_within(learner(QLearning, coding="antecedent"), [0, 0, 0], [1, 1, 1])


def test_the_hint_for_ends_in_the_wrong_order_is_for_inputs_that_wrap():
    def asked(*within):
        options = Options(run=Path("run"), within=within)
        with pytest.raises(ValueError, match="the lower end comes first") as error:
            region_of(options, Config())
        return str(error.value)

    assert asked(0, 1, 0, 1, 170.0, -170.0).endswith("(through the seam: 170 190)")
    assert asked(0.3, 0.1, 0, 1, 0, 1).endswith("the lower end comes first")
