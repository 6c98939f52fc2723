"""Experience replay: learning again from remembered decisions (Lin, Machine Learning 8, 1992)."""

from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike
from torch import Tensor

BATCH = 64  # decisions that are learned from at once


class ReplayMemory:
    """The last decisions, each a row of numbers, in a ring.

    Args:
        fields: length of each field of a decision, 0 for a single number, e.g.
            ``{"state": 3, "reward": 0}``.
        capacity: decisions that are kept; a new one then takes the place of the oldest.
        dtype: of the numbers.

    Examples:
        >>> memory = ReplayMemory({"state": 3, "reward": 0}, capacity=100)
        >>> memory.add([0.1, 0.2, 0.3, 1.0])
        >>> memory.sample(2, np.random.default_rng(0), torch.zeros(1))["state"].shape
        torch.Size([2, 64, 3])
    """

    def __init__(self, fields: dict[str, int], capacity: int, dtype: DTypeLike = np.float32):
        self.fields = fields
        self.widths = [length or 1 for length in fields.values()]
        self.rows = np.zeros((capacity, sum(self.widths)), dtype)
        self.count = 0  # decisions seen so far, also those that were overwritten

    def __len__(self) -> int:
        """Decisions that are remembered."""
        return min(self.count, len(self.rows))

    def add(self, numbers: list[float]) -> None:
        """Remember a decision: the numbers of all fields in their order."""
        self.rows[self.count % len(self.rows)] = numbers
        self.count += 1

    def sample(self, batches: int, rng: np.random.Generator, like: Tensor) -> dict[str, Tensor]:
        """Decisions drawn uniformly with replacement.

        Args:
            batches: number N of batches, each of B decisions.
            rng: the source of chance.
            like: a tensor whose device and type the answer takes.

        Returns:
            Each field by name. Shape: (N, B, length), or (N, B) for a single number.
        """
        drawn = self.rows[rng.integers(len(self), size=(batches, BATCH))]
        parts = torch.from_numpy(drawn).to(like).split_with_sizes(self.widths, -1)
        return {
            name: part if length else part[..., 0]
            for (name, length), part in zip(self.fields.items(), parts, strict=True)
        }

    def state_dict(self) -> dict[str, Any]:
        """The remembered decisions and their count."""
        return {"rows": torch.from_numpy(self.rows[: len(self)].copy()), "count": self.count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Counterpart of `state_dict`.

        Raises:
            ValueError: the state is of a memory of another size.
        """
        rows, count = state["rows"], state["count"]
        if rows.shape != (min(count, len(self.rows)), self.rows.shape[1]):
            raise ValueError(
                f"{count} decisions of shape {tuple(rows.shape)} do not fit the memory"
            )
        self.rows[: len(rows)] = rows.numpy()
        self.count = count
