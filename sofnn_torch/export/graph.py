"""A policy as an ONNX graph of opset 17: states in, network outputs and actions out.

Needs the package onnx (``pip install sofnn-torch[onnx]``). The order of the arithmetic is that of
the network on single states, in its precision.
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.export.runtime import FORMAT, Policy
from sofnn_torch.runs.rule_files import shortest

OPSET, IR = 17, 8
NEED = "an .onnx file needs the package onnx: pip install 'sofnn-torch[onnx]'"


def to_onnx(data: dict[str, Any], *_: Any) -> bytes:
    """The graph of a policy.

    Input ``state`` (B, n). Outputs: ``outputs`` of the network (B, m), of a policy by values
    ``values`` (B, J) too, and ``action``: numbers (B,) int64, or vectors (B, m) from -1 to 1.

    Raises:
        ValueError: onnx is not there.
    """
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise ValueError(NEED) from None
    policy, kind = Policy(data), np.dtype(data["precision"])
    n = len(policy.low)
    nodes: list[Any] = []
    constants: dict[str, Any] = {}

    def constant(name: str, values: Any, dtype: Any = kind) -> str:
        constants[name] = np.asarray(values, dtype)
        return name

    def node(operator: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        out = out or f"{operator.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operator, inputs, [out], **attributes))
        return out

    x = "state"
    if np.isfinite([policy.low, policy.high]).any():
        ends = np.clip([policy.low, policy.high], -np.finfo(kind).max, np.finfo(kind).max)
        x = node("Max", x, constant("low", ends[0]))
        x = node("Min", x, constant("high", ends[1]))
    inputs = x
    if policy.acting:  # (B, J, n + 1)
        column = node("Unsqueeze", x, constant("second", [1], np.int64))
        codes = constant("codes", policy.codes)
        size = node("Shape", x, start=0, end=1)
        shape = node("Concat", size, constant("by", [len(policy.codes), 1], np.int64), axis=0)
        both = node("Expand", column, shape), node("Expand", codes, shape)
        inputs = node("Concat", *both, axis=-1)
    d = node("Unsqueeze", inputs, constant("axis", [-1], np.int64))
    d = node("Sub", d, constant("centres", policy.centres.T))  # (.., n, K)
    if policy.periods.any():
        turns = np.where(policy.periods > 0, 1 / np.where(policy.periods, policy.periods, 1), 0)
        whole = node("Round", node("Mul", d, constant("turns", turns[:, None])))
        d = node("Sub", d, node("Mul", whole, constant("periods", policy.periods[:, None])))
    d = node("Div", d, constant("widths", policy.widths.T))
    squares = node("ReduceSum", node("Mul", d, d), constant("inputs", [-2], np.int64), keepdims=0)
    firing = node("Softmax", node("Mul", squares, constant("half", -0.5)), axis=-1)
    outputs = node("MatMul", firing, constant("consequents", policy.consequents), out="outputs")
    shown = ["outputs", "action"]
    if policy.decision["kind"] == "values":
        _values(node, constant, policy, x, outputs, n)
        shown.append("values")
    else:
        _means(node, constant, policy, outputs)
    whole_action = data["discrete"]
    types = {"outputs": helper.np_dtype_to_tensor_dtype(kind)}
    types["values"], types["state"] = types["outputs"], types["outputs"]
    types["action"] = TensorProto.INT64 if whole_action else TensorProto.FLOAT
    choices = len(policy.codes)
    shapes: dict[str, list[Any]] = {
        "outputs": ["batch", *[choices] * policy.acting, len(data["outputs"])],
        "values": ["batch", choices],
        "action": ["batch"] if whole_action else ["batch", len(data["actions"])],
        "state": ["batch", n],
    }

    def value(name: str) -> Any:
        return helper.make_tensor_value_info(name, types[name], shapes[name])

    initial = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    found = [value(name) for name in shown]
    graph = helper.make_graph(nodes, "policy", [value("state")], found, initial)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR, producer_name="sofnn"
    )
    head = {name: value for name, value in data.items() if name != "rules"}
    helper.set_model_props(model, {FORMAT: json.dumps(head)})
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _means(node: Any, constant: Any, policy: Policy, outputs: str) -> None:
    """Decide by the means: clipped, or as many edges as lie below."""
    numbers = constant("numbers", [policy.decision["numbers"]], np.int64)
    first = constant("first", [0], np.int64)
    means = node("Slice", outputs, first, numbers, constant("along", [1], np.int64))
    if not policy.discrete:
        ends = constant("least", -1), constant("most", 1)
        node("Cast", node("Clip", means, *ends), to=1, out="action")
        return
    above = node("Greater", means, constant("edges", policy.decision["edges"]))
    node("ReduceSum", node("Cast", above, to=7), "along", keepdims=0, out="action")


def _values(node: Any, constant: Any, policy: Policy, x: str, outputs: str, n: int) -> None:
    """Decide by the greatest value: c_x . x + c_a . a + c of each choice."""
    m = policy.consequents.shape[1]
    last = constant("last_axis", [-1], np.int64)
    places = [constant(f"place_{i}", [i], np.int64) for i in (0, n, m - 1, m)]
    of_state, of_action, rest = (
        node("Slice", outputs, start, end, last) for start, end in pairwise(places)
    )
    state = x
    if policy.acting:
        state = node("Unsqueeze", x, "second")
        weighed = node("Mul", of_action, "codes")
    else:
        weighed = node("MatMul", of_action, constant("codes", policy.codes.T))  # (B, J)
    by_state = node("ReduceSum", node("Mul", of_state, state), last, keepdims=1)
    values = node("Add", node("Add", by_state, weighed), rest)
    if policy.acting:
        values = node("Squeeze", values, last)
    values = node("Identity", values, out="values")
    if policy.discrete:
        node("ArgMax", values, axis=1, keepdims=0, out="action")
        return
    best = node("ArgMax", values, axis=1, keepdims=1)
    points = constant("representatives", policy.decision["representatives"], np.float32)
    node("Gather", points, best, out="action")


def from_onnx(path: Path) -> dict[str, Any]:
    """The policy in a graph that `to_onnx` wrote.

    Raises:
        ValueError: one line on what is wrong with the file, or onnx is not there.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError:
        raise ValueError(NEED) from None
    try:
        model = onnx.load_model_from_string(path.read_bytes())
        heads = [entry.value for entry in model.metadata_props if entry.key == FORMAT]
        if not heads:
            raise ValueError("not a policy of sofnn-torch")
        arrays = {a.name: numpy_helper.to_array(a) for a in model.graph.initializer}
        data = json.loads(heads[0])
        parts = [arrays["centres"].T, arrays["widths"].T, arrays["consequents"]]
        names, rows = ("centre", "width", "consequents"), [shortest(p).tolist() for p in parts]
        data["rules"] = [dict(zip(names, row, strict=True)) for row in zip(*rows, strict=True)]
        return Policy(data).data
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except Exception as error:  # protobuf raises kinds of its own for a file that it cannot read
        raise ValueError(f"{path}: not an ONNX policy ({' '.join(str(error).split())})") from None
