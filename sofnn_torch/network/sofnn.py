"""Self-organizing fuzzy neural network (section 2 of the paper, equations 1-4 and 10).

One rule ``k`` owns one Gaussian membership function per input (centre ``u``, width ``v``) and a
vector of consequents ``c``. For a state ``x``:

    B_i^k(x_i) = exp(-((x_i - u_i^k) / v_i^k)^2 / 2)      membership        (eq. 1)
    F^k(x)     = prod_i B_i^k(x_i)                        firing strength   (eq. 2)
    S^k(x)     = F^k(x) / sum_l F^l(x)                    normalised firing
    y_j(x)     = sum_k S^k(x) c_j^k                       output            (eqs 4 and 10)

A rule is added where equation 3 says that none covers the state. The numbers of the rules, their
traces and the steps of learning in them are in `sofnn_torch.network.table`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sofnn_torch.network import batches
from sofnn_torch.network.axes import Axis, named
from sofnn_torch.network.growth import Criterion, criterion
from sofnn_torch.network.table import RuleTable


class SOFNN(RuleTable):
    """Fuzzy network that adds a rule where no existing membership reaches ``theta``.

    `RuleStore` describes what the rules hold. Letters in shapes: ``n`` inputs, ``m`` outputs, ``K``
    rules, ``B`` states in a batch, ``F`` features of a state.

    Args:
        inputs: the axes of the ``n`` inputs, or how many: then they are called x1, x2, ...
            and none has ends or wraps.
        n_outputs: number of consequents per rule ``m``.
        width: width given to new membership functions, one for all inputs or one each.
        theta: growth threshold ``theta_th`` of equation 3, in (0, 1).
        growth: criterion of equation 3: ``rule``, ``input``, ``literal``, ``frozen`` (the structure
            never changes), ``module:Class``, or a `Criterion` (`sofnn_torch.network.growth`), which
            brings its own theta.
        initial: consequents of a new rule, one for all or one each.
        interpolate: give a new rule the network's present output instead of ``initial``, so that
            the output at its centre does not change; one for all consequents or one each (the
            first rule always gets ``initial``).
        max_rules: no rule is added beyond this many; ``refused`` counts the attempts.
        min_width: lower bound of adapted widths.
        block_size: rules in the first block.
        dtype: of the parameters.

    Raises:
        ValueError: a setting is out of range; the message says which and what to do.

    Examples:
        >>> net = SOFNN(2, 1, width=0.2)
        >>> [net.grow(torch.tensor(x)) for x in ([0.1, 0.1], [0.1, 0.2], [0.9, 0.9])]
        [True, False, True]
        >>> net(torch.tensor([[0.5, 0.5]])).shape
        torch.Size([1, 1])
    """

    def __init__(
        self,
        inputs: int | Sequence[Axis],
        n_outputs: int,
        *,
        width: float | Sequence[float],
        theta: float = 0.4,
        growth: str | Criterion = "rule",
        initial: float | Sequence[float] = 0.0,
        interpolate: bool | Sequence[bool] = True,
        max_rules: int = 100_000,
        min_width: float = 1e-3,
        block_size: int = 32,
        dtype: torch.dtype = torch.float32,
    ):
        self.axes, chosen = named(inputs), criterion(growth, theta)
        n_inputs = len(self.axes)
        super().__init__(
            n_inputs,
            n_outputs,
            max_rules=max_rules,
            min_width=min_width,
            block_size=block_size,
            shared=chosen.shared,
            dtype=dtype,
        )
        self.criterion, self.growth, self.theta = chosen, chosen.name, chosen.theta
        self.max_firing = 0.0  # at the last state observed

        def per(values: float | Sequence[float], count: int, name: str) -> Tensor:
            row = torch.as_tensor(values, dtype=dtype).flatten()
            if len(row) not in (1, count) or not row.isfinite().all():
                raise ValueError(f"{name} must be one finite number or {count} of them: {values}")
            return row.expand(count).clone()

        self.register_buffer("default_width", per(width, n_inputs, "width"), persistent=False)
        self.register_buffer("initial", per(initial, n_outputs, "initial"), persistent=False)
        mask = per(interpolate, n_outputs, "interpolate").bool()
        self.register_buffer("interpolate", mask, persistent=False)
        self.interpolates = bool(mask.any())
        if not (self.default_width >= min_width).all():
            raise ValueError(f"every width must be at least {min_width}, got {width}")
        periods = torch.tensor([[axis.period] for axis in self.axes], dtype=dtype)
        self.register_buffer("periods", periods, persistent=False)  # (n, 1)
        self.wrapping: batches.Wrapping = [
            (i, (1 / period).item(), period.item())
            for i, period in enumerate(periods)
            if period > 0
        ]

    # ---------------------------------------------------------------- inference, eqs 1, 2, 4, 10

    def log_memberships(self, x: Tensor) -> Tensor:
        """Logarithm of equation 1 for x of shape (B, n). Shape: (B, n, K)."""
        centres, widths, _ = self.joined()
        return -0.5 * self._squares(self._states(x), centres, widths)

    def firing_strengths(self, x: Tensor) -> Tensor:
        """Firing strengths F of equation 2 for x of shape (B, n). Shape: (B, K)."""
        return self.log_memberships(x).sum(-2).exp()

    def normalised_firing(self, x: Tensor, antecedents: Sequence[Tensor] | None = None) -> Tensor:
        """Normalised firing S for x of shape (B, n). Shape: (B, K).

        Computed in log space, so that a state far from every rule is still answered by the
        nearest ones where a product of memberships would underflow to 0 / 0.

        Args:
            x: states, or one state (n,) for one row (K,), of any type.
            antecedents: centres and widths, each (n, K); those of the network if None.

        Raises:
            ValueError: a state has another length, or the network has no rules.
        """
        centres, widths = antecedents or self.joined()[:2]
        x = self._states(x)
        # Compiled or exported there is one way for any number of states.
        if x.dim() == 2 and not torch.compiler.is_compiling() and len(x) >= batches.LARGE:
            if torch.is_autocast_enabled(x.device.type):  # what cancels needs all its digits
                with torch.autocast(x.device.type, enabled=False):
                    return self.normalised_firing(x, (centres, widths))
            factors = batches.factors(centres.double(), widths.double(), self.wrapping)
            features = batches.features(x.to(factors), self.wrapping)
            log_firing = batches.log_firing(features, factors, self.wrapping)
        else:
            log_firing = -0.5 * self._squares(x, centres, widths).sum(-2)
        return _normalised(log_firing, centres.dtype)

    def firing_functions(self) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
        """The normalised firing in two steps, while the antecedents stay.

        What depends on the antecedents alone is computed once, without a gradient.

        Returns:
            A function from states (.., n) to their features (.., F), and one from features to the
            normalised firing (.., K).
        """
        self._keep_widths()
        factors = batches.factors(self._centres, self._widths, self.wrapping)

        def features(x: Tensor) -> Tensor:
            return batches.features(x.to(factors), self.wrapping)

        def firing(features: Tensor) -> Tensor:
            flat = features.reshape(-1, features.shape[-1])
            log_firing = batches.log_firing(flat, factors, self.wrapping)
            return log_firing.softmax(-1).to(self._centres).reshape(*features.shape[:-1], -1)

        return features, firing

    def forward(self, x: Tensor) -> Tensor:
        """Weighted mean of the consequents (eqs 4, 10) for x of shape (B, n). Shape: (B, m)."""
        centres, widths, consequents = self.joined()
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
        difference.div_(widths)  # new memory costs as much as the arithmetic
        return difference.mul_(difference)

    # ------------------------------------------------------------------------- structure, eq. 3

    def observe(self, x: Tensor) -> Tensor:
        """Add at most one rule at the state x (n,) by equation 3; its normalised firing (K,).

        The one pass over the rules that a learning step needs: growth test and firing share the
        memberships. Counts the firing in ``usage``.

        Raises:
            ValueError: a frozen network has no rules.
        """
        if self.n_rules == 0 and not self.grow(x):
            raise ValueError("the network has no rules and may add none: build it with grid()")
        firing = _normalised(self._grow(x), self._usage.dtype)
        self._usage.add_(firing)
        return firing

    def grow(self, x: Tensor) -> bool:
        """Add at most one rule at the state x of shape (n,) by equation 3; True if one was.

        Raises:
            ValueError: not one state of n numbers.
        """
        if self.n_rules == 0:
            return self.criterion.grows and self.add_rule(self._state(x))
        before = self.n_rules
        self._grow(x)
        return self.n_rules > before

    def _grow(self, x: Tensor) -> Tensor:
        """Apply equation 3; the logarithm of every rule's firing strength at x. Shape: (K,)."""
        x = self._state(x)
        self._keep_widths()
        squares = self._squares(x, self._centres, self._widths)
        log_firing = squares.sum(0).mul_(-0.5)
        best = log_firing.max().item()
        self.max_firing = math.exp(best)
        place = self.criterion.place(self, x, squares, log_firing, best)
        if place is None:
            return log_firing
        centre, width, labels = place
        here = centre is x
        known = log_firing if here else None
        if not self.add_rule(centre, width, labels=labels, log_firing=known):
            return log_firing
        if here:
            return torch.cat([log_firing, log_firing.new_zeros(1)])
        newest = self._squares(x, self._centres[:, -1:], self._widths[:, -1:])
        return torch.cat([log_firing, newest.sum(0).mul_(-0.5)])

    def _state(self, x: Tensor) -> Tensor:
        """One state (n,) in the type to compute with, without a gradient."""
        if x.shape != (self.n_inputs,):
            raise ValueError(f"a state of {self.n_inputs} numbers is needed, got {tuple(x.shape)}")
        x = self._precise(x)
        return x.detach() if x.requires_grad else x

    def _states(self, x: Tensor) -> Tensor:
        """States (.., n) in the type to compute with."""
        if not 0 < x.dim() < 3 or x.shape[-1] != self.n_inputs:
            shape = tuple(x.shape)
            raise ValueError(f"states (B, {self.n_inputs}) are needed, got the shape {shape}")
        return self._precise(x)

    def _precise(self, x: Tensor) -> Tensor:
        """States of any type in that of the network, but never in half precision."""
        dtype = self._store["table"].dtype  # a view is made anew after each rule
        if x.dtype == dtype and dtype.itemsize > 2:
            return x
        return x.to(torch.promote_types(dtype, torch.float32))

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
            ValueError: a shape is another, a value is not finite or a width is not positive.
        """
        centre = self._state(centre)
        if self.n_rules >= self.max_rules:
            self.refused += 1
            return False
        buffers: dict[str, Any] = self._buffers  # quicker than by attribute
        width = buffers["default_width"] if width is None else width
        if consequents is None:
            consequents = self._first_consequents(centre, log_firing)
        self._append((centre, width, consequents), labels)
        return True

    def _first_consequents(self, centre: Tensor, log_firing: Tensor | None) -> Tensor:
        """The configured consequents, or where so configured the present output. Shape: (m,)."""
        if self.n_rules == 0 or not self.interpolates:
            buffers: dict[str, Any] = self._buffers
            return buffers["initial"]
        if log_firing is None:
            firing = self.normalised_firing(centre, (self._centres, self._widths))
        else:
            firing = _normalised(log_firing, self._usage.dtype)
        return torch.where(self.interpolate, self.conclude(firing), self.initial)

    def replace_rules(self, centres: Tensor, widths: Tensor, consequents: Tensor) -> None:
        """Put these rules in the place of all: see `RuleTable.replace_rules`.

        Raises:
            ValueError: also if a frozen structure would get another number of rules, unless it
                was given by rules itself.
        """
        frozen = not self.criterion.grows and not self.given
        if frozen and self.n_rules not in (0, len(centres)):
            raise ValueError(
                f"a frozen structure keeps its {self.n_rules} rules, got {len(centres)}"
            )
        super().replace_rules(centres, widths, consequents)

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


def _normalised(log_firing: Tensor, dtype: torch.dtype) -> Tensor:
    """Softmax in the type of the logarithms, which may be too large for another."""
    firing = log_firing.softmax(-1)
    return firing if firing.dtype == dtype else firing.to(dtype)


def grid(axes: Sequence[Axis], shape: Sequence[int], n_outputs: int, **settings: Any) -> SOFNN:
    """Fixed-structure twin (FSFNN): a regular grid of rules whose structure is frozen.

    Args:
        axes: the inputs; the grid fills their ranges, for one that wraps a whole period.
        shape: rules along each input, e.g. (12, 12, 8) for the paper's 1152.
        n_outputs: consequents per rule.
        **settings: keyword arguments of `SOFNN`; the default width is half the grid's spacing.

    Raises:
        ValueError: lengths differ, an axis has no ends or a count is not positive.

    Examples:
        >>> pose = Axis("x", "m", 0, 1), Axis("y", "m", 0, 1)
        >>> grid(pose, (12, 12), n_outputs=3).n_rules
        144
    """
    if len(axes) != len(shape) or any(s < 1 for s in shape):
        raise ValueError(f"a grid over {len(axes)} axes needs as many positive counts, got {shape}")
    endless = [axis.name for axis in axes if not axis.bounded]
    if endless:
        raise ValueError(f"a grid needs axes with a low and a high end: {', '.join(endless)}")
    spacing = [(axis.high - axis.low) / s for axis, s in zip(axes, shape, strict=True)]
    settings = {"width": [s / 2 for s in spacing], **settings, "growth": "frozen"}
    count = torch.Size(shape).numel()
    net = SOFNN(axes, n_outputs, block_size=count, max_rules=count, **settings)
    places = [
        axis.low + step * (torch.arange(s, dtype=torch.float64) + 0.5)
        for axis, step, s in zip(axes, spacing, shape, strict=True)
    ]
    centres = torch.cartesian_prod(*places).reshape(count, len(shape))
    per_rule = [row.expand(count, -1) for row in (net.default_width, net.initial)]
    net.replace_rules(centres, *per_rule)
    return net
