"""What the stored state of a network holds, and whether it fits: looked at before it is loaded."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from torch import Tensor

from sofnn_torch.network.parameters import KINDS


class Review(NamedTuple):
    """How a stored state fits a network."""

    rules: int
    """Rules that the network would have."""
    sizes: Sequence[int]
    """Rules that fit in each block of its parameters."""
    absent: list[str]
    """Tensors that the state lacks."""
    foreign: list[str]
    """Tensors of the state that the network has not."""
    wrong: list[str]
    """One line for each tensor that cannot be loaded."""


def review(
    state: Mapping[str, Tensor],
    count: int,
    sizes: Sequence[int],
    rows: Sequence[int],
    max_rules: int,
) -> Review:
    """How a stored state fits; the state of a whole network brings its own number of rules.

    Args:
        state: tensors by their names in the network.
        count: rules in the network.
        sizes: rules that fit in each block of its parameters.
        rows: of the centres, widths and consequents in its table.
        max_rules: most rules that it may have.
    """
    before = count, sizes
    if state.keys() >= {"traces", "blocks.consequents.0"}:
        count, sizes = state["traces"].shape[-1], _stored_sizes(state)
    shapes = _shapes(count, sizes, rows)
    absent = [name for name in shapes if name not in state]
    wrong = [
        f"{name} has the shape {tuple(state[name].shape)}, must have {shape}"
        for name, shape in shapes.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    if not count <= min(sum(sizes), max_rules):
        wrong.append(f"traces of {count} rules: must be at most {max_rules}")
    if absent and (count, sizes) != before:
        wrong.append(f"traces of {count} rules, not {before[0]}: must be whole")
    return Review(count, sizes, absent, [name for name in state if name not in shapes], wrong)


def _shapes(count: int, sizes: Sequence[int], rows: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor in the state of a network with so many rules in such blocks."""
    shapes: dict[str, tuple[int, ...]] = {
        f"blocks.{kind}.{i}": (height, size)
        for kind, height in zip(KINDS, rows, strict=True)
        for i, size in enumerate(sizes)
    }
    counted = {"traces": (sum(rows), count), "usage": (count,), "refused": ()}
    return shapes | counted | {"labels": (rows[0], count)}


def _stored_sizes(state: Mapping[str, Tensor]) -> list[int]:
    """Rules in each block of a stored network."""
    sizes: list[int] = []
    while (block := state.get(f"blocks.consequents.{len(sizes)}")) is not None:
        sizes.append(block.shape[-1])
    return sizes
