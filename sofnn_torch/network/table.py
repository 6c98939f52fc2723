"""What fuzzy rules learn: the steps of learning in their table, and rules that come and go.

Each number has its eligibility trace beside it. How rules fire and where they are added is told in
`sofnn_torch.network.sofnn`, what they learn from in `sofnn_torch.learners`, and where all numbers
are kept in `sofnn_torch.network.store`.
"""

import math

import torch
from torch import Tensor

from sofnn_torch.network.store import RuleStore


class RuleTable(RuleStore):
    """Rules that learn; `RuleStore` describes what they hold and its arguments.

    Attributes:
        given: the first so many rules learn at other rates, see `given_rate`.
        given_rate: factor of the learning rates of the given rules; 0 keeps them as they are.
    """

    given = 0
    given_rate = 1.0

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
        parameters.addcmul_(self._own(rates), traces, value=error)
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
        parameters.add_(self._own(rates) * gradient / mass.clamp(min=1.0))

    def _own(self, rates: Tensor) -> Tensor:
        """Learning rates (rows, 1), or (rows, K) where given rules have others."""
        if not self.given or self.given_rate == 1.0:
            return rates
        factors = rates.new_ones(self.n_rules)
        factors[: self.given] = self.given_rate
        return rates * factors

    def clamp_consequents(self, first: int, last: int, low: float, high: float) -> None:
        """Keep the consequents first..last-1 of every rule between low and high."""
        self._consequents[first:last].clamp_(low, high)

    # -------------------------------------------------------------------- rules that come and go

    def _append(self, parts: tuple[Tensor, Tensor, Tensor], labels: Tensor | None) -> None:
        """Add one rule at the end.

        Args:
            parts: its centres (n,), widths (n,) and consequents (m,).
            labels: which shared membership function each input uses; a new one each if None.
                Shape: (n,).

        Raises:
            ValueError: a shape is another, a value is not finite or a width is not positive, or
                other processes share the memory.
        """
        if [part.shape for part in parts] != self._shapes_of_one:
            raise ValueError(
                f"a rule has {self.n_inputs} centres, {self.n_inputs} widths and "
                f"{self.n_outputs} consequents, got the shapes {[tuple(p.shape) for p in parts]}"
            )
        column = torch.cat(parts)
        if column.requires_grad:
            column = column.detach()
        k, n, numbers = self.n_rules, self.n_inputs, column.tolist()
        if not (math.isfinite(sum(map(abs, numbers))) and min(numbers[n : 2 * n]) > 0):
            raise ValueError(f"a rule needs finite numbers and positive widths: {numbers}")
        if self._is_shared:
            self._check_alone()
        if k == self.capacity:
            self._shape_blocks(self._sizes_for(k + 1))
        if self._followers:
            self._followers.clear([windows[-1] for windows in self._windows], k - self.capacity)
        self._store["table"].select(1, k).copy_(column)
        if self.shared:
            fresh = self.labels.amax(1) + 1 if k else 0
            self._store["labels"][:, k] = fresh if labels is None else labels
        self._activate(k + 1)

    @torch.no_grad()
    def prune(self, keep: Tensor) -> int:
        """Drop every rule where the mask keep (K,) is False; how many were dropped.

        Raises:
            ValueError: the mask has another length or would leave no rule, or other processes
                share the memory.
        """
        if keep.shape != (self.n_rules,) or not keep.any():
            raise ValueError(f"keep must be a mask of {self.n_rules} rules with at least one True")
        self._check_alone()
        before, kept = self.n_rules, keep.nonzero().flatten()
        self._rewrite(kept, {name: store[..., kept] for name, store in self._store.items()})
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
                ``max_rules``, or other processes share the memory. Nothing is changed then.
        """
        count, n = len(centres), self.n_inputs
        parts = [part.to(self._active) for part in (centres, widths, consequents)]
        shapes = [tuple(part.shape) for part in parts]
        if shapes != [(count, rows) for rows in self.parts] or not 1 <= count <= self.max_rules:
            raise ValueError(
                f"need 1 to {self.max_rules} rules with {n} centres, {n} widths and "
                f"{self.n_outputs} consequents each, got the shapes {shapes}"
            )
        table = torch.cat(parts, 1).T
        if not (table.isfinite().all() and (table[n : 2 * n] >= self.min_width).all()):
            raise ValueError(f"rules need finite numbers and widths of {self.min_width} or more")
        self._check_alone()
        labels = {"labels": self._labels_for(table)} if self.shared else {}
        self._rewrite(self.labels.new_empty(0), {"table": table} | labels)

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

    def _check_alone(self) -> None:
        if self._is_shared:
            raise ValueError("other processes share this network: no rule can be added or dropped")

    def _rewrite(self, kept: Tensor, columns: dict[str, Tensor]) -> None:
        """Make these columns the rules, with zeros in what is not given.

        Args:
            kept: numbers of the rules that become the first, which optimizers remember.
            columns: by the names of the stores.
        """
        for windows in self._windows:
            self._followers.select(windows, kept)
            for window in windows:
                window.grad = None  # of rules that have moved or are gone
        count = columns["table"].shape[1]
        self._shape_blocks(self._sizes_for(count))
        self._write(columns, count)
