"""The network under everything that torch lets one do to a Module, and under its optimizers."""

import copy
import doctest
import io
import pickle
import runpy
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize, prune

from sofnn_torch import SOFNN
from sofnn_torch.network import sofnn

X = torch.rand(40, 3, generator=torch.Generator().manual_seed(1))
KINDS = ("centres", "widths", "consequents")


def grown(rules=60, outputs=1, **settings):
    """A network with distinct rules in blocks of 16, 16, 32."""
    torch.manual_seed(0)
    net = SOFNN(3, outputs, width=0.06, theta=0.4, block_size=16, **settings)
    while net.n_rules < rules:
        net.grow(torch.rand(3))
    net.consequents.normal_()
    return net


def brute(net, x):
    """The output from the rules as they are read, in double precision. Shape: (B, m)."""
    u, v, c = (part.double() for part in (net.centres, net.widths, net.consequents))
    squares = ((x.double()[:, None] - u) / v).square().sum(2)
    return (-0.5 * squares).softmax(1) @ c


def agrees(net, x=X):
    """With and without a gradient the network answers by the rules that are read."""
    expected = brute(net, x).to(net.default_width)
    torch.testing.assert_close(net(x), expected, rtol=1e-4, atol=1e-4)
    with torch.no_grad():
        torch.testing.assert_close(net(x), expected, rtol=1e-4, atol=1e-4)


def test_the_lists_of_parameters_grow_with_the_rules():
    net, sizes = SOFNN(3, 2, width=0.01), []
    for x in torch.rand(200, 3):
        net.add_rule(x)
        sizes.append(sum(len(net.blocks[kind]) for kind in KINDS))
    assert sizes[0] == 3 and sizes[33] == 6 and sizes[-1] == 12
    names = [name for name, _ in net.named_parameters()]
    assert names[0] == "blocks.centres.0" and len(names) == 12
    assert sum(p.numel() for p in net.parameters()) == 8 * 256


def test_a_vector_of_parameters_reaches_all_that_is_used():
    net = grown()
    vector = nn.utils.parameters_to_vector(net.parameters())
    nn.utils.vector_to_parameters(vector * 0.5 + 0.5, net.parameters())
    torch.testing.assert_close(nn.utils.parameters_to_vector(net.parameters()), vector * 0.5 + 0.5)
    agrees(net)


def test_data_can_be_set_but_not_in_another_shape():
    net = grown()
    for kind in KINDS:
        for block in net.blocks[kind]:
            block.data = torch.full_like(block, 0.5)
    assert (net.centres == 0.5).all() and (net.consequents == 0.5).all()
    agrees(net)
    with pytest.raises(ValueError, match="keeps its shape"):
        net.blocks["centres"][0].data = torch.zeros(3, 2)


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))]
)
def test_a_copy_has_rules_of_its_own_and_grows_on(duplicate):
    net = grown()
    twin, before = duplicate(net), net.consequents.clone()
    assert torch.equal(twin.table(), net.table()) and torch.equal(twin.traces, net.traces)
    twin.consequents.fill_(5.0)
    twin.grow(torch.tensor([7.0, 7.0, 7.0]))
    assert (net.n_rules, twin.n_rules) == (60, 61)
    assert torch.equal(net.consequents, before)
    agrees(twin)


def test_what_is_pickled_holds_no_more_than_the_rules():
    small, large = (SOFNN(3, 1, width=0.1, max_rules=n) for n in (100, 1_000_000))
    for net in (small, large):
        net.add_rule(torch.zeros(3))
    sizes = [len(pickle.dumps(net)) for net in (small, large)]
    assert abs(sizes[0] - sizes[1]) < 500
    buffer = io.BytesIO()
    torch.save(large.state_dict(), buffer)
    assert len(buffer.getvalue()) < 20_000


@pytest.mark.parametrize("gradients", [True, False])
def test_a_functional_call_uses_the_parameters_that_it_is_given(gradients):
    net = grown()
    given = {name: p * 0 + 2 for name, p in net.named_parameters()}
    with torch.set_grad_enabled(gradients):
        out = torch.func.functional_call(net, given, (X,))
    torch.testing.assert_close(out, torch.full_like(out, 2.0))
    agrees(net)


def test_the_gradient_of_a_functional_call_is_that_of_a_backward_pass():
    net = grown()
    given = dict(net.named_parameters())
    gradients = torch.func.grad(lambda p: torch.func.functional_call(net, p, (X,)).sum())(given)
    net(X).sum().backward()
    for name, parameter in net.named_parameters():
        torch.testing.assert_close(gradients[name], parameter.grad)


def test_states_can_be_mapped_over():
    net = grown()
    with torch.no_grad():
        torch.testing.assert_close(torch.vmap(net)(X), net(X), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [8, 40])
def test_an_ensemble_of_parameters_can_be_mapped_over(count):
    nets, x = [grown(), grown()], X[:count]
    nets[1].consequents.mul_(2)
    nets[1].widths.mul_(1.5)
    parameters, _ = torch.func.stack_module_state(nets)

    def answer(given):
        return torch.func.functional_call(nets[0], given, (x,))

    expected = torch.stack([net(x) for net in nets])
    torch.testing.assert_close(torch.func.vmap(answer)(parameters), expected, rtol=1e-4, atol=1e-4)


def test_an_exported_network_answers_any_number_of_states():
    net = grown()
    batch = torch.export.Dim("batch", min=1, max=1000)
    program = torch.export.export(net, (X[:8],), dynamic_shapes={"x": {0: batch}}).module()
    for count in (1, 40):
        torch.testing.assert_close(program(X[:count]), net(X[:count]), rtol=1e-4, atol=1e-4)


def test_nothing_is_moved_to_a_device_without_memory():
    net = grown()
    with pytest.raises(ValueError, match="meta"):
        net.to("meta")
    agrees(net)


def test_shared_memory_is_shared_and_grows_no_more():
    net = grown()
    net.share_memory()
    assert all(p.is_shared() for p in net.parameters())
    agrees(net)
    with pytest.raises(ValueError, match="share this network"):
        net.grow(torch.tensor([7.0, 7.0, 7.0]))


@pytest.mark.parametrize("act", ["prune", "replace_rules"])
def test_shared_rules_are_neither_dropped_nor_replaced(act):
    net = grown().share_memory()
    rules = [part.clone() for part in (net.centres, net.widths, net.consequents)]
    with pytest.raises(ValueError, match="other processes"):
        net.prune(torch.arange(60) > 9) if act == "prune" else net.replace_rules(*rules)
    assert net.n_rules == 60


@pytest.mark.parametrize("count", [8, 40])
def test_a_network_in_half_precision_answers_nearly_like_one_in_single(count):
    net = grown()
    half = copy.deepcopy(net).half()
    answer = half(X[:count])
    assert answer.dtype == torch.half
    torch.testing.assert_close(answer.float(), brute(half, X[:count]).float(), rtol=0, atol=0.01)
    far = half(torch.full((count, 3), 100.0))  # logarithms beyond the range of half precision
    assert far.isfinite().all()
    assert half.observe(torch.full((3,), 5.0)).argmax() == 60  # and grows on
    assert half.conclude(half.observe(X[0])).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.double, torch.half])
def test_types_change_as_in_any_module(dtype):
    net = grown().to(dtype)
    assert {p.dtype for p in net.parameters()} == {dtype} == {net.traces.dtype}
    assert net.centres.dtype == dtype and net(X[:8].to(dtype)).dtype == dtype
    if dtype == torch.double:
        agrees(net, X.double())
        assert net.grow(torch.tensor([7.0, 7.0, 7.0]))


def test_a_partial_load_leaves_the_rules():
    both = nn.ModuleDict({"encoder": nn.Linear(3, 3), "head": grown()})
    table = both["head"].table().detach().clone()
    part = {k: v for k, v in both.state_dict().items() if k.startswith("encoder")}
    found = both.load_state_dict(part, strict=False)
    assert "head.blocks.centres.0" in found.missing_keys
    assert torch.equal(both["head"].table(), table)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda state: state.update(traces=state["traces"][:, :5]),
        lambda state: state.update({"blocks.widths.0": torch.zeros(2, 16)}),
        lambda state: state.pop("usage"),
        lambda state: state.update(foreign=torch.zeros(1)),
        lambda state: state.pop("blocks.centres.1"),
    ],
)
def test_a_refused_load_changes_nothing(spoil):
    net, state = grown(), grown(30).state_dict()
    table = net.table().detach().clone()
    spoil(state)
    with pytest.raises(RuntimeError, match="state_dict"):
        net.load_state_dict(state)
    assert net.n_rules == 60 and torch.equal(net.table(), table)


def test_a_state_of_another_width_of_outputs_is_refused():
    net = grown()
    with pytest.raises(RuntimeError, match=r"blocks.consequents.0 has the shape \(2, 16\)"):
        net.load_state_dict(grown(outputs=2).state_dict())
    agrees(net)


@pytest.mark.parametrize("count", [8, 40])
@pytest.mark.parametrize("dtype", [torch.long, torch.half, torch.bfloat16, torch.double])
def test_states_of_any_type_are_answered_alike_one_by_one_and_in_batches(count, dtype):
    net, x = grown(), (X * 3).round()[:count]  # whole numbers are exact in every type
    torch.testing.assert_close(net(x.to(dtype)), net(x))


def test_autocast_does_not_lose_what_cancels():
    net = grown()
    with torch.autocast("cpu", torch.bfloat16):
        firing = net.normalised_firing(X).float()
    torch.testing.assert_close(firing, net.normalised_firing(X), rtol=0.02, atol=0.02)


@pytest.mark.parametrize("shape", [(8, 1), (40, 4), (3, 3, 4), (), (2, 2, 3)])
def test_states_of_another_shape_are_one_line(shape):
    with pytest.raises(ValueError, match=r"states \(B, 3\) are needed"):
        grown()(torch.rand(shape))


@pytest.mark.parametrize("shape", [(10, 3), (4,), ()])
@pytest.mark.parametrize("rules", [0, 5])
def test_a_network_grows_at_one_state_of_its_own(shape, rules):
    with pytest.raises(ValueError, match="a state of 3 numbers is needed"):
        grown(rules).grow(torch.rand(shape))


def test_rules_that_grew_in_inference_mode_can_be_trained():
    net = grown(15)
    with torch.inference_mode():
        while net.n_rules < 60:
            net.grow(torch.rand(3))
    net(X).sum().backward()
    assert net.blocks["consequents"][-1].grad.abs().sum() > 0
    agrees(net)


def test_a_state_that_carries_a_gradient_leaves_none_in_the_network():
    net, encoder = grown(5), nn.Linear(3, 3)
    for _ in range(40):
        net.grow(encoder(torch.rand(3) * 5))
    assert not net.centres.requires_grad and not net.usage.requires_grad
    copy.deepcopy(net)


@pytest.mark.parametrize(
    "act",
    [
        lambda p: prune.random_unstructured(p, "0", 0.5),
        lambda p: parametrize.register_parametrization(p, "0", nn.Identity()),
        lambda p: p.append(nn.Parameter(torch.zeros(3, 4))),
        lambda p: p.__setitem__(0, nn.Parameter(torch.zeros(3, 16))),
    ],
)
def test_windows_cannot_be_exchanged(act):
    net = grown()
    with pytest.raises(ValueError, match="windows into the table"):
        act(net.blocks["centres"])
    agrees(net)


def test_blocks_that_come_later_are_frozen_like_those_before():
    net = grown(10)
    net.blocks["centres"].requires_grad_(False)
    while net.n_rules < 60:
        net.grow(torch.rand(3))
    assert [p.requires_grad for p in net.blocks["centres"]] == [False] * 3
    assert [p.requires_grad for p in net.blocks["consequents"]] == [True] * 3


def test_the_number_of_rules_is_seen_in_print():
    assert "3 inputs, 1 outputs, 60 rules" in repr(grown())


# --------------------------------------------------------------------------------- optimizers


OPTIMIZERS = [
    lambda groups: torch.optim.SGD(groups, 0.01, momentum=0.9),
    lambda groups: torch.optim.Adam(groups, 0.01),
]


def train(net, optimizer, steps=5):
    """Only rules near the origin get a gradient: rules at 50 and beyond do not fire there."""
    for i in range(steps):
        x = X * 0.5 + 0.01 * i
        optimizer.zero_grad()
        (net(x) - 1).square().mean().backward()
        optimizer.step()


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_growth_changes_nothing_for_the_rules_that_were_there(make):
    early, late = grown(30), grown(30)
    for k in range(20):  # far away, so that they never fire at X
        early.add_rule(torch.full((3,), 50.0 + k))
    ours, theirs = make(late.parameters()), make(early.parameters())
    late.follow(ours)
    train(late, ours)
    train(early, theirs)
    for k in range(20):
        late.add_rule(torch.full((3,), 50.0 + k))
    train(late, ours)
    train(early, theirs)
    # Sums over more rules are rounded in another order; a lost momentum would show at 1e-2.
    torch.testing.assert_close(late.table()[:, :30], early.table()[:, :30], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_an_optimizer_made_before_growth_learns_every_rule(make):
    net = grown(10)
    optimizer = make(net.parameters())
    net.follow(optimizer)
    while net.n_rules < 60:
        net.grow(torch.rand(3))
    before = net.consequents.clone()
    (net(torch.rand(300, 3)) - 9).square().mean().backward()
    optimizer.step()
    assert (net.consequents != before).all()


def test_pruning_takes_what_is_remembered_along():
    net = grown(60)
    optimizer = torch.optim.Adam(net.parameters(), 0.01)
    net.follow(optimizer)
    train(net, optimizer)

    def moments():
        blocks = net.blocks["consequents"]
        return torch.cat([optimizer.state[b]["exp_avg"] for b in blocks], 1)[0, : net.n_rules]

    before, keep = moments().clone(), torch.arange(60) % 3 > 0
    assert before.abs().sum() > 0
    net.prune(keep)
    assert torch.equal(moments(), before[keep])
    assert len(optimizer.param_groups[0]["params"]) == len(list(net.parameters()))
    net.add_rule(torch.rand(3))
    assert moments()[-1] == 0  # nothing is remembered of a new rule


def test_replaced_rules_begin_without_memories():
    net = grown(20)
    optimizer = torch.optim.SGD(net.parameters(), 0.01, momentum=0.9)
    net.follow(optimizer)
    train(net, optimizer)
    net.replace_rules(net.centres.clone(), net.widths.clone(), net.consequents.clone())
    for block in net.parameters():
        assert not optimizer.state[block]["momentum_buffer"].any()


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_growth_keeps_what_is_remembered_of_other_rules_to_the_last_bit(make):
    """With gradients given by hand, in which the new rules have no part."""
    still, growing = grown(20), grown(20)
    optimizers = [make(net.parameters()) for net in (still, growing)]
    for net, optimizer in zip((still, growing), optimizers, strict=True):
        net.follow(optimizer)
    for step in range(6):
        for net, optimizer in zip((still, growing), optimizers, strict=True):
            for kind in KINDS:
                generator = torch.Generator().manual_seed(step)
                for block in net.blocks[kind]:  # in both networks the first two are equal
                    block.grad = torch.randn(block.shape, generator=generator)
            optimizer.step()
        for x in torch.rand(10, 3):
            growing.add_rule(x)
    assert len(growing.blocks["widths"]) == 4
    for kind in KINDS:
        for i, used in enumerate((16, 4)):
            first, second = still.blocks[kind][i], growing.blocks[kind][i]
            assert torch.equal(first[:, :used], second[:, :used])
            before, after = optimizers[0].state[first], optimizers[1].state[second]
            assert before.keys() == after.keys()
            for name in before.keys() - {"step"}:
                assert before[name].any()
                assert torch.equal(before[name][:, :used], after[name][:, :used])


def test_each_kind_has_a_rate_of_its_own():
    net = grown(20)
    optimizer = torch.optim.SGD(net.parameter_groups(widths=0.01, consequents=0.5))
    net.follow(optimizer)
    while net.n_rules < 60:
        net.grow(torch.rand(3))
    assert [len(group["params"]) for group in optimizer.param_groups] == [3, 3]
    centres, consequents = net.centres.clone(), net.consequents.clone()
    firing = net.normalised_firing(X).sum(0).detach()  # the gradient of the sum of the outputs
    net(X).sum().backward()
    optimizer.step()
    assert torch.equal(net.centres, centres)
    torch.testing.assert_close(net.consequents[:, 0], consequents[:, 0] - 0.5 * firing)
    with pytest.raises(ValueError, match="centres, widths, consequents, not sigma"):
        net.parameter_groups(sigma=1.0)


@pytest.mark.parametrize("follows", [True, False])
def test_widths_stay_positive_under_any_optimizer(follows):
    net = grown(60, min_width=0.01)
    optimizer = torch.optim.SGD(net.parameters(), 0.5)
    if follows:
        net.follow(optimizer)
    for _ in range(50):
        optimizer.zero_grad()
        (net(torch.rand(40, 3)) - torch.rand(40, 1)).square().mean().backward()
        optimizer.step()
    assert (net.widths >= 0.01).all() and net.widths.min() == pytest.approx(0.01)


READERS = {
    "observing": lambda net: net.observe(X[0]),
    "the replay": lambda net: net.firing_functions()[0](X),
    "a state": lambda net: net.state_dict(),
    "a copy": lambda net: copy.deepcopy(net),
    "another type": lambda net: net.double(),
    "a rule more": lambda net: net.add_rule(X[0]),  # begins a block
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS.keys())
def test_whoever_reads_the_widths_finds_them_bounded(read):
    net = grown(64, min_width=0.01)
    optimizer = torch.optim.SGD(net.parameters(), 1.0)
    for window in net.blocks["widths"]:
        window.grad = torch.ones_like(window)
    optimizer.step()
    found = read(net)
    assert net._widths[:, :64].min().item() == pytest.approx(0.01)
    if isinstance(found, SOFNN):
        assert found._widths[:, :64].min().item() == pytest.approx(0.01)
    if isinstance(found, dict):
        assert found["blocks.widths.0"].min().item() == pytest.approx(0.01)


def test_optimizers_that_cannot_follow_are_refused():
    net = grown(10)
    with pytest.raises(ValueError, match="no parameter of this network"):
        net.follow(torch.optim.SGD(nn.Linear(2, 2).parameters(), 0.1))
    with pytest.raises(ValueError, match="LBFGS"):
        net.follow(torch.optim.LBFGS(net.parameters()))


def test_the_example_fits_its_function(capsys):
    example = Path(__file__).parents[1] / "examples" / "regression.py"
    runpy.run_path(str(example), run_name="__main__")
    words = capsys.readouterr().out.split()
    grown, left, error, constant = int(words[0]), int(words[2]), float(words[6][:-1]), words[-1]
    assert grown > left > 20 and error < 0.2 * float(constant)


def test_the_example_of_the_class_runs():
    assert doctest.testmod(sofnn).failed == 0 < doctest.testmod(sofnn).attempted
