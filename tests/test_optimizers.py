"""Optimizers of torch.optim that go on while rules come, move and go."""

import copy
import gc
import weakref

import pytest
import torch
from torch import nn
from torch.optim import SGD, Adagrad, Adam, Optimizer

from sofnn_torch.network.sofnn import SOFNN

KINDS = {"centres": 0.01, "widths": 0.001, "consequents": 0.1}
PLACES = torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
PLACES[12:] += 1000.0  # so far from the others that neither fires where the other does


def network(rules=12, block=16, **settings):
    settings = {"width": 0.2, "dtype": torch.float64, "interpolate": False} | settings
    net = SOFNN(2, 1, block_size=block, **settings)
    for place in PLACES[:rules]:
        net.add_rule(place.to(net.default_width))
    return net


def learn(net, optimizer, rules, steps=5):
    """Steps towards a target at states around the first rules."""
    generator = torch.Generator().manual_seed(rules)
    for _ in range(steps):
        noise = 0.1 * torch.randn(rules, 2, generator=generator, dtype=torch.float64)
        x = (PLACES[:rules] + noise).to(net.default_width)
        optimizer.zero_grad()
        (net(x) - torch.sin(5 * x.sum(1, keepdim=True))).square().mean().backward()
        optimizer.step()


def momentum(parameters):
    return SGD(parameters, 0.05, momentum=0.9)


def adam(parameters):
    return Adam(parameters, 0.01)


def remembered(net, optimizer):
    """What the optimizer remembers of each rule, by kind and name. Shape: (rows, K)."""
    found = {}
    for kind, blocks in net.blocks.items():
        for name in ("momentum_buffer", "exp_avg", "exp_avg_sq"):
            parts = [optimizer.state.get(b, {}).get(name, torch.zeros_like(b)) for b in blocks]
            found[kind, name] = torch.cat(parts, 1)[:, : net.n_rules].clone()
    return {key: values for key, values in found.items() if values.any()}


@pytest.mark.parametrize("make", [momentum, adam])
@pytest.mark.parametrize("block", [4, 16, 64])
def test_learning_goes_on_as_if_all_rules_had_been_there_from_the_start(make, block):
    net, whole = network(12, block), network(40, block)
    first, second = make(net.parameters()), make(whole.parameters())
    net.follow(first)
    learn(net, first, 12)
    learn(whole, second, 12)
    for place in PLACES[12:]:
        net.add_rule(place)
    torch.testing.assert_close(remembered(net, first), remembered(whole, second))
    for key, values in remembered(net, first).items():
        assert values[:, :12].any() and not values[:, 12:].any(), key
    torch.testing.assert_close(net.table(), whole.table())
    learn(net, first, 40)
    learn(whole, second, 40)
    # Adam counts the steps of each block, so that those of later blocks are bolder.
    same = 40 if make is momentum or block == 64 else 12
    torch.testing.assert_close(net.table()[:, :same], whole.table()[:, :same])
    assert (net.consequents != 0).all()


@pytest.mark.parametrize("make", [momentum, adam])
def test_pruned_rules_take_what_is_remembered_of_them_along(make):
    net = network(40, 4)
    optimizer = make(net.parameters())
    net.follow(optimizer)
    learn(net, optimizer, 40)
    before, keep = remembered(net, optimizer), torch.arange(40) % 3 > 0
    net.prune(keep)
    torch.testing.assert_close(
        remembered(net, optimizer), {key: values[:, keep] for key, values in before.items()}
    )
    for place in PLACES[:14]:
        net.add_rule(place + 500)
    after = remembered(net, optimizer)
    assert after.keys() == before.keys()
    assert not any(values[:, keep.sum() :].any() for values in after.values())
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(
        list(net.parameters())
    )


@pytest.mark.parametrize("count", [3, 12, 40])
def test_nothing_is_remembered_of_rules_that_were_replaced(count):
    net = network(12, 4)
    optimizer = adam(net.parameters())
    net.follow(optimizer)
    learn(net, optimizer, 12)
    assert remembered(net, optimizer)
    net.replace_rules(PLACES[:count], torch.ones(count, 2), torch.zeros(count, 1))
    assert not remembered(net, optimizer)
    learn(net, optimizer, count)
    assert (net.consequents != 0).all()


def test_each_kind_learns_at_its_rate_in_every_block():
    net = network(3, 4)
    optimizer = SGD(net.parameter_groups(**KINDS))
    net.follow(optimizer)
    while net.n_rules < 12:
        net.add_rule(PLACES[net.n_rules])
    net.consequents.normal_(generator=torch.Generator().manual_seed(0))
    before = [part.clone() for part in (net.centres, net.widths, net.consequents)]
    (net(PLACES[:12] + 0.1) - 1).square().sum().backward()
    gradients = [torch.cat([b.grad for b in blocks], 1).T[:12] for blocks in net.blocks.values()]
    optimizer.step()
    after = (net.centres, net.widths, net.consequents)
    for old, new, gradient, rate in zip(before, after, gradients, KINDS.values(), strict=True):
        torch.testing.assert_close(new, old - rate * gradient)
    assert [len(group["params"]) for group in optimizer.param_groups] == [2, 2, 2]
    assert all(gradient.any() for gradient in gradients)


def test_a_kind_without_a_rate_does_not_learn():
    net = network(3, 4)
    optimizer = adam(net.parameter_groups(consequents=0.1))
    net.follow(optimizer)
    while net.n_rules < 12:
        net.add_rule(PLACES[net.n_rules])
    learn(net, optimizer, 12)
    assert torch.equal(net.centres, PLACES[:12]) and (net.widths == 0.2).all()
    assert (net.consequents != 0).all()
    with pytest.raises(ValueError, match="centres, widths, consequents, not heights"):
        net.parameter_groups(heights=1.0)


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("make", [lambda p: SGD(p, 5.0), lambda p: Adam(p, 0.5)])
def test_widths_keep_their_bound_under_any_optimizer(make, follow):
    net = network(12, 4, min_width=0.05)
    optimizer = make(net.blocks.widths.parameters())
    if follow:
        net.follow(optimizer)
    for _ in range(3):
        optimizer.zero_grad()
        net.joined()[1].sum().backward()  # narrower is better
        optimizer.step()
        if follow:  # also before anyone asks
            assert (torch.cat(list(net.blocks.widths), 1)[:, :12] == 0.05).all()
        assert net(PLACES).isfinite().all()
        assert (net.widths == 0.05).all()


@pytest.mark.parametrize(
    "kind",
    [
        kind
        for kind in vars(torch.optim).values()
        if isinstance(kind, type) and issubclass(kind, Optimizer) and kind is not Optimizer
    ],
)
def test_every_optimizer_follows_growth_or_is_refused(kind):
    if kind.__name__ == "SparseAdam":
        pytest.skip("is for sparse gradients alone")
    net = network(5, 4)
    optimizer = kind(net.parameters(), lr=0.01)
    if kind in (torch.optim.LBFGS, Adagrad, torch.optim.Rprop):
        with pytest.raises(ValueError, match="cannot follow"):
            net.follow(optimizer)
        return
    net.follow(optimizer)
    learn(net, optimizer, 5, 2)
    while net.n_rules < 12:
        net.add_rule(PLACES[net.n_rules])
    net.prune(torch.arange(12) != 2)
    learn(net, optimizer, 11, 2)
    assert (net.consequents != 0).all()


def test_a_new_rule_gets_no_memory_of_one_that_was_in_its_place():
    for make in (momentum, adam, lambda p: torch.optim.Adafactor(p, 0.01)):
        net = network(12, 16)
        optimizer = make(net.parameters())
        net.follow(optimizer)
        learn(net, optimizer, 12)
        net.prune(torch.arange(12) < 6)
        net.add_rule(PLACES[20])
        state = optimizer.state[net.blocks.centres[0]].values()
        columns = [v for v in state if isinstance(v, torch.Tensor) and v.shape[-1:] == (16,)]
        assert columns
        for values in columns:
            assert values[..., :6].any() and not values[..., 6:].any()


def test_an_optimizer_of_something_else_is_refused():
    with pytest.raises(ValueError, match="no parameter of this network"):
        network().follow(adam(nn.Linear(2, 2).parameters()))
    with pytest.raises(ValueError, match="no parameter of this network"):
        network().follow(adam(network().parameters()))


def test_other_parameters_of_an_optimizer_are_left_alone():
    net, encoder = network(12, 4), nn.Linear(2, 2).double()
    optimizer = adam([{"params": encoder.parameters()}, *net.parameter_groups(**KINDS)])
    net.follow(optimizer)
    net.follow(optimizer)  # once is enough
    net.consequents.normal_(generator=torch.Generator().manual_seed(0))
    net(encoder(PLACES[:12])).sum().backward()
    optimizer.step()
    while net.n_rules < 40:
        net.add_rule(PLACES[net.n_rules])
    sizes = [len(group["params"]) for group in optimizer.param_groups]
    assert sizes == [2, *[len(net.blocks.centres)] * 3]
    assert optimizer.state[encoder.weight]["exp_avg"].any()


def test_copies_follow_nobody_and_nobody_is_kept_alive():
    net = network(12, 16)
    optimizer = adam(net.parameters())
    net.follow(optimizer)
    twin = copy.deepcopy(net)
    while twin.n_rules < 40:
        twin.add_rule(PLACES[twin.n_rules])
    assert len(optimizer.param_groups[0]["params"]) == 3
    reference = weakref.ref(optimizer)
    del optimizer
    gc.collect()
    assert reference() is None
    while net.n_rules < 40:
        net.add_rule(PLACES[net.n_rules])


def test_a_new_rule_has_no_memory_of_the_column_in_which_it_comes():
    net = network(3, block=4)
    optimizer = momentum(net.parameters())
    net.follow(optimizer)
    for parameter in net.parameters():
        parameter.grad = torch.ones_like(parameter)  # also where there is no rule yet
    optimizer.step()
    blocks = [blocks[0] for blocks in net.blocks.values()]
    assert all((optimizer.state[b]["momentum_buffer"] == 1).all() for b in blocks)
    net.add_rule(PLACES[3])
    for block in blocks:
        assert not optimizer.state[block]["momentum_buffer"][:, 3].any()
        assert (optimizer.state[block]["momentum_buffer"][:, :3] == 1).all()


def test_nothing_is_remembered_of_a_block_that_is_gone():
    net = network(12, block=4)
    optimizer = adam(net.parameters())
    net.follow(optimizer)
    learn(net, optimizer, 12)
    net.prune(torch.arange(12) < 3)
    assert len(list(net.parameters())) == 3
    assert {id(p) for p in optimizer.state} == {id(p) for p in net.parameters()}


def test_new_blocks_stand_in_the_order_of_the_network():
    net = network(3, block=4)
    whole, kinds = momentum(net.parameters()), Adam(net.parameter_groups(**KINDS))
    for optimizer in (whole, kinds):
        net.follow(optimizer)
    for place in PLACES[3:17]:
        net.add_rule(place)
    (group,) = whole.param_groups
    assert [*map(id, group["params"])] == [*map(id, net.parameters())]
    for group, blocks in zip(kinds.param_groups, net.blocks.values(), strict=True):
        assert [*map(id, group["params"])] == [*map(id, blocks)] and len(blocks) == 3
