"""Many states at once: equations 1 and 2 multiplied out, so that one matrix product sums them.

The logarithm of a rule's firing strength is a polynomial in the state:

    ln F^k(x) = sum_i (-1 / 2 v_i^2) x_i^2 + (u_i / v_i^2) x_i - u_i^2 / 2 v_i^2

Hence for all states and rules it is the product of the `features` of the states and the `factors`
of the rules: `log_firing`. Inputs that wrap are listed in ``wrapping``: the number of the input,
1 / its period, its period.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

LARGE = 32  # states from which on one product is faster than differences state by state
PRECISION = 1e-4  # of the logarithm of a firing strength in such a product

Wrapping = Sequence[tuple[int, float, float]]


def features(x: Tensor, wrapping: Wrapping) -> Tensor:
    """What log firing is a product of, at states x (.., n). Shape: (.., 2n+1 and 2 a period).

    These are -x^2 / 2, x and -1/2. Where an input wraps, a centre more than half a turn away is
    nearer to x - t, one turn t further on, and gains t (x - t / 2 - u) / v^2.
    """
    y = _unwound(x, wrapping)
    parts = [-0.5 * y * y, y, torch.full_like(y[..., :1], -0.5)]
    for i, _, period in wrapping:
        angle = y[..., i : i + 1]
        t = torch.copysign(angle.new_tensor(period), angle.detach())
        parts += [t * (angle - 0.5 * t), -t]
    return torch.cat(parts, -1)


def factors(centres: Tensor, widths: Tensor, wrapping: Wrapping) -> Tensor:
    """What log firing is a product of, for each rule: 1 / v^2, u / v^2, sum u^2 / v^2.

    What cancels in the product is as large as the last, so they are in double precision where
    single would leave an error above `PRECISION` at states no farther out than the centres. The
    features must have the type of the factors.

    Args:
        centres: Shape: (n, K).
        widths: Shape: (n, K).
        wrapping: inputs that wrap.

    Returns:
        Shape: (2n+1, K).
    """
    u = _unwound(centres.T, wrapping).T
    precision = widths.square().reciprocal()
    weighted = precision * u
    constant = (weighted * u).sum(0, keepdim=True)
    error = 0.5 * constant.detach().max() * torch.finfo(u.dtype).eps
    if u.dtype != torch.double and _exceeds(error, PRECISION):
        return factors(centres.double(), widths.double(), wrapping)
    return torch.cat([precision, weighted, constant])


def _exceeds(error: Tensor, limit: float) -> bool:
    try:
        return bool(error > limit)
    except RuntimeError:  # inside torch.func.vmap a number cannot be asked for
        return True


def log_firing(features: Tensor, factors: Tensor, wrapping: Wrapping) -> Tensor:
    """Logarithm of equation 2 from the features (B, F) of states. Shape: (B, K)."""
    rows = len(factors)  # 2 n + 1
    lengths = (rows, *[2] * len(wrapping))
    whole, *turned = features.split_with_sizes(lengths, 1)
    if not turned:
        return whole @ factors
    # Only where it is nearer one turn further on does a rule gain from the turn.
    gained = [
        (part @ factors[i :: rows // 2][:2]).relu_()
        for part, (i, _, _) in zip(turned, wrapping, strict=True)
    ]
    return torch.addmm(sum(gained[1:], gained[0]), whole, factors)


def _unwound(values: Tensor, wrapping: Wrapping) -> Tensor:
    """Values (.., n) less whole turns, which have no gradient. Shape: (.., n)."""
    if wrapping:
        values = values.clone()
    for i, frequency, period in wrapping:
        angle = values.detach().select(-1, i)
        angle.sub_((angle * frequency).round_().mul_(period))
    return values
