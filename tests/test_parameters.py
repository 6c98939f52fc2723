"""The network under everything that torch lets one do to a Module: as nn.Linear, or one line."""

import copy
import multiprocessing
import pickle

import pytest
import torch
from torch import nn
from torch.nn.utils import parameters_to_vector, parametrize, prune, vector_to_parameters

from sofnn_torch.network import batches
from sofnn_torch.network.axes import Axis
from sofnn_torch.network.sofnn import SOFNN

X = torch.rand(64, 3, generator=torch.Generator().manual_seed(1))


def network(rules=60, outputs=1, **settings):
    """So many rules at random places in blocks of 4, 12 and 48, with consequents of all sizes."""
    settings = {"width": 0.06, "initial": 1.0, "block_size": 4} | settings
    net, generator = SOFNN(3, outputs, **settings), torch.Generator().manual_seed(0)
    while net.n_rules < rules:
        net.grow(torch.rand(3, generator=generator))
    net.consequents.normal_(generator=generator)
    return net


def numbers(net):
    return [p.detach().clone() for p in net.parameters()]


def truth(net, x):
    """Equations 1, 2 and 4 in double precision from what the properties show."""
    u, v, c = (part.double() for part in (net.centres, net.widths, net.consequents))
    return (-0.5 * ((x.double()[:, None] - u) / v).square()).sum(-1).softmax(-1) @ c


def assert_true(net, x=X, **tolerance):
    """All ways to the output lead to the equations."""
    tolerance = {"rtol": 1e-3, "atol": 1e-3} | tolerance
    with torch.no_grad():
        quiet = net(x)
    few = torch.cat([net(row[None]) for row in x[:5]])
    torch.testing.assert_close(quiet.double(), truth(net, x), **tolerance)
    torch.testing.assert_close(net(x).detach(), quiet)
    torch.testing.assert_close(few.double(), truth(net, x[:5]), **tolerance)


def assert_unchanged(net, before, rules=60):
    assert net.n_rules == rules
    assert all(map(torch.equal, net.parameters(), before)) and len(before) == 9
    assert_true(net)


# ------------------------------------------------------------------------------ numbers written


def test_there_are_centres_widths_and_consequents_in_lists_that_grow():
    net, seen = network(1), []
    for rules in (4, 5, 17):
        while net.n_rules < rules:
            net.add_rule(torch.full((3,), float(net.n_rules)))
        seen.append([(name, *p.shape) for name, p in net.blocks.centres.named_parameters()])
    first, second, third = ("0", 3, 4), ("1", 3, 12), ("2", 3, 48)
    assert seen == [[first], [first, second], [first, second, third]]
    assert [len(blocks) for blocks in net.blocks.values()] == [3, 3, 3]


def test_a_vector_of_parameters_reaches_the_rules():
    net = network()
    vector = parameters_to_vector(net.parameters())
    vector_to_parameters(torch.full_like(vector, 7.0), net.parameters())
    assert (net.table() == 7).all()
    assert_true(net)


def test_what_is_given_as_data_is_written_into_the_table():
    net = network()
    for p in net.parameters():
        p.data = torch.full_like(p, 3.0)
    assert (net.centres == 3).all() and (net.widths == 3).all() and (net.consequents == 3).all()
    assert_true(net)
    with pytest.raises(ValueError, match="keeps its shape"):
        net.blocks.centres[0].data = torch.zeros(3, 5)


@pytest.mark.parametrize("write", [torch.Tensor.zero_, lambda p: nn.init.constant_(p, -1.0)])
def test_widths_written_too_small_are_bounded_before_they_are_used(write):
    net = network(min_width=0.02)
    for p in net.blocks.widths:
        with torch.no_grad():
            write(p)
    assert (net(X).isfinite()).all()
    assert (net.widths == 0.02).all()


def test_parameters_cannot_be_exchanged_pruned_or_parametrized():
    net, before = network(), numbers(network())
    for act in (
        lambda: prune.l1_unstructured(net.blocks.centres, "0", 0.5),
        lambda: parametrize.register_parametrization(net.blocks.centres, "0", nn.ReLU()),
        lambda: nn.utils.parametrizations.weight_norm(net.blocks.widths, "1"),
        lambda: setattr(net.blocks.centres, "0", nn.Parameter(torch.zeros(3, 4))),
        lambda: delattr(net.blocks.centres, "0"),
        lambda: net.blocks.centres.append(torch.zeros(3, 4)),
    ):
        with pytest.raises((ValueError, RuntimeError), match=r"in place|type Window") as refusal:
            act()
        assert "\n" not in str(refusal.value)
        assert_unchanged(net, before)
    assert type(net.blocks.centres).__name__ == "Blocks"


# --------------------------------------------------------------------------------------- copies


@pytest.mark.parametrize(
    "duplicate", [copy.copy, copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))]
)
def test_a_copy_has_all_and_shares_nothing(duplicate):
    net = network()
    net.blocks.widths.requires_grad_(False)
    before, twin = numbers(net), duplicate(net)
    assert_unchanged(twin, before)
    assert [p.requires_grad for p in twin.parameters()] == [True] * 3 + [False] * 3 + [True] * 3
    for _ in range(80):  # over the end of its blocks
        twin.add_rule(torch.rand(3))
    with torch.no_grad():
        for p in twin.parameters():
            p.add_(1)
    assert_true(twin)
    assert_unchanged(net, before)


def test_a_pickle_holds_no_more_than_the_rules():
    size = 4 * sum(p.numel() for p in network().parameters())
    assert len(pickle.dumps(network(max_rules=1_000_000))) < 4 * size + 20_000


def test_a_state_dict_holds_no_more_than_the_rules():
    for tensor in network(max_rules=1_000_000).state_dict().values():
        assert tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()


def test_other_processes_see_what_is_written_and_no_rule_is_added():
    net = network()
    net.share_memory()
    assert all(p.is_shared() for p in net.parameters())

    def write():
        with torch.no_grad():
            net.blocks.consequents[1].fill_(5.0)

    process = multiprocessing.get_context("fork").Process(target=write)
    process.start()
    process.join(20)
    assert process.exitcode == 0
    assert (net.consequents[4:16] == 5).all()
    assert_true(net)
    with pytest.raises(ValueError, match="share this network"):
        net.grow(torch.full((3,), 9.0))
    assert net.n_rules == 60
    twin = copy.deepcopy(net)
    assert twin.grow(torch.full((3,), 9.0)) and not twin.blocks.centres[0].is_shared()


# ---------------------------------------------------------------------------- functional calls


@pytest.mark.parametrize("grad", [True, False])
def test_a_functional_call_uses_the_given_parameters(grad):
    net, other = network(), network(outputs=1, initial=2.0)
    other.consequents.uniform_()
    given = {name: p.detach() for name, p in other.named_parameters()}
    before = numbers(net)
    with torch.set_grad_enabled(grad):
        torch.testing.assert_close(torch.func.functional_call(net, given, (X,)), other(X))
    assert_unchanged(net, before)


def test_the_gradient_of_a_functional_call_is_that_of_backward():
    net = network()
    given = dict(net.named_parameters())

    def loss(parameters):
        return torch.func.functional_call(net, parameters, (X[:8],)).square().sum()

    gradient = torch.func.grad(loss)({name: p.detach() for name, p in given.items()})
    net(X[:8]).square().sum().backward()
    for name, p in given.items():
        torch.testing.assert_close(gradient[name], p.grad, rtol=1e-3, atol=1e-5)


def test_vmap_over_states_is_a_batch():
    net = network()
    torch.testing.assert_close(torch.vmap(net)(X), net(X), rtol=1e-3, atol=1e-3)
    with torch.no_grad():
        torch.testing.assert_close(torch.vmap(net)(X[:8]), net(X[:8]))


def test_vmap_over_parameters_is_an_ensemble():
    nets = [network(), network()]
    nets[1].consequents.uniform_()
    given, _ = torch.func.stack_module_state(nets)
    outputs = torch.vmap(lambda p: torch.func.functional_call(nets[0], p, (X[:8],)))(given)
    torch.testing.assert_close(outputs, torch.stack([net(X[:8]) for net in nets]))


# ---------------------------------------------------------------------------------------- loads


def test_a_part_of_a_whole_leaves_the_rules_alone():
    both = nn.ModuleDict({"encoder": nn.Linear(3, 3), "head": network()})
    before = numbers(both["head"])
    part = {k: v for k, v in both.state_dict().items() if k.startswith("encoder")}
    both.load_state_dict(part, strict=False)
    assert_unchanged(both["head"], before)


@pytest.mark.parametrize("nested", [False, True])
def test_a_partial_load_writes_the_part_that_it_has(nested):
    net = network()
    before, whole = numbers(net), nn.Sequential(net) if nested else net
    name = "0." * nested + "blocks.consequents.1"
    result = whole.load_state_dict({name: torch.full((1, 12), 4.0)}, strict=False)
    assert len(result.missing_keys) == 8 + 4 and not result.unexpected_keys
    before[7].fill_(4.0)
    assert_unchanged(net, before)


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lambda s: s.pop("blocks.widths.1"), {}, "Missing key.*widths.1"),
        (lambda s: s.pop("usage"), {}, "Missing key.*usage"),
        (lambda s: s.update(other=torch.zeros(1)), {}, "Unexpected key.*other"),
        (lambda s: s.update({"blocks.widths.0": torch.zeros(3, 5)}), {"strict": False}, "shape"),
        (lambda s: s.update(traces=torch.zeros(7, 10_000)), {"strict": False}, "traces of 10000"),
        (lambda s: s.update(usage=torch.zeros(59)), {"strict": False}, "usage has the shape"),
        (lambda s: None, {"assign": True}, "leave it out"),
    ],
)
def test_a_refused_load_changes_nothing(change, settings, message):
    net, state = network(), network(initial=3.0, theta=0.3).state_dict()
    before = numbers(net)
    change(state)
    with pytest.raises((RuntimeError, ValueError), match=message):
        net.load_state_dict(state, **settings)
    assert_unchanged(net, before)


def test_a_part_of_another_number_of_rules_is_refused():
    net, state = network(), network(200).state_dict()
    before = numbers(net)
    del state["blocks.widths.0"]
    with pytest.raises(RuntimeError, match="must be whole"):
        net.load_state_dict(state, strict=False)
    assert_unchanged(net, before)


def test_the_state_of_another_network_is_refused_and_changes_nothing():
    net = network()
    before = numbers(net)
    with pytest.raises(RuntimeError, match=r"blocks.consequents.0 has the shape"):
        net.load_state_dict(network(outputs=2).state_dict())
    assert_unchanged(net, before)


def test_a_whole_state_loads_inside_another_module():
    source, target = (nn.Sequential(nn.Linear(3, 3), network(rules)) for rules in (100, 20))
    target.load_state_dict(source.state_dict())
    assert target[1].n_rules == 100
    torch.testing.assert_close(target(X), source(X))


# ------------------------------------------------------------------------- types and precision


@pytest.mark.parametrize(
    ("convert", "dtype", "tolerance"),
    [
        (lambda net: net.double(), torch.float64, 1e-9),
        (lambda net: net.half(), torch.float16, 0.3),
        (lambda net: net.to(torch.bfloat16), torch.bfloat16, 2.5),
        (lambda net: net.double().float(), torch.float32, 1e-3),
    ],
)
def test_a_converted_network_answers_learns_and_grows_in_its_type(convert, dtype, tolerance):
    net = network()
    net(X).sum().backward()
    assert convert(net) is net
    assert {p.dtype for p in net.parameters()} == {p.grad.dtype for p in net.parameters()}
    assert net.table().dtype == net.traces.dtype == net(X.to(dtype)).dtype == dtype
    x = X.to(dtype)
    for given in (x, x[: batches.LARGE - 1]):
        difference = net(given).double() - truth(net, given)
        assert difference.abs().max() < tolerance
    net(x).sum().backward()
    assert net.grow(torch.full((3,), 9.0, dtype=dtype)) and net.n_rules == 61


@pytest.mark.parametrize("size", [8, 64])
def test_states_of_single_precision_are_welcome_in_a_double_network(size):
    net = network().double()
    torch.testing.assert_close(net(X[:size]), truth(net, X[:size]), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", [torch.long, torch.bool, torch.float16, torch.bfloat16])
def test_states_of_whole_numbers_and_half_precision_are_taken_at_every_size(kind):
    net, x = network(), (X * 2).round().to(kind)
    torch.testing.assert_close(net(x).double(), truth(net, x), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(net(x[:8]), net(x)[:8], rtol=1e-3, atol=1e-3)
    assert net.grow(x[0] + 5) or kind is torch.bool


def test_autocast_answers_alike_at_every_size():
    net = network()
    with torch.autocast("cpu", torch.bfloat16):
        few, many, output = net.normalised_firing(X[:8]), net.normalised_firing(X), net(X)
        torch.testing.assert_close(few.float(), many[:8].float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(output.double(), truth(net, X), rtol=0.03, atol=0.03)


@pytest.mark.parametrize("period", [0.0, 1.0])
def test_answers_and_gradients_are_equal_below_and_above_the_large_batch(period):
    axes = [Axis("a"), Axis("b"), Axis("c", period=period)]
    net = SOFNN(axes, 2, width=0.2, dtype=torch.float64)
    for x in X.double():
        net.grow(x)
    net.consequents.normal_(generator=torch.Generator().manual_seed(0))
    x = 3 * X[: batches.LARGE].double() - 1
    ends = [x[:-1], x[-1:]]
    torch.testing.assert_close(net(x), torch.cat(list(map(net, ends))))
    parameters = list(net.parameters())
    one = torch.autograd.grad(net(x).square().sum(), parameters)
    two = torch.autograd.grad(sum(net(end).square().sum() for end in ends), parameters)
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b)


# --------------------------------------------------------------------------------------- growth


def test_growth_in_inference_mode_leaves_a_network_that_learns():
    net = network(15)
    with torch.inference_mode():
        for k in range(60):
            assert net.grow(torch.full((3,), 2.0 + k))
        net.prune(torch.arange(75) != 3)
    net(X[:5]).sum().backward()
    assert [p.grad is not None for p in net.parameters()] == [True] * len(list(net.parameters()))
    assert_true(net)


def test_states_that_carry_a_gradient_leave_none_in_the_rules():
    net, encoder = network(5), nn.Linear(3, 3)
    for k in range(40):
        assert net.grow(encoder(torch.rand(3)) + 5 * k + 5)
        net.observe(encoder(torch.rand(3)))
    assert not (net.centres.requires_grad or net.consequents.requires_grad)
    assert not (net.usage.requires_grad or net.traces.requires_grad)
    assert all(p.is_leaf for p in net.parameters())
    net(encoder(X)).sum().backward()
    assert encoder.weight.grad.abs().sum() > 0
    copy.deepcopy(net)


@pytest.mark.parametrize("shape", [(10, 3), (1, 3), (2,), (4,), ()])
@pytest.mark.parametrize("rules", [0, 5])
def test_a_state_of_another_shape_grows_nothing(shape, rules):
    net = network(rules) if rules else SOFNN(3, 1, width=0.1)
    for act in (net.grow, net.observe, net.add_rule):
        with pytest.raises(ValueError, match="3 numbers"):
            act(torch.rand(shape))
    assert net.n_rules == rules


def test_a_rule_of_another_shape_is_not_added():
    net = network(5)
    for parts in (
        (torch.rand(3), torch.ones(2)),
        (torch.rand(3), torch.tensor(1.0)),
        (torch.rand(3), torch.ones(2), torch.ones(2)),
        (torch.rand(3), None, torch.ones(2)),
        (torch.rand(3), None, torch.ones(1, 1)),
    ):
        with pytest.raises(ValueError, match="3 centres, 3 widths and 1 consequents"):
            net.add_rule(*parts)
    assert net.n_rules == 5
    assert_true(net)


@pytest.mark.parametrize("shape", [(8, 1), (64, 1), (8, 4), (64, 4), (3, 3, 3), ()])
def test_states_of_another_shape_are_refused_in_one_line(shape):
    with pytest.raises(ValueError, match=r"states .* are needed"):
        network()(torch.rand(shape))


def test_what_does_not_learn_stays_so_in_later_blocks():
    net = network(16)
    net.blocks.centres.requires_grad_(False)
    net.requires_grad_(True).blocks.widths.requires_grad_(False)
    while net.n_rules < 60:
        net.add_rule(torch.rand(3))
    learning = {kind: {p.requires_grad for p in net.blocks[kind]} for kind in net.blocks}
    assert learning == {"centres": {True}, "widths": {False}, "consequents": {True}}
    net(X).sum().backward()
    assert all((p.grad is None) != p.requires_grad for p in net.parameters())
    net.zero_grad()
    assert all(p.grad is None for p in net.parameters())
    net.requires_grad_(False)
    assert not net(X).requires_grad


def test_zero_grad_of_another_module_around_it_reaches_all_blocks():
    whole = nn.Sequential(nn.Linear(3, 3), network())
    whole(X).sum().backward()
    assert sum(p.grad is not None for p in whole[1].parameters()) == 9
    whole.zero_grad(set_to_none=False)
    assert all((p.grad == 0).all() for p in whole.parameters())
    assert len(list(whole.parameters())) == 2 + 9
    assert {p.dtype for p in whole.double().parameters()} == {torch.float64}


def test_a_gradient_of_rules_that_are_gone_moves_no_other():
    net = network()
    net(X).sum().backward()
    net.prune(torch.arange(60) % 2 == 0)
    before = net.consequents.clone()
    torch.optim.SGD(net.parameters(), 0.1).step()
    assert torch.equal(net.consequents, before)


def test_repr_tells_the_size_and_the_blocks():
    text = repr(network())
    assert "3 inputs, 1 outputs, 60 rules" in text
    assert text.count("(3, 4), (3, 12), (3, 48)") == 2 and "(1, 4), (1, 12), (1, 48)" in text


def test_a_state_of_more_rules_than_the_network_may_have_is_refused():
    small, large = network(20, max_rules=20), network(25, max_rules=30)
    before = numbers(small)
    with pytest.raises(RuntimeError, match="traces of 25 rules: must be at most 20"):
        small.load_state_dict(large.state_dict())
    assert small.n_rules == 20 and all(map(torch.equal, small.parameters(), before))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))])
def test_a_copy_bounds_the_widths_that_were_written_before_it_was_made(copied):
    net = network()
    with torch.no_grad():
        net.blocks["widths"][1][0, 3] = -1.0
    assert copied(net).widths[4 + 3, 0] == net.min_width
