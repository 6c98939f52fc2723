"""What fuzzy rules hold: a table of numbers that grows, and the steps that learning takes in it.

Rules are the columns of a table with ``2 n + m`` rows ``[u_1..u_n, v_1..v_n, c_1..c_m]``: with
the rules along the last axis every reduction over inputs is a vectorised sum, two to three times
faster at batch size 1 than one row per rule. The Parameters in ``blocks`` are windows side by side
into the one table; a full table appends a block as large as all before it together, so adding a
rule costs a constant time on average, no Parameter is ever replaced, and no pass over the rules
has to join the blocks first.

Each number has its eligibility trace beside it. How rules fire and where they are added is told in
`sofnn_torch.network.sofnn`, what they learn from in `sofnn_torch.learners`.
"""

import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

VIEWS = {"_active", "_centres", "_widths", "_consequents", "_traces", "_consequent_traces"}
VIEWS |= {"_usage", "_learning"}
STORES = ("traces_store", "usage_store", "labels_store")  # what a rule has beside its parameters


class RuleTable(nn.Module):
    """Parameters of a number of rules that grows, with a trace for each and counters.

    | Symbol | Shape | Meaning |
    | --- | --- | --- |
    | ``n``, ``m``, ``K`` | | inputs, outputs, rules |
    | ``centres``, ``widths`` | (K, n) | antecedents ``u``, ``v`` in the units of the input |
    | ``consequents`` | (K, m) | ``c``, what the rules conclude |
    | ``traces`` | (2n+m, K) | eligibility trace of each parameter, kept beside it |
    | ``usage`` | (K,) | sum of the normalised firing since it was last cleared |
    | ``labels`` | (n, K) | which membership function each input of a rule uses, if shared |

    Args:
        n_inputs: number of inputs ``n``.
        n_outputs: number of consequents per rule ``m``.
        max_rules: most rules that the table may hold.
        min_width: lower bound of adapted widths.
        block_size: rules in the first block.
        shared: rules may share membership functions; only then are labels kept.
        dtype: of the parameters.

    Raises:
        ValueError: a number of inputs, outputs or rules is not positive.
    """

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        *,
        max_rules: int,
        min_width: float,
        block_size: int,
        shared: bool,
        dtype: torch.dtype,
    ):
        super().__init__()
        if n_inputs < 1 or n_outputs < 1:
            raise ValueError("a network needs at least one input and one output")
        if max_rules < 1 or block_size < 1:
            raise ValueError("max_rules and block_size must be at least 1")
        self.n_inputs, self.n_outputs = n_inputs, n_outputs
        self.max_rules, self.refused = max_rules, 0
        self.min_width, self.block_size, self.shared = min_width, block_size, shared
        self.parts = (n_inputs, n_inputs, n_outputs)  # rows of u, v and c in the table
        self.register_buffer("traces_store", torch.zeros(sum(self.parts), 0, dtype=dtype))
        self.register_buffer("usage_store", torch.zeros(0, dtype=dtype))
        self.register_buffer("labels_store", torch.zeros(n_inputs, 0, dtype=torch.long))
        self._allocate([])

    # -------------------------------------------------------------------------------------- views

    def table(self) -> Tensor:
        """All parameters of the active rules, differentiable. Shape: (2n+m, K)."""
        if self.n_rules == 0:
            raise ValueError("the network has no rules yet: call grow(x) or add_rule(centre)")
        if not torch.is_grad_enabled():
            return self._active
        whole = self.blocks[0] if len(self.blocks) == 1 else torch.cat(list(self.blocks), 1)
        return whole[:, : self.n_rules]

    @property
    def centres(self) -> Tensor:
        """Centres u of the membership functions. Shape: (K, n)."""
        return self._centres.T

    @property
    def widths(self) -> Tensor:
        """Widths v of the membership functions. Shape: (K, n)."""
        return self._widths.T

    @property
    def consequents(self) -> Tensor:
        """Consequents c of the rules. Shape: (K, m)."""
        return self._consequents.T

    @property
    def traces(self) -> Tensor:
        """Eligibility traces E. Shape: (2n+m, K)."""
        return self._traces

    @property
    def usage(self) -> Tensor:
        """Sum of the normalised firing of each rule since it was last cleared. Shape: (K,)."""
        return self._usage

    @property
    def labels(self) -> Tensor:
        """Membership function that each rule uses for each input. Shape: (n, K)."""
        return self.labels_store[:, : self.n_rules]

    @property
    def capacity(self) -> int:
        """Rules that fit before the next block is appended."""
        return self.usage_store.shape[0]

    # --------------------------------------------------------------- learning, eqs 6, 8, 14, 15

    def learnable(self, antecedents: bool) -> Tensor:
        """The parameters to differentiate by: the whole table, or its consequents alone.

        Shape: (2n+m, K) with antecedents, (m, K) without; then the firing needs no gradient.
        """
        return (self._active if antecedents else self._consequents).detach().requires_grad_()

    def accumulate(self, gradient: Tensor, decay: float, limit: float | None = None) -> None:
        """E <- e + decay E (eq. 6) for the last rows of the table, as many as gradient has.

        Args:
            gradient: e, the gradient. Shape: (rows, K).
            decay: gamma lambda.
            limit: bound of the consequents' traces, None for no bound.
        """
        _, traces = self._learning[gradient.shape[0]]
        traces.mul_(decay).add_(gradient)
        if limit is not None:
            self._consequent_traces.clamp_(-limit, limit)

    def adapt(self, rates: Tensor, error: float = 1.0) -> None:
        """W <- W + error rates E (eqs 8, 14, 15) for the last rows of the table.

        Args:
            rates: learning rate of each row. Shape: (rows, 1).
            error: the reinforcement.
        """
        parameters, traces = self._learning[rates.shape[0]]
        parameters.addcmul_(rates, traces, value=error)
        if parameters is self._active:
            self._widths.clamp_(min=self.min_width)

    def adapt_batch(self, rates: Tensor, gradient: Tensor, mass: Tensor) -> None:
        """W <- W + rates gradient / max(1, mass) for a gradient summed over a batch of states.

        Dividing by the firing behind the sum makes a consequent move by the mean over the states
        that it answers for, however many of them are in the batch.

        Args:
            rates: learning rate of each row. Shape: (rows, 1).
            gradient: of the last rows of the table, as many as it has. Shape: (rows, K).
            mass: summed firing that the gradient of a consequent holds. Shape: (K,) or (rows, K).
        """
        parameters, _ = self._learning[gradient.shape[0]]
        parameters.add_(rates * gradient / mass.clamp(min=1.0))

    def clamp_consequents(self, first: int, last: int, low: float, high: float) -> None:
        """Keep the consequents first..last-1 of every rule between low and high."""
        self._consequents[first:last].clamp_(low, high)

    # -------------------------------------------------------------------- rules that come and go

    def _append(self, column: Tensor, labels: Tensor | None) -> None:
        """Add one rule at the end.

        Args:
            column: its parameters. Shape: (2n+m,).
            labels: which shared membership function each input uses; a new one each if None.
                Shape: (n,).

        Raises:
            ValueError: a value is not finite or a width is not positive.
        """
        k, n, numbers = self.n_rules, self.n_inputs, column.tolist()
        if not (math.isfinite(sum(map(abs, numbers))) and min(numbers[n : 2 * n]) > 0):
            raise ValueError(f"a rule needs finite numbers and positive widths: {numbers}")
        if k == self.capacity:
            self._append_block(max(k, self.block_size))
        self._whole.select(1, k).copy_(column)
        if self.shared:
            fresh = self.labels.amax(1) + 1 if k else torch.zeros_like(self.labels_store[:, 0])
            self.labels_store[:, k] = fresh if labels is None else labels
        self._activate(k + 1)

    @torch.no_grad()
    def prune(self, keep: Tensor) -> int:
        """Drop every rule where the mask keep (K,) is False; how many were dropped.

        Raises:
            ValueError: the mask has another length or would leave no rule.
        """
        if keep.shape != (self.n_rules,) or not keep.any():
            raise ValueError(f"keep must be a mask of {self.n_rules} rules with at least one True")
        before = self.n_rules
        stores = {name: getattr(self, name)[..., :before][..., keep] for name in STORES}
        self._fill(self._active[:, keep])
        for name, values in stores.items():
            getattr(self, name)[..., : self.n_rules] = values
        return before - self.n_rules

    @torch.no_grad()
    def replace_rules(self, centres: Tensor, widths: Tensor, consequents: Tensor) -> None:
        """Put these rules, for example edited ones, in the place of all; traces and usage are zero.

        Where rules share membership functions, one that was there before keeps its label, and rules
        whose centre and width on an input are equal share one.

        Args:
            centres: Shape: (K, n).
            widths: Shape: (K, n).
            consequents: Shape: (K, m).

        Raises:
            ValueError: a shape or number that no rule may have, no rule, or more than
                ``max_rules``. Nothing is changed then.
        """
        count, n = len(centres), self.n_inputs
        parts = [part.to(self._whole) for part in (centres, widths, consequents)]
        shapes = [tuple(part.shape) for part in parts]
        if shapes != [(count, rows) for rows in self.parts] or not 1 <= count <= self.max_rules:
            raise ValueError(
                f"need 1 to {self.max_rules} rules with {n} centres, {n} widths and "
                f"{self.n_outputs} consequents each, got the shapes {shapes}"
            )
        table = torch.cat(parts, 1).T
        if not (table.isfinite().all() and (table[n : 2 * n] >= self.min_width).all()):
            raise ValueError(f"rules need finite numbers and widths of {self.min_width} or more")
        labels = self._labels_for(table) if self.shared else 0
        self._fill(table)
        self.labels_store[:, :count] = labels

    def _labels_for(self, table: Tensor) -> Tensor:
        """Which membership function each rule of another table (2n+m, K') uses. Shape: (n, K')."""
        n, k, labels = self.n_inputs, self.n_rules, []
        for i in range(n):
            both = torch.cat([self._active, table], 1)[[i, n + i]]
            functions, index = both.unique(dim=1, return_inverse=True)
            first = int(self.labels[i].max()) + 1 if k else 0
            label = torch.arange(first, first + functions.shape[1], device=table.device)
            label[index[:k]] = self.labels[i]
            labels.append(label[index[k:]])
        return torch.stack(labels)

    # ------------------------------------------------------------------------------------- blocks

    def _fill(self, table: Tensor) -> None:
        """Make the columns of a table (2n+m, K') the rules, with nothing beside them."""
        count = table.shape[1]
        self._allocate([max(count, self.block_size)])
        self._whole[:, :count] = table
        self._activate(count)

    def _allocate(self, sizes: Sequence[int]) -> None:
        """Start afresh with empty blocks of these sizes and no rule."""
        self.blocks = nn.ParameterList()
        for name in STORES:
            setattr(self, name, getattr(self, name)[..., :0])
        self.n_rules = 0
        self._join()
        for size in sizes:
            self._append_block(size)

    def _append_block(self, size: int) -> None:
        self.blocks.append(nn.Parameter(self._whole.new_zeros(len(self._whole), size)))
        for name in STORES:
            store = getattr(self, name)
            setattr(self, name, torch.cat([store, store.new_zeros(*store.shape[:-1], size)], -1))
        self._join()

    def _join(self) -> None:
        """Make the blocks windows into one table, wherever their numbers were before."""
        blocks = [block.detach() for block in self.blocks]
        self._whole = torch.cat([torch.zeros_like(self.traces_store[:, :0]), *blocks], 1)
        windows = self._whole.split_with_sizes([block.shape[1] for block in blocks], 1)
        for block, window in zip(self.blocks, windows, strict=True):
            block.data = window
        self._activate(self.n_rules)

    def _activate(self, n_rules: int) -> None:
        """Set the number of rules; the views of what belongs to them are made when next needed."""
        for name in VIEWS:
            self.__dict__.pop(name, None)
        self.__dict__["n_rules"] = n_rules  # past Module.__setattr__, which is slow

    def __getattr__(self, name: str):
        # A view costs as much as arithmetic on a thousand numbers: none is made twice.
        if name not in VIEWS:
            return super().__getattr__(name)
        k, m = self.n_rules, self.n_outputs
        active, traces = self._whole[:, :k], self.traces_store[:, :k]
        centres, widths, consequents = active.split_with_sizes(self.parts)
        last = traces[-m:]
        self.__dict__.update(
            _active=active,
            _centres=centres,
            _widths=widths,
            _consequents=consequents,
            _traces=traces,
            _consequent_traces=last,
            _usage=self.usage_store[:k],
            # By the number of rows that learn.
            _learning={m: (consequents, last), len(active): (active, traces)},
        )
        return self.__dict__[name]

    # -------------------------------------------------------------------------- copies and state

    def _apply(self, *arguments) -> Self:
        super()._apply(*arguments)  # to another device or type, block by block
        self._join()
        return self

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)  # a copy: the windows have become tables of their own
        self._join()

    def get_extra_state(self) -> dict[str, int]:
        """Rule count and refused growth, part of ``state_dict``."""
        return {"n_rules": self.n_rules, "refused": self.refused}

    def set_extra_state(self, state: dict[str, int]) -> None:
        """Counterpart of `get_extra_state`."""
        if not 0 <= state["n_rules"] <= self.capacity:
            raise ValueError(f"{state['n_rules']} rules do not fit {self.capacity} columns")
        self.refused = state["refused"]
        self._activate(state["n_rules"])

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, *args) -> None:
        if local_metadata.get("assign_to_params_buffers"):
            raise ValueError(
                "load_state_dict(assign=True) would tear the blocks apart: leave it out"
            )
        # Growing to the stored size first lets a fresh network load a grown one strictly.
        sizes, i = [], 0
        while (block := state_dict.get(f"{prefix}blocks.{i}")) is not None:
            sizes.append(block.shape[-1])
            i += 1
        self._allocate(sizes)
        super()._load_from_state_dict(state_dict, prefix, local_metadata, *args)
