"""Self-organizing fuzzy neural network (section 2 of the paper, equations 1-3).

One rule ``k`` owns one Gaussian membership function per input (centre ``u``, width ``v``) and a
vector of consequents ``c``. For a state ``x``:

    B_i^k(x_i) = exp(-((x_i - u_i^k) / v_i^k)^2 / 2)      membership        (eq. 1)
    F^k(x)     = prod_i B_i^k(x_i)                        firing strength   (eq. 2)
    S^k(x)     = F^k(x) / sum_l F^l(x)                    normalised firing
    y_j(x)     = sum_k S^k(x) c_j^k                       output            (eqs 4 and 10)

Rules are the columns of a table with ``2 n + m`` rows ``[u_1..u_n, v_1..v_n, c_1..c_m]``: with
the rules along the last axis every reduction over inputs is a vectorised sum, two to three times
faster at batch size 1 than one row per rule. The Parameters in ``blocks`` are windows side by side
into the one table; a full table appends a block as large as all before it together, so adding a
rule costs a constant time on average, no Parameter is ever replaced, and no pass over the rules
has to join the blocks first.
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

Growth = Literal["rule", "input", "literal", "frozen"]
VIEWS = {"_active", "_centres", "_widths", "_consequents", "_traces", "_consequent_traces"}
VIEWS |= {"_usage", "_learning"}
BATCH = 32  # states from which on one product is faster than differences state by state
PRECISION = 1e-4  # of the logarithm of a firing strength in such a product


class SOFNN(nn.Module):
    """Fuzzy network that adds a rule where no existing membership reaches ``theta``.

    | Symbol | Shape | Meaning |
    | --- | --- | --- |
    | ``n``, ``m``, ``K``, ``B`` | | inputs, outputs, rules, batch |
    | ``centres``, ``widths`` | (K, n) | antecedents ``u``, ``v`` in the units of the input |
    | ``consequents`` | (K, m) | ``c``, what the rules conclude |
    | ``traces`` | (2n+m, K) | eligibility trace of each parameter, kept beside it |
    | ``usage`` | (K,) | sum of the normalised firing since it was last cleared |

    Args:
        n_inputs: number of inputs ``n``.
        n_outputs: number of consequents per rule ``m``.
        width: width given to new membership functions, one for all inputs or one each.
        theta: growth threshold ``theta_th`` of equation 3, in (0, 1).
        growth: reading of equation 3. ``rule``: a rule is added when no rule's firing strength
            reaches theta. ``input``: an input whose memberships all stay under theta gets a new
            membership function, and each newly met combination of best membership functions
            becomes a rule. ``literal``: a rule is added when no membership of any input
            reaches theta. ``frozen``: the structure never changes (FSFNN).
        periods: period of each input, 0 for an input that does not wrap (2 pi for an angle).
        initial: consequents of a new rule, one for all or one each.
        interpolate: give a new rule the network's present output instead of ``initial``, so that
            the output at its centre does not change; one for all consequents or one each (the
            first rule always gets ``initial``).
        max_rules: no rule is added beyond this many; ``refused`` counts the attempts.
        min_width: lower bound of adapted widths.
        block_size: rules in the first block.

    Raises:
        ValueError: a setting is out of range; the message says which and what to do.
    """

    def __init__(
        self,
        n_inputs: int,
        n_outputs: int,
        *,
        width: float | Sequence[float],
        theta: float = 0.4,
        growth: Growth = "rule",
        periods: Sequence[float] | None = None,
        initial: float | Sequence[float] = 0.0,
        interpolate: bool | Sequence[bool] = True,
        max_rules: int = 100_000,
        min_width: float = 1e-3,
        block_size: int = 1024,
        dtype: torch.dtype = torch.float32,
    ):
        super().__init__()
        if n_inputs < 1 or n_outputs < 1:
            raise ValueError("a network needs at least one input and one output")
        if not 0.0 < theta < 1.0:
            raise ValueError(f"theta must lie between 0 and 1, got {theta}")
        if growth not in ("rule", "input", "literal", "frozen"):
            raise ValueError(f"growth must be rule, input, literal or frozen, got {growth!r}")
        if max_rules < 1 or block_size < 1:
            raise ValueError("max_rules and block_size must be at least 1")
        self.n_inputs, self.n_outputs = n_inputs, n_outputs
        self.growth, self.max_rules = growth, max_rules
        self.theta, self.log_theta = theta, math.log(theta)
        self.min_width, self.block_size, self.refused = min_width, block_size, 0
        self.max_firing = 0.0  # at the last state observed

        def per(values, count: int, name: str) -> Tensor:
            row = torch.as_tensor(values, dtype=dtype).flatten()
            if len(row) not in (1, count) or not row.isfinite().all():
                raise ValueError(f"{name} must be one finite number or {count} of them: {values}")
            return row.expand(count).clone()

        self.register_buffer("default_width", per(width, n_inputs, "width"), persistent=False)
        self.register_buffer("initial", per(initial, n_outputs, "initial"), persistent=False)
        mask = per(interpolate, n_outputs, "interpolate").bool()
        self.register_buffer("interpolate", mask, persistent=False)
        self.interpolates = bool(mask.any())
        periods = per(0.0 if periods is None else periods, n_inputs, "periods")[:, None]
        if not (self.default_width >= min_width).all():
            raise ValueError(f"every width must be at least {min_width}, got {width}")
        if (periods < 0).any():
            raise ValueError("a period is positive, or 0 for an input that does not wrap")
        self.register_buffer("periods", periods, persistent=False)  # (n, 1)
        frequencies = torch.where(periods > 0, 1 / periods, 0)
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.wrapping = [
            (i, (1 / period).item(), period.item())
            for i, period in enumerate(periods)
            if period > 0
        ]
        self.lengths = (2 * n_inputs + 1, *[2] * len(self.wrapping))  # of the features
        self.parts = (n_inputs, n_inputs, n_outputs)  # rows of u, v and c in the table
        rows = sum(self.parts)
        self.register_buffer("traces_store", torch.zeros(rows, 0, dtype=dtype))
        self.register_buffer("usage_store", torch.zeros(0, dtype=dtype))
        self.register_buffer("labels_store", torch.zeros(n_inputs, 0, dtype=torch.long))
        self._allocate([])

    # ---------------------------------------------------------------- inference, eqs 1, 2, 4, 10

    def table(self) -> Tensor:
        """All parameters of the active rules, differentiable. Shape: (2n+m, K)."""
        if self.n_rules == 0:
            raise ValueError("the network has no rules yet: call grow(x) or add_rule(centre)")
        if not torch.is_grad_enabled():
            return self._active
        whole = self.blocks[0] if len(self.blocks) == 1 else torch.cat(list(self.blocks), 1)
        return whole[:, : self.n_rules]

    def log_memberships(self, x: Tensor) -> Tensor:
        """Logarithm of equation 1 for x of shape (B, n). Shape: (B, n, K)."""
        centres, widths, _ = self.table().split_with_sizes(self.parts)
        return -0.5 * self._squares(x, centres, widths)

    def firing_strengths(self, x: Tensor) -> Tensor:
        """Firing strengths F of equation 2 for x of shape (B, n). Shape: (B, K)."""
        return self.log_memberships(x).sum(-2).exp()

    def normalised_firing(self, x: Tensor, antecedents: Sequence[Tensor] | None = None) -> Tensor:
        """Normalised firing S for x of shape (B, n). Shape: (B, K).

        Computed in log space, so that a state far from every rule is still answered by the
        nearest ones where a product of memberships would underflow to 0 / 0.

        Args:
            x: states, or one state (n,) for one row (K,).
            antecedents: centres and widths, each (n, K); those of the network if None.
        """
        centres, widths = antecedents or self.table().split_with_sizes(self.parts)[:2]
        if x.dim() == 2 and len(x) >= BATCH:
            product = self._multiplied_out(self.features(x), self._quadratic(centres, widths))
            return product.to(x.dtype).softmax(-1)
        return (-0.5 * self._squares(x, centres, widths).sum(-2)).softmax(-1)

    def firing_function(self) -> Callable[[Tensor], Tensor]:
        """The normalised firing as a function of `features` (.., F), while the antecedents stay.

        What depends on the antecedents alone is computed once, without a gradient.
        """
        quadratic = self._quadratic(self._centres, self._widths)

        def firing(features: Tensor) -> Tensor:
            flat = features.reshape(-1, features.shape[-1])
            product = self._multiplied_out(flat, quadratic).to(features.dtype)
            return product.softmax(-1).reshape(*features.shape[:-1], -1)

        return firing

    def forward(self, x: Tensor) -> Tensor:
        """Weighted mean of the consequents (eqs 4, 10) for x of shape (B, n). Shape: (B, m)."""
        centres, widths, consequents = self.table().split_with_sizes(self.parts)
        return self.normalised_firing(x, (centres, widths)) @ consequents.T

    def conclude(self, firing: Tensor) -> Tensor:
        """Outputs (m,) at a state whose normalised firing (K,) is known."""
        return self._consequents @ firing

    def _squares(self, x: Tensor, centres: Tensor, widths: Tensor) -> Tensor:
        """((x - u) / v)^2 for x of shape (..., n). Shape: (..., n, K)."""
        difference = x.unsqueeze(-1) - centres
        tracked = difference.requires_grad or widths.requires_grad
        for i, frequency, period in self.wrapping:  # whole turns have no gradient
            angle = (difference.detach() if tracked else difference).select(-2, i)
            angle.sub_((angle * frequency).round_(), alpha=period)
        if tracked:
            return (difference / widths).square()
        return difference.div_(widths).square_()  # new memory costs as much as the arithmetic

    def features(self, x: Tensor) -> Tensor:
        """What log firing is a product of, at states x (.., n). Shape: (.., 2n+1 and 2 a period).

        These are x^2, x and 1. Where an input wraps, a centre more than half a turn away is nearer
        by 2 t (x - u - t / 2) / v^2 to x - t, one turn t further on: hence t^2 - 2 t x and t.
        """
        y = x - self._turns(x)
        parts = [y * y, y, torch.ones_like(y[..., :1])]
        for i, _, period in self.wrapping:
            angle = y[..., i : i + 1]
            t = torch.copysign(angle.new_tensor(period), angle.detach())
            parts += [t * (t - 2 * angle), -t]
        return torch.cat(parts, -1)

    def _quadratic(self, centres: Tensor, widths: Tensor) -> Tensor:
        """Log firing of every rule as a polynomial in x: factors of x^2, x and 1. Shape: (2n+1, K).

        What cancels in it is as large as (u / v)^2 / 2, so it is in double precision where single
        would leave an error above `PRECISION`.
        """
        u = centres - self._turns(centres.T).T
        if 0.5 * (u / widths).square().sum(0).max() * torch.finfo(u.dtype).eps > PRECISION:
            u, widths = u.double(), widths.double()
        precision = widths.square().reciprocal()
        weighted = precision * u
        constant = (weighted * u).sum(0, keepdim=True)
        return torch.cat([-0.5 * precision, weighted, -0.5 * constant])

    def _multiplied_out(self, features: Tensor, quadratic: Tensor) -> Tensor:
        """Log firing of every rule from the features (B, F) of states. Shape: (B, K)."""
        whole, *turned = features.to(quadratic).split_with_sizes(self.lengths, 1)
        if not turned:
            return whole @ quadratic
        # Only where it is nearer one turn further on does a rule gain from the turn.
        gained = [
            (part @ quadratic[i :: self.n_inputs][:2]).relu_()
            for part, (i, _, _) in zip(turned, self.wrapping, strict=True)
        ]
        return torch.addmm(sum(gained[1:], gained[0]), whole, quadratic)

    def _turns(self, values: Tensor) -> Tensor:
        """The whole turns in values (.., n), which have no gradient. Shape: (.., n)."""
        return (values.detach() * self.frequencies.T).round_() * self.periods.T

    # ------------------------------------------------------------------------- structure, eq. 3

    def observe(self, x: Tensor) -> Tensor:
        """Add at most one rule at the state x (n,) by equation 3; its normalised firing (K,).

        The one pass over the rules that a learning step needs: growth test and firing share the
        memberships. Counts the firing in ``usage``.
        """
        if self.n_rules == 0:
            self.add_rule(x)
        firing = self._grow(x).softmax(0)
        self._usage.add_(firing)
        return firing

    def grow(self, x: Tensor) -> bool:
        """Add at most one rule at the state x of shape (n,) by equation 3; True if one was."""
        if self.n_rules == 0:
            return self.growth != "frozen" and self.add_rule(x)
        before = self.n_rules
        self._grow(x)
        return self.n_rules > before

    def _grow(self, x: Tensor) -> Tensor:
        """Apply equation 3; the logarithm of every rule's firing strength at x. Shape: (K,)."""
        squares = self._squares(x, self._centres, self._widths)
        log_firing = squares.sum(0).mul_(-0.5)
        best = log_firing.max().item()
        self.max_firing = math.exp(best)
        if self.growth == "rule":
            added = best < self.log_theta and self.add_rule(x, log_firing=log_firing)
        elif self.growth == "literal":
            nearest = -0.5 * squares.min().item()
            added = nearest < self.log_theta and self.add_rule(x, log_firing=log_firing)
        else:
            added = self.growth == "input" and self._combine(x, squares.mul_(-0.5))
        if not added:
            return log_firing
        if self.growth == "input":  # the new rule is centred on other rules' memberships
            newest = self._squares(x, self._centres[:, -1:], self._widths[:, -1:])
            return torch.cat([log_firing, newest.sum(0).mul_(-0.5)])
        return torch.cat([log_firing, log_firing.new_zeros(1)])  # centred on x

    def _combine(self, x: Tensor, log_memberships: Tensor) -> bool:
        """Criterion ``input``: labels say which rules share a membership function."""
        best, rule = log_memberships.max(1)
        inputs = torch.arange(self.n_inputs, device=x.device)
        is_new = best < self.log_theta
        labels = torch.where(is_new, self.labels.amax(1) + 1, self.labels[inputs, rule])
        if (self.labels == labels[:, None]).all(0).any():
            return False
        centre = torch.where(is_new, x, self._centres[inputs, rule])
        width = torch.where(is_new, self.default_width, self._widths[inputs, rule])
        return self.add_rule(centre, width, labels=labels)

    def add_rule(
        self,
        centre: Tensor,
        width: Tensor | None = None,
        consequents: Tensor | None = None,
        labels: Tensor | None = None,
        log_firing: Tensor | None = None,
    ) -> bool:
        """Append one rule with its traces and counters; False at the cap ``max_rules``.

        Args:
            centre: centres of its membership functions. Shape: (n,).
            width: their widths; the configured ones if None. Shape: (n,).
            consequents: the configured or interpolated ones if None. Shape: (m,).
            labels: which shared membership function each input uses; a new one each if None.
                Shape: (n,).
            log_firing: logarithm of the firing strengths at the centre, if known. Shape: (K,).

        Raises:
            ValueError: a value is not finite or a width is not positive.
        """
        k = self.n_rules
        if k >= self.max_rules:
            self.refused += 1
            return False
        width = self.default_width if width is None else width
        if consequents is None:
            consequents = self._first_consequents(centre, log_firing)
        column = torch.cat([centre, width, consequents])
        numbers, n = column.tolist(), self.n_inputs
        if not (math.isfinite(sum(map(abs, numbers))) and min(numbers[n : 2 * n]) > 0):
            raise ValueError(f"a rule needs finite numbers and positive widths: {numbers}")
        if k == self.capacity:
            self._append_block(max(k, self.block_size))
        self._whole.select(1, k).copy_(column)
        if self.growth == "input":
            fresh = self.labels.amax(1) + 1 if k else torch.zeros_like(self.labels_store[:, 0])
            self.labels_store[:, k] = fresh if labels is None else labels
        self._activate(k + 1)
        return True

    def _first_consequents(self, centre: Tensor, log_firing: Tensor | None) -> Tensor:
        """The configured consequents, or where so configured the present output. Shape: (m,)."""
        if self.n_rules == 0 or not self.interpolates:
            return self.initial
        if log_firing is None:
            firing = self.normalised_firing(centre, (self._centres, self._widths))
        else:
            firing = log_firing.softmax(0)
        return torch.where(self.interpolate, self.conclude(firing), self.initial)

    @torch.no_grad()
    def prune(self, keep: Tensor) -> int:
        """Drop every rule where the mask keep (K,) is False; how many were dropped.

        Raises:
            ValueError: the mask has another length or would leave no rule.
        """
        if keep.shape != (self.n_rules,) or not keep.any():
            raise ValueError(f"keep must be a mask of {self.n_rules} rules with at least one True")
        table = self._active[:, keep]
        stores = [s[..., : self.n_rules][..., keep] for s in self._stores()]
        dropped, kept = self.n_rules - table.shape[1], table.shape[1]
        self._allocate([max(kept, self.block_size)])
        self._whole[:, :kept] = table
        for store, values in zip(self._stores(), stores, strict=True):
            store[..., :kept] = values
        self._activate(kept)
        return dropped

    @torch.no_grad()
    def replace_rules(self, centres: Tensor, widths: Tensor, consequents: Tensor) -> None:
        """Put these rules, for example edited ones, in the place of all; traces and usage are zero.

        With the growth criterion ``input`` a membership function that was there before keeps its
        label, and rules whose centre and width on an input are equal share one.

        Args:
            centres: Shape: (K, n).
            widths: Shape: (K, n).
            consequents: Shape: (K, m).

        Raises:
            ValueError: a shape or number that no rule may have, no rule, more than ``max_rules``,
                or another number of rules than a frozen structure has. Nothing is changed then.
        """
        count, n = len(centres), self.n_inputs
        parts = [part.to(self._whole) for part in (centres, widths, consequents)]
        shapes = [tuple(part.shape) for part in parts]
        if shapes != [(count, rows) for rows in self.parts] or not 1 <= count <= self.max_rules:
            raise ValueError(
                f"need 1 to {self.max_rules} rules with {n} centres, {n} widths and "
                f"{self.n_outputs} consequents each, got the shapes {shapes}"
            )
        if self.growth == "frozen" and self.n_rules not in (0, count):
            raise ValueError(f"a frozen structure keeps its {self.n_rules} rules, got {count}")
        table = torch.cat(parts, 1).T
        if not (table.isfinite().all() and (table[n : 2 * n] >= self.min_width).all()):
            raise ValueError(f"rules need finite numbers and widths of {self.min_width} or more")
        labels = self._labels_for(table) if self.growth == "input" else 0
        self._allocate([max(count, self.block_size)])
        self._whole[:, :count] = table
        self.labels_store[:, :count] = labels
        self._activate(count)

    def _labels_for(self, table: Tensor) -> Tensor:
        """Which membership function each rule of another table (2n+m, K') uses. Shape: (n, K')."""
        n, k, labels = self.n_inputs, self.n_rules, []
        for i in range(n):
            both = torch.cat([self._whole[:, :k], table], 1)[[i, n + i]]
            functions, index = both.unique(dim=1, return_inverse=True)
            first = int(self.labels[i].max()) + 1 if k else 0
            label = torch.arange(first, first + functions.shape[1], device=table.device)
            label[index[:k]] = self.labels[i]
            labels.append(label[index[k:]])
        return torch.stack(labels)

    @property
    def capacity(self) -> int:
        """Rules that fit before the next block is appended."""
        return self.usage_store.shape[0]

    def _stores(self) -> tuple[Tensor, Tensor, Tensor]:
        """What every rule carries beside its parameters, rules along the last axis."""
        return self.traces_store, self.usage_store, self.labels_store

    def _append_block(self, size: int) -> None:
        self.blocks.append(nn.Parameter(self._whole.new_zeros(len(self._whole), size)))
        for name in ("traces_store", "usage_store", "labels_store"):
            store = getattr(self, name)
            setattr(self, name, torch.cat([store, store.new_zeros(*store.shape[:-1], size)], -1))
        self._join()

    def _allocate(self, sizes: Sequence[int]) -> None:
        self.blocks = nn.ParameterList()
        for name in ("traces_store", "usage_store", "labels_store"):
            setattr(self, name, getattr(self, name)[..., :0])
        self.n_rules = 0
        self._join()
        for size in sizes:
            self._append_block(size)

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

    def _apply(self, *arguments) -> "SOFNN":
        super()._apply(*arguments)  # to another device or type, block by block
        self._join()
        return self

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)  # a copy: the windows have become tables of their own
        self._join()

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

    # ---------------------------------------------------------------------------- views and state

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

    def statistics(self, max_firing: Sequence[float]) -> dict[str, float]:
        """Growth and use of the rules since the last call (docs/metrics.md).

        Args:
            max_firing: firing strength of the best rule at each state since then.
        """
        used = (self.usage > 0.01).float().mean().item()
        self.usage.zero_()
        return {
            "rules/max_firing_mean": sum(max_firing) / len(max_firing),
            "rules/max_firing_min": min(max_firing),
            "rules/share_used": used,
            "rules/refused": float(self.refused),
        }

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


def grid(
    lows: Sequence[float], highs: Sequence[float], shape: Sequence[int], n_outputs: int, **settings
) -> SOFNN:
    """Fixed-structure twin (FSFNN): a regular grid of rules whose structure is frozen.

    Args:
        lows: lower end of each input; a periodic input needs highs - lows = its period.
        highs: upper end of each input.
        shape: rules along each input, e.g. (12, 12, 8) for the paper's 1152.
        n_outputs: consequents per rule.
        **settings: keyword arguments of `SOFNN`; the default width is half the grid's spacing.

    Raises:
        ValueError: lengths differ, a range is empty or a count is not positive.
    """
    if not len(lows) == len(highs) == len(shape):
        raise ValueError(f"lows, highs and shape differ in length: {lows}, {highs}, {shape}")
    if any(s < 1 for s in shape) or any(h <= lo for lo, h in zip(lows, highs, strict=True)):
        raise ValueError(f"a grid needs positive counts and non-empty ranges: {shape}")
    spacing = [(h - lo) / s for lo, h, s in zip(lows, highs, shape, strict=True)]
    settings = {"width": [s / 2 for s in spacing], **settings, "growth": "frozen"}
    count = torch.Size(shape).numel()
    net = SOFNN(len(shape), n_outputs, block_size=count, max_rules=count, **settings)
    like = net.default_width
    axes = [
        lo + step * (torch.arange(s, dtype=torch.float64) + 0.5)
        for lo, step, s in zip(lows, spacing, shape, strict=True)
    ]
    centres = torch.cartesian_prod(*axes).reshape(count, len(shape)).to(like)
    net._allocate([count])
    columns = [centres, like.expand(count, -1), net.initial.expand(count, -1)]
    net._whole.copy_(torch.cat(columns, 1).T)
    net._activate(count)
    return net
