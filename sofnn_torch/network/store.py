"""Where the rules are kept: one table, Parameters that are windows into it, copies and state.

Rules are the columns of a table with ``2 n + m`` rows ``[u_1..u_n, v_1..v_n, c_1..c_m]``: with
the rules along the last axis every reduction over inputs is a vectorised sum, two to three times
faster at batch size 1 than one row per rule. The memory for ``max_rules`` of them is reserved once,
and an operating system gives what is used of it. So nothing ever moves: the Parameters in
``blocks`` are windows into the table, centres, widths and consequents by themselves, and a full
table appends a block of each that is three times as large as all before it together.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, chain, pairwise
from operator import attrgetter, is_
from typing import Any, Self

import torch
from torch import Tensor, cat, nn

from sofnn_torch.network import loading
from sofnn_torch.network.optimizers import Followers
from sofnn_torch.network.parameters import KINDS, Blocks, Window

VERSION = attrgetter("_version")  # counts what is written in place
STORES = ("table", "traces", "usage", "labels")
COUNTED = ("traces", "usage", "labels")  # what has a column for each rule beside the parameters
VIEWS = {"_active", "_active_parts", "_centres", "_widths", "_consequents", "_traces", "_usage"}
VIEWS |= {"_consequent_traces", "_learning"}


class RuleStore(nn.Module):
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
        self.max_rules, self.min_width, self.shared = max_rules, min_width, shared
        self.parts = (n_inputs, n_inputs, n_outputs)  # rows of u, v and c in the table
        self._shapes_of_one = [torch.Size((rows,)) for rows in self.parts]
        self._lists = tuple(Blocks() for _ in KINDS)
        self.blocks = nn.ModuleDict(dict(zip(KINDS, self._lists, strict=True)))
        self._windows: list[list[Window]] = [[] for _ in KINDS]
        self._seen = 0  # versions of the widths
        self._followers, self._is_shared, self._strict = Followers(), False, False
        self.capacity = 0  # rules that fit before a block is appended
        self.block_sizes: list[int] = []
        self._store: dict[str, Tensor] = {}
        self.refused: Tensor
        self.register_buffer("refused", torch.tensor(0))
        with torch.inference_mode(False):
            self._reserve(torch.empty(0, dtype=dtype))
            self._shape_blocks([min(block_size, max_rules)])
            self._activate(0)

    # -------------------------------------------------------------------------------------- views

    def joined(self) -> Sequence[Tensor]:
        """Centres (n, K), widths (n, K) and consequents (m, K), differentiable.

        Raises:
            ValueError: there are no rules yet.
        """
        k = self.n_rules
        if k == 0:
            raise ValueError("the network has no rules yet: call grow(x) or add_rule(centre)")
        lists = [blocks.tensors() for blocks in self._lists]
        # In a functional call others stand in the places of the windows.
        if all(map(is_, chain(*lists), chain(*self._windows))):
            self._keep_widths()
            if not torch.is_grad_enabled():
                return self._active_parts
        return [(cat(blocks, 1) if len(blocks) > 1 else blocks[0])[:, :k] for blocks in lists]

    def table(self) -> Tensor:
        """All parameters of the rules, differentiable. Shape: (2n+m, K)."""
        return cat([*self.joined()])

    @property
    def centres(self) -> Tensor:
        """Centres u of the membership functions, without a gradient. Shape: (K, n)."""
        return self._centres.T

    @property
    def widths(self) -> Tensor:
        """Widths v of the membership functions, without a gradient. Shape: (K, n)."""
        self._keep_widths()
        return self._widths.T

    @property
    def consequents(self) -> Tensor:
        """Consequents c of the rules, without a gradient. Shape: (K, m)."""
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
        return self._store["labels"][:, : self.n_rules]

    def _keep_widths(self) -> None:
        """Bound the widths from below where anything has written to their Parameters."""
        if (written := self._written()) != self._seen:
            self._seen = written
            with torch.no_grad():
                self._widths.clamp_(min=self.min_width)

    # ---------------------------------------------------------------------- ordinary optimizers

    def parameter_groups(self, **rates: float) -> list[dict[str, Any]]:
        """Groups for an optimizer of ``torch.optim``, with a learning rate for each kind.

        Args:
            **rates: learning rates of ``centres``, ``widths`` and ``consequents``; a kind that is
                not named is not learned.

        Raises:
            ValueError: there is no such kind.
        """
        if unknown := rates.keys() - set(KINDS):
            raise ValueError(f"there are {', '.join(KINDS)}, not {', '.join(sorted(unknown))}")
        lists = zip(KINDS, self._lists, strict=True)
        return [{"params": list(b), "lr": rates[kind]} for kind, b in lists if kind in rates]

    def follow(self, optimizer: torch.optim.Optimizer) -> None:
        """Let an optimizer go on through all changes of structure.

        New blocks of parameters join the group that has the block before; what the optimizer
        remembers of a rule, such as a momentum, goes where the rule goes. A new or replaced rule
        starts without. Copies of the network and of the optimizer do not follow.

        Raises:
            ValueError: it has no parameter of this network, or is LBFGS, Adagrad or Rprop.
        """
        if self._followers.add(optimizer, list(self.parameters())):
            optimizer.register_step_post_hook(lambda *_: self._keep_widths())

    # ------------------------------------------------------------------------------------- memory

    def _reserve(self, like: Tensor) -> None:
        """Reserve address space for ``max_rules`` rules, of the type and on the device of like."""
        columns = -(-self.max_rules // 16) * 16
        columns += 16 * (columns % 1024 == 0)  # rows so far apart would share places in the cache
        rows, n = sum(self.parts), self.n_inputs
        try:
            self._store = {
                "table": like.new_empty(rows, columns),
                "traces": like.new_empty(rows, columns),
                "usage": like.new_empty(columns),
                "labels": like.new_empty(n, columns, dtype=torch.long),
            }
        except RuntimeError:
            raise ValueError(f"no memory for max_rules={self.max_rules}: lower it") from None

    def _sizes_for(self, count: int) -> list[int]:
        """Sizes of blocks for so many rules: no block is empty, each new one makes four of one."""
        sizes = list(self.block_sizes)
        while sum(sizes) < count:
            # Few blocks: what autograd does for each costs as much as arithmetic on 1,000 rules.
            sizes.append(min(3 * sum(sizes), self._store["usage"].shape[0] - sum(sizes)))
            if not sizes[-1]:
                raise ValueError(f"there is memory for max_rules={sum(sizes)} rules alone")
        while sum(sizes[:-1]) >= count:
            sizes.pop()
        return sizes

    @torch.inference_mode(False)
    def _shape_blocks(self, sizes: Sequence[int]) -> None:
        """Keep the first blocks that have these sizes, drop the others, append what is missing."""
        if self.block_sizes:
            self._keep_widths()
        kept = 0
        while sizes[: kept + 1] == self.block_sizes[: kept + 1] and kept < len(sizes):
            kept += 1
        ends = [0, *accumulate(sizes)]
        for blocks, rows in zip(self._lists, self._rows(), strict=True):
            while len(blocks) > kept:
                self._followers.remove(blocks.pop())
            for start, end in pairwise(ends[kept:]):
                learned = blocks[-1].requires_grad if start else True
                blocks.append(Window(rows[:, start:end].data, learned))
                if start:
                    self._followers.append(blocks[-2], blocks[-1])
        for store in self._store.values():
            store[..., ends[kept] : ends[-1]] = 0
        self.capacity, self.block_sizes = ends[-1], list(sizes)
        self._windows = [list(blocks) for blocks in self._lists]
        self._seen = self._written()

    def _write(self, columns: Mapping[str, Tensor], count: int) -> None:
        """Write columns into the stores, zeros where none are given, and set the rules."""
        for name, store in self._store.items():
            given = columns.get(name)
            store[..., : self.capacity] = 0
            if given is not None:
                store[..., : given.shape[-1]] = given
        self._activate(count)

    def _rows(self) -> Sequence[Tensor]:
        return self._store["table"].split_with_sizes(self.parts)

    def _written(self) -> int:
        """Changes whenever anything writes to the Parameters of the widths."""
        return sum(map(VERSION, self._windows[1]))

    def _activate(self, n_rules: int) -> None:
        """Set the number of rules; the views of what belongs to them are made when next needed."""
        for name in VIEWS:
            self.__dict__.pop(name, None)
        self.__dict__["n_rules"] = n_rules  # past Module.__setattr__, which is slow

    def __getattr__(self, name: str) -> Any:
        # A view costs as much as arithmetic on a thousand numbers: none is made twice.
        if name not in VIEWS:
            return super().__getattr__(name)
        table, traces, usage = (self._store[s][..., : self.n_rules] for s in STORES[:3])
        centres, widths, consequents = parts = table.split_with_sizes(self.parts)
        last = traces[-self.n_outputs :]
        self.__dict__.update(
            _active=table,
            _active_parts=parts,
            _centres=centres,
            _widths=widths,
            _consequents=consequents,
            _traces=traces,
            _consequent_traces=last,
            _usage=usage,
            # By the number of rows that learn.
            _learning={self.n_outputs: (consequents, last), len(table): (table, traces)},
        )
        return self.__dict__[name]

    # -------------------------------------------------------------------------- copies and state

    def extra_repr(self) -> str:
        """What `repr` shows of the table."""
        return f"{self.n_inputs} inputs, {self.n_outputs} outputs, {self.n_rules} rules"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """To another type, another device or shared memory: the table, then its windows."""
        self._keep_widths()
        store = {name: fn(values) for name, values in self._store.items()}
        if store["table"].is_meta:
            raise ValueError("the device meta has no numbers: a network cannot be moved there")
        windows = list(chain(*self._windows))
        gradients = [window.grad for window in windows]
        self._show(store)
        for window, gradient in zip(windows, gradients, strict=True):
            window.grad = None if gradient is None else fn(gradient)
        super()._apply(fn, recurse=False)
        self._activate(self.n_rules)
        return self

    def _show(self, store: dict[str, Tensor]) -> None:
        """Let all windows show the table of a store, which becomes that of the network."""
        ends = [0, *accumulate(self.block_sizes)]
        for windows, rows in zip(self._windows, store["table"].split(self.parts), strict=True):
            for window, (start, end) in zip(windows, pairwise(ends), strict=True):
                window.grad = None  # it has the old type
                window.show(rows[:, start:end])
        table = store["table"]
        self._store, self._is_shared = store, not table.is_cuda and table.is_shared()
        self._seen = self._written()

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # two networks that grow in one table would tear it

    def __getstate__(self) -> dict[str, Any]:
        self._keep_widths()
        state = dict(self.__dict__)
        if not self._is_shared:  # the reserved memory stays behind
            state["_store"] = {k: s[..., : self.capacity].clone() for k, s in self._store.items()}
        return {name: value for name, value in state.items() if name not in VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        columns = self._store
        if columns["table"].is_cuda or not columns["table"].is_shared():  # a copy never is
            self._reserve(columns["table"])
            for name, values in columns.items():
                self._store[name][..., : self.capacity] = values[..., : self.capacity]
        self._show(self._store)
        self._activate(self.n_rules)

    def _save_to_state_dict(
        self, destination: dict[str, Any], prefix: str, keep_vars: bool
    ) -> None:
        self._keep_widths()
        super()._save_to_state_dict(destination, prefix, keep_vars)
        for name in COUNTED:  # torch.save would write all that the stores have reserved
            destination[prefix + name] = getattr(self, name).clone()

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """As for any module; the state of a whole network brings its own number of rules.

        A load that is refused changes nothing.
        """
        self._strict = strict  # torch tells no module
        try:
            return super().load_state_dict(state_dict, strict, assign)
        finally:
            self._strict = False

    @torch.no_grad()
    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Mapping[str, Any],
        strict: bool,
        missing: list[str],
        unexpected: list[str],
        errors: list[str],
    ) -> None:
        """Load what is given and fits, or nothing where any of it does not."""
        own = {key[len(prefix) :]: v for key, v in state_dict.items() if key.startswith(prefix)}
        if own and local_metadata.get("assign_to_params_buffers"):
            raise ValueError("load_state_dict(assign=True) would tear the table: leave it out")
        fit = loading.review(own, self.n_rules, self.block_sizes, self.parts, self.max_rules)
        missing += [prefix + name for name in fit.absent]
        unexpected += [prefix + name for name in fit.foreign]
        errors += [prefix + line for line in fit.wrong]
        if fit.wrong or (self._strict and (fit.absent or fit.foreign)):
            return
        self._shape_blocks(fit.sizes)
        self._activate(fit.rules)
        for name in own.keys() - set(fit.foreign):
            kind, _, number = name.removeprefix("blocks.").partition(".")
            if number:
                target = self._windows[KINDS.index(kind)][int(number)].data
            else:
                target = getattr(self, name)
            target.copy_(own[name])
