"""The network against hand-computed values, symmetry and brute force (eqs 1-3)."""

import copy
import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sofnn_torch.network import batches
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN, grid

TAU = 2 * math.pi
POSE = (
    Axis("x", "m", 0, 1),
    Axis("y", "m", 0, 1),
    Axis("heading", "rad", -math.pi, math.pi, period=TAU),
)


def network(n_outputs=2, **settings):
    settings = {"width": [0.1, 0.1, 0.5], "dtype": torch.float64} | settings
    return SOFNN(POSE, n_outputs, **settings)


def states(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return x * torch.tensor([1, 1, TAU]) - torch.tensor([0, 0, math.pi])


def grown(count=300, seed=0, **settings):
    net = network(**settings)
    for x in states(count, seed):
        net.grow(x)
    net.consequents.normal_(generator=torch.Generator().manual_seed(seed))
    return net


def brute_force(net, x):
    """Equations 1, 2 and 4 rule by rule in plain Python."""
    total, weighted = 0.0, [0.0] * net.n_outputs
    for u, v, c in zip(net.centres, net.widths, net.consequents, strict=True):
        firing = 1.0
        for i, period in enumerate(net.periods.flatten().tolist()):
            d = float(x[i] - u[i])
            if period:
                d = min((d + k * period for k in (-2, -1, 0, 1, 2)), key=abs)
            firing *= math.exp(-0.5 * (d / float(v[i])) ** 2)
        total += firing
        weighted = [w + firing * float(cj) for w, cj in zip(weighted, c, strict=True)]
    return [w / total for w in weighted]


def test_membership_of_one_rule_is_the_gaussian_of_equation_1():
    net = network()
    net.add_rule(torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64))
    x = torch.tensor([[0.6, 0.3, 0.0]], dtype=torch.float64)
    expected = [[math.exp(-0.5)], [math.exp(-2.0)], [1.0]]
    torch.testing.assert_close(net.log_memberships(x).exp()[0], torch.tensor(expected).double())
    assert net.firing_strengths(x).item() == pytest.approx(math.exp(-2.5), rel=1e-12)


def test_forward_agrees_with_a_rule_by_rule_reference():
    net = grown()
    for x in states(20, seed=1):
        assert net(x[None])[0].tolist() == pytest.approx(brute_force(net, x), rel=1e-9)


def test_normalised_firing_sums_to_one_also_far_from_every_rule():
    net = grown(50).float()
    x = torch.tensor([[0.5, 0.5, 0.0], [1e3, -1e3, 0.0], [1e6, 1e6, 3.0]])
    firing = net.normalised_firing(x)
    assert firing.isfinite().all()
    torch.testing.assert_close(firing.sum(1), torch.ones(3))
    assert net(x).isfinite().all()


def test_angles_wrap():
    net = network()
    net.add_rule(torch.tensor([0.5, 0.5, math.pi - 0.05], dtype=torch.float64))
    x = torch.tensor([[0.5, 0.5, -math.pi + 0.05]], dtype=torch.float64)
    assert net.firing_strengths(x).item() == pytest.approx(math.exp(-0.5 * 0.2**2), rel=1e-9)
    torch.testing.assert_close(net(x), net(x + torch.tensor([0, 0, 3 * TAU])))


def test_batch_equals_single_states():
    net, x = grown(), states(40, seed=2)
    torch.testing.assert_close(net(x), torch.cat([net(row[None]) for row in x]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_in_one_product_is_as_exact_as_differences(dtype):
    net = grown(400, width=[0.01, 0.05, 0.5])
    exact = net.log_memberships(states(64, seed=2)).sum(1)
    centres, widths, _ = (t.to(dtype) for t in net.table().split_with_sizes(net.parts))
    factors = batches.factors(centres, widths, net.wrapping)
    features = batches.features(states(64, seed=2).to(factors), net.wrapping)
    product = batches.log_firing(features, factors, net.wrapping)
    precision = 3e4 * torch.finfo(dtype).eps  # (u / v)^2 is up to 1e4
    near = exact > -50  # the others never fire
    assert (product - exact)[near].abs().max() < precision
    torch.testing.assert_close(product.double(), exact, rtol=precision, atol=precision)


def test_factors_are_double_where_single_precision_would_not_do():
    generator = torch.Generator().manual_seed(0)
    centres = 10 + 0.01 * torch.randn(3, 50, generator=generator)
    widths = 0.01 + 0.01 * torch.rand(3, 50, generator=generator)  # (u / v)^2 is up to 1e6
    x = 10 + 0.01 * torch.randn(50, 3, generator=generator)
    exact = -0.5 * ((x.double().unsqueeze(-1) - centres.double()) / widths.double()) ** 2
    net = SOFNN(3, 1, width=0.01)
    for centre, width in zip(centres.T, widths.T, strict=True):
        net.add_rule(centre, width)
    expected = exact.sum(1).softmax(1).float()
    torch.testing.assert_close(net.normalised_firing(x), expected, rtol=0, atol=batches.PRECISION)
    features, firing = net.firing_functions()
    torch.testing.assert_close(firing(features(x)), expected, rtol=0, atol=batches.PRECISION)
    assert batches.factors(centres, torch.ones_like(widths), ()).dtype == torch.float32


def test_a_batch_takes_centres_of_any_turn():
    net = network()
    for turns in (-2, 0, 1, 3):
        net.add_rule(torch.tensor([0.5, 0.1 * turns, 0.3 + turns * TAU]).double())
    x = states(batches.LARGE)
    single = torch.stack([net.normalised_firing(row) for row in x])
    torch.testing.assert_close(net.normalised_firing(x), single)


def test_the_gradient_of_a_batch_is_the_sum_of_its_states():
    net, x = grown(), states(32, seed=3)
    weights = torch.rand(32, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    parameters = list(net.parameters())
    batch = torch.autograd.grad((net(x) * weights).sum(), parameters)
    single = [
        torch.autograd.grad((net(row[None]) * w).sum(), parameters)
        for row, w in zip(x, weights, strict=True)
    ]
    for whole, *parts in zip(batch, *single, strict=True):
        torch.testing.assert_close(whole, sum(parts), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("growth", ["rule", "input", "literal"])
def test_a_rule_is_added_exactly_where_its_criterion_says(growth):
    net, theta, sets = network(theta=0.3, growth=growth), 0.3, [[], [], []]
    combinations, rules = set(), []
    for x in states(400):
        memberships = [
            [math.exp(-0.5 * (abs(gap(float(x[i]), u, i)) / w) ** 2) for u in column]
            for i, (column, w) in enumerate(zip(sets, [0.1, 0.1, 0.5], strict=True))
        ]
        if growth == "input":
            chosen = []
            for i, column in enumerate(memberships):
                if not column or max(column) < theta:
                    sets[i].append(float(x[i]))
                    chosen.append(len(sets[i]) - 1)
                else:
                    chosen.append(column.index(max(column)))
            expected = tuple(chosen) not in combinations
            combinations.add(tuple(chosen))
        elif not rules:
            expected = True
        elif growth == "rule":
            expected = max(map(math.prod, zip(*memberships, strict=True))) < theta
        else:
            expected = max(map(max, memberships)) < theta
        if expected and growth != "input":
            rules.append(x)
            for i in range(3):
                sets[i].append(float(x[i]))
        assert net.grow(x) == expected
    assert net.n_rules == (len(combinations) if growth == "input" else len(rules))


def gap(x, u, i):
    return x - u if i < 2 else math.remainder(x - u, TAU)


def test_growth_covers_every_visited_state():
    net = grown(1000, theta=0.4)
    for x in states(1000):
        assert net.firing_strengths(x[None]).max() >= 0.4 - 1e-12


@pytest.mark.parametrize("growth", ["rule", "input", "literal"])
def test_observing_gives_the_firing_of_all_rules_the_new_one_included(growth):
    net, added = network(theta=0.6, growth=growth), 0
    for x in states(60):
        before = net.n_rules
        firing = net.observe(x)
        added += before > 0 and net.n_rules > before
        torch.testing.assert_close(firing, net.normalised_firing(x).detach())
    assert added > 1


def test_the_best_firing_is_a_firing_strength():
    net = network()
    net.add_rule(torch.tensor([0.5, 0.5, 0.0]).double())
    net.observe(torch.tensor([0.6, 0.5, 0.0]).double())  # one width away
    assert net.max_firing == pytest.approx(math.exp(-0.5))


def test_a_rule_takes_part_from_a_hundredth_of_a_decision_on():
    net = grown(width=0.001)
    net.usage.zero_()
    net.usage[:4] = torch.tensor([0.0, 0.009, 0.011, 3.0])
    assert net.statistics([0.5])["rules/share_used"] == pytest.approx(2 / 300)
    assert not net.usage.any()


def test_a_shared_membership_function_keeps_its_centre_and_width():
    net = network(growth="input")
    net.add_rule(torch.tensor([0.5, 0.5, 0.0]).double(), torch.tensor([0.2, 0.3, 0.7]).double())
    assert net.grow(torch.tensor([5.0, 0.6, 0.1]).double())  # new on x alone
    assert net.centres[1].tolist() == [5.0, 0.5, 0.0]
    assert net.widths[1].tolist() == pytest.approx([0.1, 0.3, 0.7])


def test_an_empty_frozen_network_cannot_grow_and_says_so():
    net, x = network(growth="frozen"), states(1)[0]
    assert not net.grow(x)
    with pytest.raises(ValueError, match=r"grid\(\)"):
        net.observe(x)
    assert net.n_rules == 0


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), theta=st.floats(0.05, 0.95))
def test_the_output_does_not_jump_where_a_rule_is_added(seed, theta):
    net = grown(40, seed, theta=theta)
    for x in states(30, seed + 1):
        before = net(x[None])
        net.grow(x)
        torch.testing.assert_close(net(x[None]), before, rtol=0, atol=1e-9)


def test_a_rule_of_shared_functions_takes_the_output_at_its_own_centre():
    net, added = network(growth="input", theta=0.5), 0
    for k, x in enumerate(states(60)):
        before = copy.deepcopy(net)
        if net.grow(x) and k:
            centre = net.centres[-1:]
            torch.testing.assert_close(net.consequents[-1:], before(centre).detach())
            added += bool((centre[0] != x).any())
        net.consequents[-1].normal_(generator=torch.Generator().manual_seed(k))
    assert added > 5


def test_only_the_chosen_consequents_are_interpolated():
    net = network(initial=[5.0, 7.0], interpolate=[True, False])
    first = torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    net.add_rule(first, consequents=torch.tensor([1.0, 2.0], dtype=torch.float64))
    net.add_rule(first + 0.5)
    assert net.consequents[1].tolist() == pytest.approx([1.0, 7.0])


def test_growth_keeps_everything_learned_across_blocks():
    net = network(block_size=4, width=0.01)
    for k, x in enumerate(states(40)):
        net.add_rule(x)
        net.traces[:, k], net.usage[k] = float(k), float(k)
    for kind, rows in (("centres", 3), ("widths", 3), ("consequents", 2)):
        shapes = [tuple(block.shape) for block in net.blocks[kind]]
        assert shapes == [(rows, size) for size in (4, 12, 48)]
    torch.testing.assert_close(net.centres, states(40))
    assert net.traces[0].tolist() == net.usage.tolist() == list(map(float, range(40)))


def test_pruning_keeps_the_rest_in_order():
    net = grown(200, block_size=8)
    keep = torch.arange(net.n_rules) % 3 > 0
    centres, consequents = net.centres[keep].clone(), net.consequents[keep].clone()
    net.traces.copy_(torch.arange(float(net.n_rules)).expand_as(net.traces))
    expected = torch.arange(float(net.n_rules))[keep].double()
    assert net.prune(keep) == int((~keep).sum())
    torch.testing.assert_close(net.centres, centres)
    torch.testing.assert_close(net.consequents, consequents)
    torch.testing.assert_close(net.traces[0], expected)
    assert net.grow(torch.tensor([9.0, 9.0, 0.0]).double())


def test_pruning_keeps_the_labels_of_shared_membership_functions():
    net = grown(growth="input", theta=0.6)
    keep = torch.arange(net.n_rules) % 3 > 0
    expected = net.labels[:, keep].clone()
    assert expected.unique().numel() > 3
    net.prune(keep)
    assert torch.equal(net.labels, expected)


def test_a_replaced_rule_takes_no_label_of_another():
    net = network(growth="input")
    kept, new = torch.tensor([0.5, 0.5, 0.5]).double(), torch.tensor([0.1, 0.1, 0.1]).double()
    net.add_rule(kept)
    net.replace_rules(torch.stack([kept, new]), net.default_width.expand(2, 3), torch.zeros(2, 2))
    assert net.labels[:, 0].tolist() == [0, 0, 0]
    assert (net.labels[:, 1] != 0).all()


def test_adapt_and_accumulate_follow_equations_6_and_8():
    net = grown(100, block_size=16)
    before, rows = net.table().detach().clone(), 2 * 3 + 2
    gradient = torch.rand(rows, net.n_rules, dtype=torch.float64)
    rates = torch.linspace(0.001, 0.008, rows, dtype=torch.float64)[:, None]
    net.accumulate(gradient, 0.9)
    net.accumulate(gradient, 0.9)
    torch.testing.assert_close(net.traces, 1.9 * gradient)
    net.adapt(rates)
    torch.testing.assert_close(net.table().detach(), before + rates * 1.9 * gradient)


def test_the_limit_holds_the_traces_of_consequents_alone_on_both_sides():
    net = grown(20)
    gradient = torch.tensor([-5.0, 5.0]).double().repeat(4)[:, None].expand(8, net.n_rules)
    net.accumulate(gradient, 0.9, limit=1.0)
    assert net.traces[:, 0].tolist() == [-5, 5] * 3 + [-1, 1]


def test_widths_stay_positive_under_adaptation():
    net = grown(20, min_width=0.01)
    net.accumulate(-torch.ones_like(net.traces), 0.0)
    net.adapt(torch.full((8, 1), 100.0, dtype=torch.float64))
    assert net.widths.min() == 0.01


@pytest.mark.parametrize("growth", ["rule", "input"])
def test_a_grown_network_loads_strictly_into_a_fresh_one(growth):
    net = grown(500, block_size=16, growth=growth, theta=0.6)
    net.traces.normal_()
    fresh = network(block_size=16, growth=growth, theta=0.6)
    fresh.load_state_dict(net.state_dict(), strict=True)
    assert fresh.n_rules == net.n_rules
    for x in states(200, seed=3):
        assert fresh.grow(x) == net.grow(x)
    for (name, a), b in zip(net.state_dict().items(), fresh.state_dict().values(), strict=True):
        assert a == b if isinstance(a, dict) else torch.equal(a, b), name


def test_a_larger_network_can_load_a_smaller_state():
    small, large = grown(10), grown(800, width=0.03)
    large.load_state_dict(small.state_dict())
    x = states(5, seed=4)
    torch.testing.assert_close(large(x), small(x))


def test_refused_rules_are_part_of_the_state():
    net, fresh = grown(9, max_rules=5, width=0.01), network(max_rules=5, width=0.01)
    fresh.load_state_dict(net.state_dict())
    assert fresh.refused == net.refused == 4


def test_a_state_cannot_be_assigned():
    net = grown(20)
    with pytest.raises(ValueError, match="assign=True"):
        net.load_state_dict(net.state_dict(), assign=True)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))])
def test_a_copy_learns_in_parameters_of_its_own(duplicate):
    net = grown(20, block_size=8)
    before, twin = net.table().detach().clone(), duplicate(net)
    assert torch.equal(twin.table(), before)
    twin.clamp_consequents(0, 2, 3.0, 3.0)
    assert (twin.joined()[2] == 3).all()  # the joined blocks, which optimizers see
    assert torch.equal(net.table(), before)


def test_ordinary_optimizers_reach_the_parameters():
    net = grown(100, block_size=16)
    optimizer = torch.optim.SGD(net.parameters(), lr=0.1)
    x, target = states(32, seed=5), torch.ones(32, 2, dtype=torch.float64)
    losses = []
    for _ in range(20):
        optimizer.zero_grad()
        loss = (net(x) - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]


def test_grid_is_regular_and_frozen():
    net = grid(POSE, (12, 12, 8), 3)
    assert net.n_rules == 1152
    assert not net.grow(torch.tensor([7.0, 7.0, 0.0]))
    assert net.centres.unique(dim=0).shape[0] == 1152
    xs = net.centres[:, 0].unique()
    torch.testing.assert_close(xs, (torch.arange(12) + 0.5) / 12)
    torch.testing.assert_close(net.centres[:, 2].unique().diff(), torch.full((7,), TAU / 8))
    assert net.widths[0].tolist() == pytest.approx([1 / 24, 1 / 24, math.pi / 8])
    # Symmetry: shifting the state by one cell along the periodic axis only permutes the rules.
    x = torch.tensor([[0.4, 0.6, 0.3]])
    a, b = net.firing_strengths(x), net.firing_strengths(x + torch.tensor([0, 0, TAU / 8]))
    torch.testing.assert_close(a.sort().values, b.sort().values)


def test_the_cap_refuses_rules_and_counts():
    net = network(max_rules=5, width=0.01)
    added = [net.grow(x) for x in states(9)]
    assert added == [True] * 5 + [False] * 4
    assert (net.n_rules, net.refused) == (5, 4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"theta": 0.0}, "theta"),
        ({"theta": 1.0}, "theta"),
        ({"theta": math.nan}, "theta"),
        ({"width": 0.0}, "width"),
        ({"width": math.nan}, "width"),
        ({"width": [0.1, 0.1]}, "width"),
        ({"growth": "wild"}, "growth"),
        ({"growth": None}, "growth"),
        ({"max_rules": 0}, "max_rules"),
    ],
)
def test_bad_settings_are_refused_by_name(settings, message):
    with pytest.raises(ValueError, match=message):
        network(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"low": 1.0, "high": 1.0}, "heading: low"),
        ({"low": math.nan}, "heading: low"),
        ({"period": -1.0}, "heading: the period"),
        ({"period": math.inf}, "heading: the period"),
        ({"period": math.nan}, "heading: the period"),
    ],
)
def test_an_axis_needs_a_range_and_a_period_that_can_be(settings, message):
    with pytest.raises(ValueError, match=message):
        Axis("heading", "rad", **settings)


def test_inputs_without_a_description_are_numbered_and_endless():
    assert SOFNN(2, 1, width=0.1).axes == (Axis("x1"), Axis("x2"))


@pytest.mark.parametrize("inputs", [0, [], [Axis("x"), Axis("x")]])
def test_every_input_needs_a_name_of_its_own(inputs):
    with pytest.raises(ValueError, match="input"):
        SOFNN(inputs, 1, width=0.1)


@pytest.mark.parametrize(
    ("axes", "shape", "message"),
    [(POSE, (3, 3), "counts"), (POSE, (3, 3, 0), "counts"), ([Axis("speed")], (3,), "speed")],
)
def test_a_grid_needs_ends_and_a_count_for_each_axis(axes, shape, message):
    with pytest.raises(ValueError, match=message):
        grid(axes, shape, 1)


def test_an_empty_network_says_what_to_do():
    with pytest.raises(ValueError, match="grow"):
        network()(states(1))


def test_a_rule_must_be_finite():
    with pytest.raises(ValueError, match="finite"):
        network().add_rule(torch.tensor([math.nan, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("width", [0.0, -0.1])
def test_the_widths_of_a_rule_must_be_positive(width):
    with pytest.raises(ValueError, match="positive"):
        network().add_rule(states(1)[0], torch.tensor([0.1, width, 0.5]).double())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_gives_the_same_outputs():
    net, x = grown(), states(16, seed=6)
    expected = net(x)
    net.cuda()
    torch.testing.assert_close(net(x.cuda()).cpu(), expected)
    assert net.grow(torch.tensor([9.0, 9.0, 0.0]).double().cuda())


def test_a_grid_begins_with_the_consequents_that_it_is_given():
    initial = [-7.0, 0.25, 300.0]
    net = grid(POSE, (2, 2, 2), 3, initial=initial)
    assert net.consequents.tolist() == [initial] * 8


def test_pruning_keeps_the_usage_of_the_rest():
    net = grown(30, block_size=8)
    net.usage.copy_(torch.arange(float(net.n_rules)))
    keep = torch.arange(net.n_rules) % 3 > 0
    expected = net.usage[keep].tolist()
    net.prune(keep)
    assert net.usage.tolist() == expected and len(expected) > 3


def test_usage_is_the_sum_of_the_normalised_firing():
    net, x = grown(40), states(5, seed=1)
    before, rules = net.usage.clone(), net.n_rules
    firing = [net.observe(row) for row in x]
    expected = before.new_zeros(net.n_rules)
    expected[:rules] = before
    for part in firing:
        expected[: len(part)] += part
    torch.testing.assert_close(net.usage, expected)
    assert net.usage.sum() - before.sum() == pytest.approx(5)
