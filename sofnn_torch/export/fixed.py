"""A policy in whole numbers: the tables of the C header of precision int16, and their model.

Everything is unsigned, at most 16 bits in the tables and 32 in between. For rule k at inputs x:

    r_i = 2 |x_i - u_i| g_i / 2^S_i       distance over width with 12 binary digits, at most 8
    z   = sum_i r_i^2 / 2^16              so that the firing strength is 2^-z, 8 digits
    w   = 2^-(z - min z) * 65535          by a cubic for the fraction and a shift for the rest
    y_j = sum_k (w c_j / 2^8) / sum_k w

The least z is found first, so the nearest rules answer far from all. Rules with widths of their own
take bytes: the upper 8 bits of a centre u, and floating gains, where g_i is 32 and the upper five
digits, S_i is S and the lower three. That rounds no gain by more than 1.6 % and spans 1 to 252. If
all widths are the same, or some too narrow or too different, centres and gains have 16 bits, and
S_i is S. Conclusions c have 8 bits. An input that wraps takes all 16 bits, and wraps by itself.

What does not change the plain mean or greedy action is left out: sigma, the value, and of
Q-learning all that is the same for every action.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CUBIC = (45340, 15200, 2632)  # of 2^-f over [0, 1), in units of 2^-16: off by at most 7e-5
HALF, WHOLE, BYTE = 2**15, 2**16, 2**8
LEAST_WIDTH = 32  # steps of its input that a rule must be wide
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
        bits: of centres and gains; gains of 8 bits are floating.
        shift: S, with gains of 8 bits the least S_i.
        centres: of the rules. Shape: (K, n).
        gains: of each rule, or one row if all have the same. Shape: (K or 1, n).
        concluded: conclusions of the rules. Shape: (K, M).
        ends: conclusions that stand for the edges between discrete actions, or for -1 and 1.
    """

    head: dict[str, Any]
    scales: list[list[float]]
    bits: int
    shift: int
    ends: list[int]
    centres: Integers
    gains: Integers
    concluded: Integers

    @property
    def n(self) -> int:
        """Inputs of the rules."""
        return len(self.scales)

    @property
    def conclusions(self) -> int:
        """Conclusions M of a rule."""
        return self.concluded.shape[1]

    @property
    def most(self) -> int:
        """The greatest distance over width, so that no sum of squares overflows."""
        return min(HALF - 1, math.isqrt(2**32 // self.n - 1))

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
                _share(*self._sums(np.hstack([x, column]), [j]))[:, 0]
                for j, column in enumerate(columns)
            ]
            return np.argmax(means, 0).astype(np.uint32)
        sums, total = self._sums(x, list(range(self.conclusions)))
        if self.head["decision"]["kind"] == "values":
            return sums.argmax(1).astype(np.uint32)
        if self.head["discrete"]:
            return (_share(sums, total) > np.array(self.ends)).sum(1).astype(np.uint32)
        low, high = self.ends
        return _share(sums, total).clip(low, high)

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
        """Weighted sums (B, C) of some conclusions, and of the weights (B,)."""
        d = (x[:, None] - self.centres * (WHOLE >> self.bits)) % WHOLE
        d = np.where(d >= HALF, WHOLE - 1 - d, d)
        gains: Any = self.gains
        shift: Any = np.uint32(self.shift)
        if self.bits == 8:
            gains, shift = 32 + (gains >> 3), shift + (gains & 7)
        r = ((2 * d * gains) >> shift).clip(max=self.most)
        z = (r**2 >> 16).sum(2, dtype=np.uint32)
        z = z - z.min(1, keepdims=True)
        f = (z << 8) % WHOLE
        a, b, c = CUBIC
        w = WHOLE - 1 - (f * (a - (f * (b - (f * c >> 16)) >> 16)) >> 16)
        w = w >> (z >> 8).clip(max=16)
        sums = ((w[:, :, None] * self.concluded[:, columns]) >> 8).sum(1, dtype=np.uint32)
        return sums, w.sum(1, dtype=np.uint32)


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
    centres: Any = _placed(part["centre"], scales, [axis["period"] for axis in axes])
    steps = np.array([step for _, step in scales])
    narrow = (part["width"] / steps).min(0)
    if narrow.min() < LEAST_WIDTH:
        name = axes[int(narrow.argmin())]["name"]
        raise ValueError(
            f"int16 cannot hold rules on {name} as narrow as {narrow.min() / WHOLE:.2g} of its "
            "range: use --precision float"
        )
    gains = DIGITS_PER_WIDTH * steps / part["width"] * 2.0**11
    gains = gains[:1] if (gains == gains[0]).all() else gains
    shifts = np.floor(np.log2(63.49 / gains)).astype(int)  # so that five digits follow the first
    shift, bits = int(shifts.min()), 8
    if len(gains) > 1 and shifts.max() < shift + 8 and narrow.min() >= 2 * BYTE:
        centres = np.round(centres / BYTE) % BYTE
        gains = 8 * (np.round(gains * 2.0**shifts) - 32) + shifts - shift
    else:
        bits, shift = 16, min(16, math.floor(math.log2((WHOLE - 1) / gains.max())))
        gains = np.round(gains * 2.0**shift)
    concluded, ends = _conclusions(data, part["consequents"], len(data["axes"]))
    head = {name: value for name, value in data.items() if name != "rules"}
    tables = [table.astype(np.uint32) for table in (centres, gains, concluded)]
    return FixedPolicy(head, scales, bits, shift, ends, *tables)


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
            return (np.asarray(values) / limit + 1) / 2 * (BYTE - 1)

        ends = decision["edges"] if data["discrete"] else [-1.0, 1.0]
        return np.round(units(means)), np.round(units(ends) * BYTE).astype(int).tolist()
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
    return np.round(values / (values.max() or 1.0) * (BYTE - 1)), []


def _share(sums: Integers, total: Integers) -> Integers:
    """Sums (B, C) over the greater sums of the weights (B,), in units of 2^-16."""
    return ((sums.astype(np.uint64) << 16) // total[:, None]).astype(np.uint32)
