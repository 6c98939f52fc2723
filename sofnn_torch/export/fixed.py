"""A policy in whole numbers: the tables of the C header of precision int16, and their model.

Everything is unsigned, 16 bits in the tables and 32 in between. For rule k at inputs x:

    r_i = |x_i - u_i| g_i / 2^16          distance over width, with F binary digits
    z   = sum_i r_i^2                     so that the firing strength is 2^-z, 2 F digits
    w   = 2^-(z - z0) * 65535             by a cubic for the fraction and a shift for the rest
    y_j = sum_k (w c_j / 2^S) / sum_k w   S such that no sum overflows

z0 is the whole part of the least z so far; where a nearer rule follows, the sums are shifted. So
the nearest rules answer far from all. An input that wraps takes all 16 bits, and wraps by itself.

What does not change the plain mean or greedy action is left out: sigma, the value, and of
Q-learning all that is the same for every action.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CUBIC = (45340, 15200, 2632)  # of 2^-f over [0, 1), in units of 2^-16: off by at most 7e-5
HALF, WHOLE = 2**15, 2**16
LEAST_DIGITS = 8  # of distances over widths
DIGITS_PER_WIDTH = math.sqrt(0.5 * math.log2(math.e))  # exp(-(d / v)^2 / 2) = 2^-(this d / v)^2

Integers = NDArray[np.uint32]


@dataclass(frozen=True)
class FixedPolicy:
    """Tables of whole numbers, and what the C code makes of them.

    Letters in shapes: ``n`` inputs, ``K`` rules, ``M`` conclusions: one for each number of an
    action, or each choice.

    Attributes:
        head: the neutral policy without its rules.
        scales: origin and step of each input, as in ``x = (value - origin) / step``.
        digits: F.
        shift: S.
        rules: n centres, n gains (one row for all rules if they share them), M conclusions.
            Shape: (K, 2n+M).
        ends: conclusions that stand for the edges between discrete actions, or for -1 and 1.
    """

    head: dict[str, Any]
    scales: list[list[float]]
    digits: int
    shift: int
    rules: Integers
    ends: list[int]

    @property
    def n(self) -> int:
        """Inputs of the rules."""
        return len(self.scales)

    @property
    def conclusions(self) -> int:
        """Conclusions M of a rule."""
        return self.rules.shape[1] - 2 * self.n

    @property
    def shared(self) -> bool:
        """Whether all rules have the same gains, which then stand in one row."""
        gains = self.rules[:, self.n : 2 * self.n]
        return bool((gains == gains[0]).all())

    @property
    def acting(self) -> bool:
        """Whether the action is an input of the rules."""
        return bool(self.head["decision"].get("action_input"))

    @property
    def codes(self) -> list[int]:
        """The actions as inputs, where they are."""
        codes = [code for (code,) in self.head["decision"]["codes"]]
        return _placed(np.array(codes)[:, None], self.scales[-1:], [0.0])[:, 0].tolist()

    def inputs(self, states: Any) -> Integers:
        """States (B, n) as the C code takes them."""
        periods = [axis["period"] for axis in self.head["axes"]]
        return _placed(np.asarray(states, float), self.scales[: len(periods)], periods)

    def act(self, x: Integers) -> Integers:
        """What the C code answers at inputs (B, n): numbers of actions (B,), or units (B, m)."""
        if self.acting:
            columns = [np.full((len(x), 1), code, np.uint32) for code in self.codes]
            means = [
                _ratio(*self._sums(np.hstack([x, column]), [j]))[:, 0]
                for j, column in enumerate(columns)
            ]
            return np.argmax(means, 0).astype(np.uint32)
        sums, total = self._sums(x, list(range(self.conclusions)))
        if self.head["decision"]["kind"] == "values":
            return sums.argmax(1).astype(np.uint32)
        if self.head["discrete"]:
            edges = np.array(self.ends, np.uint32)
            return (sums > edges * total[:, None]).sum(1).astype(np.uint32)
        low, high = self.ends
        return _ratio(sums, total).clip(low, high)

    def actions(self, x: Integers) -> Any:
        """Answers at inputs (B, n) as `Policy.act` of the runtime gives them: (B,) or (B, m)."""
        found, decision = self.act(x), self.head["decision"]
        if self.head["discrete"]:
            return found.astype(int)
        if decision["kind"] == "values":
            return np.array(decision["representatives"])[found, None]
        low, high = self.ends
        return 2 * (found.astype(float) - low) / (high - low) - 1

    def _sums(self, x: Integers, columns: list[int]) -> tuple[Integers, Integers]:
        """Weighted sums (B, C) of some conclusions, and of the weights (B,) scaled to 16 bits."""
        n, two = self.n, 2 * self.digits
        total = np.zeros(len(x), np.uint32)
        sums = np.zeros((len(x), len(columns)), np.uint32)
        nearest = np.full(len(x), WHOLE - 1, np.uint32)
        for rule in self.rules:
            d = (x - rule[:n]) % WHOLE
            d = np.where(d >= HALF, WHOLE - d, d)
            d = (d * rule[n : 2 * n]) >> 16
            z = (d * d).sum(1, dtype=np.uint32)
            whole = z >> two
            drop = np.where(whole < nearest, nearest - whole, 0).clip(max=31)
            total, sums = total >> drop, sums >> drop[:, None]
            nearest = np.minimum(nearest, whole)
            f = (z >> (two - 16)) % WHOLE
            a, b, c = CUBIC
            w = WHOLE - 1 - (f * (a - (f * (b - (f * c >> 16)) >> 16)) >> 16)
            w = w >> (whole - nearest).clip(max=31)
            total = total + w
            sums = sums + ((w[:, None] * rule[2 * n :][columns]) >> self.shift)
        for _ in range(16):
            small = (total < 1 << (15 + self.shift)).astype(np.uint32)
            total, sums = total << small, sums << small[:, None]
        return sums, (total >> self.shift).astype(np.uint32)


def make(data: dict[str, Any]) -> FixedPolicy:
    """The tables of a neutral policy.

    Raises:
        ValueError: one line: 16 bits cannot hold it.
    """
    decision, axes = data["decision"], list(data["axes"])
    if decision.get("action_input"):
        axes.append({"name": "action", "low": -1.0, "high": 1.0, "period": 0.0})
    part = {name: np.array([r[name] for r in data["rules"]]) for name in data["rules"][0]}
    scales = [_scale(axis, u) for axis, u in zip(axes, part["centre"].T, strict=True)]
    centres = _placed(part["centre"], scales, [axis["period"] for axis in axes])
    steps = np.array([step for _, step in scales])
    farthest = DIGITS_PER_WIDTH * HALF * steps / part["width"].min(0)  # of any state, in widths
    most = min(HALF - 1, math.isqrt(2**32 // len(axes)) - 1)
    digits = math.floor(math.log2(most / farthest.max()))
    if digits < LEAST_DIGITS:
        name, share = axes[int(farthest.argmax())]["name"], 1 / farthest.max()
        raise ValueError(
            f"int16 cannot hold rules on {name} as narrow as {share:.2g} of its range: "
            "use --precision float"
        )
    digits = min(digits, 15)
    gains = np.round(DIGITS_PER_WIDTH * steps / part["width"] * 2.0 ** (digits + 16))
    conclusions, ends = _conclusions(data, part["consequents"], len(data["axes"]))
    rules = np.hstack([centres, gains, conclusions]).astype(np.uint32)
    head = {name: value for name, value in data.items() if name != "rules"}
    shift = max(0, (len(rules) - 1).bit_length())
    return FixedPolicy(head, scales, digits, shift, rules, ends)


def _scale(axis: dict[str, Any], centres: NDArray[Any]) -> list[float]:
    """Origin and step of an input that holds its range, and where rules lie beyond, these too."""
    if axis["period"]:
        return [axis["low"] or 0.0, axis["period"] / WHOLE]
    ends = [end for end in (axis["low"], axis["high"]) if end is not None]
    low, high = min(*ends, *centres), max(*ends, *centres)
    return [float(low), float(high - low) / (HALF - 1) or 1.0]


def _placed(values: NDArray[Any], scales: list[list[float]], periods: list[float]) -> Integers:
    """Values (.., n) on the scales of their inputs."""
    origin, step = np.array(scales).T
    places = np.round((values - origin) / step)
    wraps = np.array(periods) > 0
    return np.where(wraps, places % WHOLE, places.clip(0, HALF - 1)).astype(np.uint32)


def _conclusions(data: dict[str, Any], table: NDArray[Any], n: int) -> tuple[Any, list[int]]:
    """Conclusions (K, M) of the rules, and the `FixedPolicy.ends`, from the consequents (K, m)."""
    decision = data["decision"]
    if decision["kind"] == "normal":
        means = table[:, : decision["numbers"]]
        limit = max(1.0, np.abs(means).max())

        def units(values: Any) -> Any:
            return np.round((np.asarray(values) / limit + 1) / 2 * (WHOLE - 1))

        ends = decision["edges"] if data["discrete"] else [-1.0, 1.0]
        return units(means), units(ends).astype(int).tolist()
    values = table[:, n:-1] @ np.array(decision["codes"]).T
    if decision["action_input"]:
        if table[:, :n].any():
            raise ValueError(
                "int16 has no consequents that depend on the state (c_x) where the action is an "
                "input: use --precision float"
            )
        values = values + table[:, -1:]
        values = values - values.min()
    else:
        values = values - values.min(1, keepdims=True)
    return np.round(values / (values.max() or 1.0) * (WHOLE - 1)), []


def _ratio(sums: Integers, total: Integers) -> Integers:
    return np.minimum(sums // total[:, None], WHOLE - 1).astype(np.uint32)
