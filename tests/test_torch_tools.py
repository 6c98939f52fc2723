"""A network in other precisions and under torch's tools: ensembles, export, shared memory."""

import copy

import pytest
import torch

from sofnn_torch import SOFNN

X = torch.rand(40, 3, generator=torch.Generator().manual_seed(1))


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


def test_autocast_does_not_lose_what_cancels():
    net = grown()
    with torch.autocast("cpu", torch.bfloat16):
        firing = net.normalised_firing(X).float()
    torch.testing.assert_close(firing, net.normalised_firing(X), rtol=0.02, atol=0.02)


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
