"""Optimizers that go on through changes of structure: new blocks of parameters, moved rules.

What an optimizer remembers of a parameter in a tensor with as many columns (a momentum, the moments
of Adam) belongs to rules column by column, as the parameter itself does, and moves with them.
"""

import weakref
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import LBFGS, Adagrad, Optimizer, Rprop


class Followers:
    """The optimizers that follow a network, as long as they live. Copies have none."""

    def __init__(self) -> None:
        self._references: list[weakref.ref[Optimizer]] = []

    def __reduce__(self) -> tuple[Any, ...]:
        return Followers, ()

    def __bool__(self) -> bool:
        return bool(self._references)

    def __iter__(self) -> Iterator[Optimizer]:
        return (o for reference in self._references if (o := reference()) is not None)

    def add(self, optimizer: Optimizer, parameters: Sequence[Parameter]) -> bool:
        """Follow from now on; False if it already does.

        Raises:
            ValueError: it has none of the parameters, or keeps no state rule by rule.
        """
        if isinstance(optimizer, LBFGS | Adagrad | Rprop):  # what it keeps does not begin at zero
            kind = type(optimizer).__name__
            raise ValueError(f"{kind} has no state for a rule that is new: it cannot follow growth")
        if not any(_group(optimizer, p) for p in parameters):
            raise ValueError("the optimizer has no parameter of this network")
        if any(optimizer is other for other in self):
            return False
        self._references.append(weakref.ref(optimizer))
        return True

    def append(self, last: Parameter, new: Parameter) -> None:
        """A block has come after the last one: it joins its group, in the network's order."""
        for optimizer in self:
            group = _group(optimizer, last)
            if group is not None:
                place = next(i for i, p in enumerate(group) if p is last)
                group.insert(place + 1, new)

    def remove(self, block: Parameter) -> None:
        """A block is gone."""
        for optimizer in self:
            group = _group(optimizer, block)
            if group is not None:
                group[:] = [p for p in group if p is not block]
                optimizer.state.pop(block, None)

    def clear(self, blocks: Sequence[Parameter], column: int) -> None:
        """There is a new rule in a column of these blocks: nothing is remembered of it."""
        for optimizer in self:
            for memory in (m for block in blocks for m in _memories(optimizer, block).values()):
                memory[..., column] = 0

    def select(self, blocks: Sequence[Parameter], kept: Tensor) -> None:
        """Of the columns of all blocks together those kept, by number, have become the first."""
        sizes = [block.shape[1] for block in blocks]
        for optimizer in self:
            memories = [_memories(optimizer, block) for block in blocks]
            for name in {name for memory in memories for name in memory}:
                parts = [memory.get(name) for memory in memories]
                some = next(part for part in parts if part is not None)
                whole = torch.cat(
                    [
                        some.new_zeros(*some.shape[:-1], size) if part is None else part
                        for part, size in zip(parts, sizes, strict=True)
                    ],
                    -1,
                )
                moved = torch.zeros_like(whole)
                moved[..., : len(kept)] = whole[..., kept]
                for part, values in zip(parts, moved.split_with_sizes(sizes, -1), strict=True):
                    if part is not None:
                        part.copy_(values)


def _group(optimizer: Optimizer, parameter: Parameter) -> list[Parameter] | None:
    """The parameters that an optimizer moves together with this one; None if it has it not."""
    groups = (group["params"] for group in optimizer.param_groups)
    return next((group for group in groups if any(p is parameter for p in group)), None)


def _memories(optimizer: Optimizer, block: Parameter) -> dict[str, Tensor]:
    """What the optimizer remembers of a block rule by rule."""
    state = optimizer.state.get(block, {}).items()
    return {k: v for k, v in state if isinstance(v, Tensor) and v.shape[-1:] == block.shape[-1:]}
