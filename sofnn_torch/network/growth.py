"""Equation 3: where a rule is missing. One class for each criterion; a new one is one class.

A criterion is asked once for each observed state, with what the network has already computed there:

    class Sparse(Criterion):  # a rule where fewer than three rules fire by theta
        def place(self, net, x, squares, log_firing, best):
            return Place(x) if (log_firing > self.log_theta).sum() < 3 else None

    SOFNN(3, 2, width=0.1, growth=Sparse(0.4))  # or growth="my_module:Sparse", theta=0.4
"""

import math
import pkgutil
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from sofnn_torch.network.sofnn import SOFNN


class Place(NamedTuple):
    """Where a new rule goes."""

    centre: Tensor
    """Centres of its membership functions. Shape: (n,)."""
    width: Tensor | None = None
    """Their widths; the configured ones if None. Shape: (n,)."""
    labels: Tensor | None = None
    """Which shared membership function each input uses; a new one each if None. Shape: (n,)."""


class Criterion(ABC):
    """A reading of equation 3: whether the network lacks a rule at a state, and where it goes.

    Args:
        theta: growth threshold ``theta_th``, in (0, 1).

    Raises:
        ValueError: theta is out of range.

    Examples:
        A rule wherever the present ones are not at home, but never more than a hundred:

        >>> class Frugal(Rule):
        ...     def place(self, net, x, squares, log_firing, best):
        ...         full = net.n_rules >= 100
        ...         return None if full else super().place(net, x, squares, log_firing, best)
        >>> from sofnn_torch import SOFNN
        >>> net = SOFNN(1, 1, width=0.1, growth=Frugal(0.5))
    """

    grows = True
    """False: the structure is frozen, not even a first rule is added."""
    shared = False
    """True: rules may share membership functions, and `RuleTable.labels` tells which."""

    def __init__(self, theta: float):
        if not 0.0 < theta < 1.0:
            raise ValueError(f"theta must lie between 0 and 1, got {theta}")
        self.theta, self.log_theta = theta, math.log(theta)

    @property
    def name(self) -> str:
        """How `criterion` finds its class."""
        kind = type(self)
        known = (name for name, built_in in BUILT_IN.items() if built_in is kind)
        return next(known, f"{kind.__module__}:{kind.__qualname__}")

    @abstractmethod
    def place(
        self, net: "SOFNN", x: Tensor, squares: Tensor, log_firing: Tensor, best: float
    ) -> Place | None:
        """Where a rule is missing at the state x, None where none is. The network has rules.

        Args:
            net: the network.
            x: the state. Shape: (n,).
            squares: ((x - u) / v)^2 of every membership function. Shape: (n, K).
            log_firing: logarithm of every rule's firing strength (eq. 2). Shape: (K,).
            best: the largest of them.
        """


class Rule(Criterion):
    """A rule is added at x when no rule's firing strength reaches theta.

    Examples:
        >>> from sofnn_torch import SOFNN
        >>> net = SOFNN(2, 1, width=0.1, growth="rule")
        >>> states = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [0.3, 0.3]])
        >>> grown = [net.grow(state) for state in states]
        >>> net.n_rules
        4
    """

    def place(  # noqa: D102
        self, net: "SOFNN", x: Tensor, squares: Tensor, log_firing: Tensor, best: float
    ) -> Place | None:
        return Place(x) if best < self.log_theta else None


class Literal(Criterion):
    """A rule is added at x when no membership of any input reaches theta.

    Examples:
        >>> from sofnn_torch import SOFNN
        >>> net = SOFNN(2, 1, width=0.1, growth="literal")
        >>> states = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [0.3, 0.3]])
        >>> grown = [net.grow(state) for state in states]
        >>> net.n_rules
        2
    """

    def place(  # noqa: D102
        self, net: "SOFNN", x: Tensor, squares: Tensor, log_firing: Tensor, best: float
    ) -> Place | None:
        return Place(x) if -0.5 * squares.min().item() < self.log_theta else None


class Input(Criterion):
    """Each input by itself.

    An input whose memberships all stay under theta gets a new membership function, and each newly
    met combination of best membership functions becomes a rule.

    Examples:
        >>> from sofnn_torch import SOFNN
        >>> net = SOFNN(2, 1, width=0.1, growth="input")
        >>> states = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [0.3, 0.3]])
        >>> grown = [net.grow(state) for state in states]
        >>> net.n_rules
        4
    """

    shared = True

    def place(  # noqa: D102
        self, net: "SOFNN", x: Tensor, squares: Tensor, log_firing: Tensor, best: float
    ) -> Place | None:
        log_membership, rule = (-0.5 * squares).max(1)
        inputs = torch.arange(len(x), device=x.device)
        is_new = log_membership < self.log_theta
        labels = torch.where(is_new, net.labels.amax(1) + 1, net.labels[inputs, rule])
        if (net.labels == labels[:, None]).all(0).any():
            return None
        centre = torch.where(is_new, x, net.centres[rule, inputs])
        width = torch.where(is_new, net.default_width, net.widths[rule, inputs])
        return Place(centre, width, labels)


class Frozen(Criterion):
    """The structure never changes (FSFNN).

    Examples:
        >>> from sofnn_torch import SOFNN
        >>> net = SOFNN(2, 1, width=0.1, growth="frozen")
        >>> states = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [0.3, 0.3]])
        >>> grown = [net.grow(state) for state in states]
        >>> net.n_rules
        0
    """

    grows = False

    def place(  # noqa: D102
        self, net: "SOFNN", x: Tensor, squares: Tensor, log_firing: Tensor, best: float
    ) -> Place | None:
        return None


BUILT_IN: dict[str, type[Criterion]] = {
    "rule": Rule,
    "input": Input,
    "literal": Literal,
    "frozen": Frozen,
}


def criterion(growth: str | Criterion, theta: float) -> Criterion:
    """The criterion itself, or one made with theta from its name.

    Args:
        growth: a criterion, a name in `BUILT_IN`, or ``module:Class``.
        theta: growth threshold of one that is given by name.

    Raises:
        ValueError: there is no such criterion, or theta is out of range.
    """
    if isinstance(growth, Criterion):
        return growth
    kind = BUILT_IN.get(growth)
    if kind is None:
        choices = f"{', '.join(BUILT_IN)} or module:Class"
        if not isinstance(growth, str) or ":" not in growth:
            raise ValueError(f"no growth criterion {growth!r}: give {choices}")
        try:
            kind = pkgutil.resolve_name(growth)
        except Exception as error:  # a module may raise anything when it is imported
            reason = " ".join(str(error).split())
            raise ValueError(f"no growth criterion {growth!r} ({reason}): give {choices}") from None
        if not (isinstance(kind, type) and issubclass(kind, Criterion)):
            raise ValueError(f"{growth} is no class of {__name__}.Criterion: give {choices}")
    try:
        return kind(theta)
    except TypeError as error:  # it has no place(), or asks for more
        raise ValueError(f"{growth} cannot be made from theta alone: {error}") from None
