"""A learned policy without torch: this one file and NumPy.

    policy = read("policy.json")
    action = policy.start(observation)                  # the first decision of a trial
    while driving:
        observation = obey(policy.command(action))      # wheel speeds, or the action of a task
        action = policy.step(observation)

Or from any other language, one line for each observation in and one for each command out; an empty
line begins a new trial:

    python sofnn_runtime.py policy.json [SEED]

The file of a policy is written by ``python -m sofnn_torch.export RUN --to policy.json``;
docs/export.md of sofnn-torch says what is in it. In the maze a decision holds for
``policy.robot["hold"]`` steps of ``policy.robot["seconds"]``, or until the robot bumps.
"""

import bisect
import json
import math
import sys
from collections import Counter
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

FORMAT, VERSION = "sofnn-torch policy", 1
LARGEST = 2**28  # bytes of a file
PARTS = ("centre", "width", "consequents")
LISTS, TABLES = ("axes", "actions", "outputs", "rules"), ("decision", "command")
ENTRIES = dict.fromkeys(LISTS, list) | dict.fromkeys(TABLES, dict) | {"discrete": bool}
Numbers = np.ndarray[Any, np.dtype[np.float64]]


class Policy:
    """A policy that decides as `sofnn_torch.evaluate` plays it, the way out of loops included.

    Letters in shapes: ``n`` numbers of a state, ``K`` rules, ``m`` outputs, ``J`` choices.

    Args:
        data: the content of a policy file.
        seed: of the chance by which it leaves loops; equal seeds give equal trials.
        explore: begin with the learned stochastic policy instead of the mean or greedy action.

    Raises:
        ValueError: one line on what is wrong with the data.

    Examples:
        >>> rule = {"centre": [0.5], "width": [0.1], "consequents": [-0.4, 0.1]}
        >>> decision = {"kind": "normal", "numbers": 1, "edges": [0.0]}
        >>> axis = {"name": "x", "unit": "", "low": 0, "high": 1, "period": 0}
        >>> policy = Policy({"format": FORMAT, "version": 1, "precision": "float32",
        ...     "axes": [axis], "clipped": True, "actions": ["back", "ahead"], "discrete": True,
        ...     "outputs": ["mu", "sigma"], "decision": decision, "patience": None, "near": [0.1],
        ...     "doublings": 10, "command": {"kind": "number", "first": 0}, "rules": [rule]})
        >>> policy.start([0.3])
        0
    """

    def __init__(self, data: Any, seed: int | None = None, explore: bool = False):
        check(data)
        self.data, self.seed, self.explore = data, seed, explore
        self.discrete, self.decision = data["discrete"], data["decision"]
        self.robot: dict[str, Any] = data.get("robot") or {}
        self.returns: Counter[int] = Counter()
        try:
            self._take(data)
            self._is_new(x := self.centres[0][: len(self.low)])
            self.command(self.act(x))
            if self.decision["kind"] == "values":
                self.decision["temperature"] + self.decision["edges"][len(self.codes) - 1][1]
        except (KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
            raise ValueError(f"not a policy: {error!r:.80} is missing or out of place") from None

    def _take(self, data: Any) -> None:
        """Take the numbers of a policy, in the precision of the network the same as there."""
        kind, axes = np.dtype(data["precision"]), data["axes"]
        self.patience = math.inf if data["patience"] is None else data["patience"]
        self.near = np.array([np.inf if d is None else d for d in data["near"]], float)
        self.turning = [(i, a["period"]) for i, a in enumerate(axes) if a["period"]]
        self.seen, self.idle = np.empty((0, len(axes))), 0
        self.acting = bool(self.decision.get("action_input"))
        clips = data["clipped"]
        ends = [(a["low"], a["high"]) if clips and not a["period"] else (None,) * 2 for a in axes]
        self.low = np.array([-np.inf if low is None else low for low, _ in ends], float)
        self.high = np.array([np.inf if high is None else high for _, high in ends], float)

        def column(part: str) -> Numbers:
            return np.array([rule[part] for rule in data["rules"]], kind).astype(float)

        self.centres, self.widths = column("centre"), column("width")  # (K, n) each
        self.consequents = column("consequents")  # (K, m)
        self.codes = np.array(self.decision.get("codes", []), float)  # (J, c)
        periods = [axis["period"] for axis in axes] + [0.0] * self.acting
        self.periods = np.array(periods, kind).astype(float)

    @cached_property
    def rng(self) -> np.random.Generator:
        """The chance, loaded when first needed, which is not at once."""
        return np.random.default_rng(self.seed)

    # ---------------------------------------------------------------------------------- a trial

    def start(self, observation: Any) -> Any:
        """Begin a trial; its first action, as `act`."""
        self.returns.clear()
        self.seen, self.idle = self.seen[:0], 0
        return self.step(observation)

    def step(self, observation: Any) -> Any:
        """The next action.

        A policy without chance would run in a circle: with each decision after some ``patience``
        without a new state the learned chance is added 1, 3, 7, ... times at the strongest rule.
        """
        self.idle = 0 if self.patience == math.inf or self._is_new(observation) else self.idle + 1
        stuck, doublings = self.idle >= self.patience, 0
        if stuck or self.returns:
            self.returns[rule := self.strongest_rule(observation)] += stuck
            doublings = min(self.returns[rule], self.data["doublings"])
        return self.act(observation, self.explore + 2**doublings - 1)

    def _is_new(self, observation: Any) -> bool:
        """Whether no state of the trial is near the observation (n,), which then becomes one."""
        apart = self.seen - (x := self.state(observation))
        for i, period in self.turning:
            apart[:, i] -= period * np.round(apart[:, i] / period)
        new = not (((apart / self.near) ** 2).sum(1) <= 1).any()
        self.seen = np.vstack([self.seen, x]) if new else self.seen
        return new

    def act(self, observation: Any, explore: float = 0) -> Any:
        """The action at an observation (n,): its number, or numbers (m,) in [-1, 1].

        Args:
            observation: the state. Shape: (n,).
            explore: 0 for the mean or greedy action, more for as many times the learned chance.
        """
        if self.decision["kind"] == "normal":
            outputs, m = self.outputs(observation), self.decision["numbers"]
            mean, sigma = outputs[:m], outputs[m : 2 * m]
            action = self.rng.normal(mean, explore * sigma) if explore else mean
            if self.discrete:
                return bisect.bisect_left(self.decision["edges"], action[0])
            return np.clip(action, -1, 1).astype(np.float32)
        values = self.values(observation)
        choice = int(values.argmax())
        scalar = self.decision["representatives"][choice]
        if explore:
            choice = self._roulette(values.tolist(), explore)
            low, high = self.decision["edges"][choice]
            scalar = low + (high - low) * self.rng.random()
        return choice if self.discrete else np.array([scalar], np.float32)

    def command(self, action: Any) -> Any:
        """What to send for an action: wheel speeds [m/s] in the maze, else the task's own action.

        A vector that is an action of a task has its shape and type.
        """
        how = self.data["command"]
        if how["kind"] == "number":
            return how["first"] + int(action)
        numbers = np.asarray(action, float)
        if how["kind"] == "box":
            low, high = (np.array(how[end], float).reshape(how["shape"]) for end in ("low", "high"))
            share = (numbers.reshape(how["shape"]) + 1) / 2
            return np.clip(low + share * (high - low), low, high).astype(how["type"])
        if how["kind"] == "wheels":
            return numbers * how["forward"]
        steer = float(numbers if self.discrete else numbers[0]) - self.discrete
        forward, turn = how["forward"] * (1 - abs(steer)), how["turn"] * steer
        return np.array([forward - turn, forward + turn])

    # -------------------------------------------------------------------------- the fuzzy network

    def state(self, observation: Any) -> Numbers:
        """An observation (.., n) as the network takes it: at most at the ends of its axes.

        Raises:
            ValueError: it has another number of inputs.
        """
        x = np.asarray(observation, float)
        if x.shape[-1:] != self.low.shape:
            raise ValueError(f"an observation of {len(self.low)} numbers is needed, got {x.shape}")
        return np.clip(x, self.low, self.high).astype(np.float32).astype(float)

    def firing(self, inputs: Numbers) -> Numbers:
        """Normalised firing of the rules at inputs of the network (.., n). Shape: (.., K)."""
        d = inputs[..., None, :] - self.centres
        for i in np.flatnonzero(self.periods):
            d[..., i] -= self.periods[i] * np.round(d[..., i] / self.periods[i])
        log = -0.5 * ((d / self.widths) ** 2).sum(-1)
        strength = np.exp(log - log.max(-1, keepdims=True))
        return strength / strength.sum(-1, keepdims=True)

    def inputs(self, observation: Any) -> Numbers:
        """Inputs of the network: the state (.., n), or that with each action (.., J, n + 1)."""
        x = self.state(observation)
        if not self.acting:
            return x
        shape = (*x.shape[:-1], len(self.codes))
        beside = np.broadcast_to(x[..., None, :], (*shape, x.shape[-1]))
        return np.concatenate([beside, np.broadcast_to(self.codes, (*shape, 1))], -1)

    def outputs(self, observation: Any) -> Numbers:
        """Weighted means of the consequents at observations (.., n). Shape: (.., m)."""
        return self.firing(self.inputs(observation)) @ self.consequents

    def values(self, observation: Any) -> Numbers:
        """Value of each choice at observations (.., n), of a policy by values. Shape: (.., J)."""
        x, outputs = self.state(observation), self.outputs(observation)
        n = x.shape[-1]
        if not self.acting:
            outputs = outputs[..., None, :]
        of_state = (outputs[..., :n] * x[..., None, :]).sum(-1)
        return of_state + (outputs[..., n:-1] * self.codes).sum(-1) + outputs[..., -1]

    def strongest_rule(self, observation: Any) -> int:
        """The rule that fires most at the state (n,)."""
        return int(self.firing(self.inputs(observation)).argmax()) % len(self.centres)

    def _roulette(self, values: list[float], hotter: float) -> int:
        """A choice drawn with Boltzmann's probabilities at a temperature."""
        best, temperature = max(values), self.decision["temperature"] * hotter
        wheel = list(accumulate(math.exp((v - best) / temperature) for v in values))
        ball = self.rng.random() * wheel[-1]
        return next(j for j, edge in enumerate(wheel) if ball < edge)


# ------------------------------------------------------------------------------------- the file


def read(path: str | Path, seed: int | None = None, explore: bool = False) -> Policy:
    """The policy in a file; arguments as `Policy`.

    Raises:
        ValueError: one line that names the file and says what is wrong with it.
    """
    try:
        with open(path, "rb") as file:
            return Policy(json.loads(file.read(LARGEST)), seed, explore)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not JSON, or not all of it ({reason})") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def check(data: Any) -> None:
    """Raise ValueError, one line, unless there are a policy's entries and numbers in its rules."""
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f'not a policy: "format" must be "{FORMAT}"')
    if data.get("version") != VERSION:
        raise ValueError(f"version {data.get('version')}, this program reads version {VERSION}")
    for name, kind in ENTRIES.items():
        if not isinstance(data.get(name), kind):
            raise ValueError(f"{name} must be of type {kind.__name__}")
    if data.get("precision") not in ("float32", "float64"):
        raise ValueError("precision must be float32 or float64")
    if not (data["rules"] and data["axes"]):
        raise ValueError("a policy needs at least one input and one rule")
    n = len(data["axes"]) + bool(data["decision"].get("action_input"))
    for i, rule in enumerate(data["rules"], 1):
        for part, size in zip(PARTS, (n, n, len(data["outputs"])), strict=True):
            given = rule.get(part) if isinstance(rule, dict) else None
            values = given if isinstance(given, list) else []
            plain = {int, float}.issuperset(map(type, values)) and all(map(math.isfinite, values))
            if len(values) != size or not plain:
                raise ValueError(f"rule {i}, {part}: must be a list of {size} finite numbers")
            if part == "width" and min(values) <= 0:
                raise ValueError(f"rule {i}, width: must be positive")


def main() -> None:
    """Answer each line of numbers on the standard input with one on the standard output."""
    if not 2 <= len(sys.argv) <= 3:
        sys.exit(f"usage: python {Path(sys.argv[0]).name} policy.json [SEED]")
    try:
        policy = read(sys.argv[1], int(sys.argv[2]) if len(sys.argv) == 3 else None)
        decide = policy.start
        for line in sys.stdin:
            if not line.strip():
                decide = policy.start
                continue
            action = decide([float(word) for word in line.replace(",", " ").split()])
            print(*np.ravel(policy.command(action)).tolist(), flush=True)
            decide = policy.step
    except ValueError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
