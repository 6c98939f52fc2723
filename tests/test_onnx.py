"""ONNX graphs: equal to torch at any batch size under onnxruntime, read again or refused."""

import numpy as np
import pytest
import torch
from exported import ALL, learner, states
from test_export import command, margins  # noqa: F401

from sofnn_torch.export import graph, policy, runtime

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


def session(content):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options)


@pytest.mark.parametrize("kind", ALL)
def test_a_graph_concludes_and_decides_as_torch_at_any_batch_size(kind):
    config, agent = learner(kind)
    data = policy.describe(config, agent)
    ours, run = runtime.Policy(data), session(graph.to_onnx(data))
    assert run.get_modelmeta().custom_metadata_map.keys() == {runtime.FORMAT}
    for count in (1, 7, 31, 300):
        x = states(agent, count, seed=count)
        outputs, action = run.run(["outputs", "action"], {"state": x})
        assert len(outputs) == len(action) == count
        seen = torch.from_numpy(ours.state(x).astype(np.float32))
        with torch.no_grad():
            inputs = agent.network_inputs(seen)
            expected = agent.net(inputs.reshape(-1, inputs.shape[-1]))
        expected = expected.reshape(outputs.shape).numpy()
        np.testing.assert_allclose(outputs, expected, rtol=1e-6, atol=1e-6)
        plan = agent.plan(seen.numpy())
        near = np.abs(action - plan.actions).reshape(count, -1).max(1) < 1e-5
        assert (near | (margins(ours, x) < 1e-5)).all()
        if plan.choice is not None and data["decision"]["kind"] == "values":
            (values,) = run.run(["values"], {"state": x})
            np.testing.assert_allclose(values.max(1), plan.value, atol=2e-6)


def test_many_narrow_rules_with_values_of_a_hundred_conclude_as_torch_at_any_batch_size():
    config, agent = learner("q", rules=784)
    net, rng = agent.net, np.random.default_rng(0)
    narrow = torch.from_numpy(rng.uniform([0.02, 0.02, 0.2], [0.06, 0.06, 0.5], (784, 3))).float()
    net.replace_rules(net.centres, narrow, 100 * net.consequents)
    run = session(graph.to_onnx(policy.describe(config, agent)))
    for count in (1, 31, 32, 33, 512):
        x = states(agent, count, seed=count).clip([0, 0, -3.1], [1, 1, 3.1]).astype(np.float32)
        (outputs,) = run.run(["outputs"], {"state": x})
        with torch.no_grad():
            expected = net(torch.from_numpy(x)).numpy()
        assert np.abs(outputs - expected).max() < 1e-6 * np.abs(net.consequents.numpy()).max()


def test_a_graph_is_read_and_written_again(tmp_path, command):  # noqa: F811
    data = policy.describe(*learner("q antecedent"))
    first, again = tmp_path / "first.onnx", tmp_path / "again.onnx"
    first.write_bytes(graph.to_onnx(data))
    assert graph.from_onnx(first) == data
    code, out, _ = command(first, "--to", again)
    assert code == 0 and "40 rules" in out
    assert again.read_bytes() == first.read_bytes()


@pytest.mark.parametrize("share", [0, 0.3, 0.99])
def test_a_truncated_graph_is_one_line(tmp_path, command, share):  # noqa: F811
    path = tmp_path / "policy.onnx"
    content = graph.to_onnx(policy.describe(*learner("three")))
    path.write_bytes(content[: int(share * len(content))])
    code, _, error = command(path, "--to", tmp_path / "policy.json")
    assert code == 2 and error.count("\n") == 1 and "not an ONNX policy" in error
