"""A small rule base that drives as the full one: `python -m sofnn_torch.rules RUN --reduce 40`.

A few rules are fitted to what the full policy does at the states that it visits, with and without
exploration (`sofnn_torch.rules.fitting`). Then the small policy plays, the full one says what it
would have done at the states that this leads to, these join the others, and the fit goes on (Ross,
Gordon and Bagnell, A reduction of imitation learning and structured prediction to no-regret online
learning, AISTATS 2011). There are more rounds where the small policy does not play as well yet.
One that plays as well has to do so in many more trials, those that it fails teach too, and the best
one is taken.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from sofnn_torch.evaluate import Loaded
from sofnn_torch.learners.learner import Learner
from sofnn_torch.progress import Progress
from sofnn_torch.rules import tables
from sofnn_torch.rules.editing import keeping, places_of, renewed
from sofnn_torch.rules.fitting import Fit
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.settings import Config
from sofnn_torch.terminal import plural

ROUNDS, MOST = 3, 12  # of fitting and playing; if none plays as well as the full policy
LOSS = 0.02  # share of steps, or of return, by which it may play worse
STEPS = 300  # of the optimizer in a round; twice as many in the first
TRIALS = 10  # that the full policy plays to begin with, and the small one in each round
DECIDING = 150  # trials in which a small policy that plays as well must go on to do so
HOTTER = 1.0, 4.0  # exploration of the trials that show what lies beside the way
LONGER = 2  # a trial is cut at so many times the longest of the full policy
CLOSE = 0.1  # numbers of actions, of [-1, 1], that differ by no more agree


@dataclass(frozen=True)
class Visit:
    """Trials without learning.

    Attributes:
        states: at the decisions of each trial. Shapes: (T, n).
        goals: there is a goal to reach.
        outcomes: of each trial: whether it reached the goal, or its return.
        steps: of each trial.
    """

    states: list[NDArray[np.float32]]
    goals: bool
    outcomes: list[float]
    steps: list[int]

    @property
    def ways(self) -> list[NDArray[np.float32]]:
        """The states of the trials that reached the goal, or else of all."""
        trials = zip(self.states, self.outcomes, strict=True)
        return [states for states, goal in trials if goal or not self.goals] or self.states

    @property
    def worth(self) -> tuple[float, float]:
        """The greater the better: more goals or return, then fewer steps."""
        return float(np.mean(self.outcomes)), -float(np.mean(self.steps))

    @property
    def lessons(self) -> list[NDArray[np.float32]]:
        """The states of some trials, and of all that missed the goal."""
        trials = zip(self.states, self.outcomes, strict=True)
        missed = [states for states, goal in trials if self.goals and not goal]
        return self.states[:TRIALS] + missed

    def and_then(self, other: "Visit") -> "Visit":
        """The trials of both."""
        states, outcomes = self.states + other.states, self.outcomes + other.outcomes
        return Visit(states, self.goals, outcomes, self.steps + other.steps)

    def loss(self, full: "Visit") -> float:
        """By what share of steps or of return it is too bad; all, where a trial misses the goal."""
        if self.goals:
            arrived = [n for n, goal in zip(full.steps, full.outcomes, strict=True) if goal]
            longer = float(np.mean(self.steps) / np.mean(arrived or full.steps)) - 1
            return longer if all(self.outcomes) else 1.0
        mean = float(np.mean(full.outcomes))
        return (mean - float(np.mean(self.outcomes))) / max(abs(mean), 1e-9)


def visit(
    env: Any, agent: Learner, trials: int, explore: float = 0.0, most: float = math.inf
) -> Visit:
    """Play the plain policy, which no cure of loops changes.

    Args:
        env: as `make_env` makes it.
        agent: the learner; only its chance moves.
        trials: how many.
        explore: as in `Learner.act`.
        most: decisions after which a trial is cut.
    """
    states, outcomes, steps, success = [], [], [], None
    for _ in range(trials):
        observation, info = env.reset()
        seen: list[NDArray[np.float32]] = []
        over, gain = False, 0.0
        while not over and len(seen) < most:
            seen.append(observation)
            action = agent.act(observation, explore)
            observation, reward, terminated, truncated, info = env.step(action)
            gain += float(reward)
            over = terminated or truncated
        success = info.get("success")
        outcomes.append(gain if success is None else float(success))
        steps.append(info["total_steps"])
        states.append(np.array(seen, np.float32))
    return Visit(states, success is not None, outcomes, steps)


def reduced(
    config: Config, agent: Learner, count: int, seed: int = 0, quiet: bool = True
) -> Learner:
    """A learner with few rules whose policy does what that of another one does.

    Args:
        config: settings of the run.
        agent: the learner with the full rule base; only its chance moves.
        count: rules.
        seed: of all chance: equal ones give equal rules.
        quiet: show no progress.

    Raises:
        ValueError: there are not more rules than that, or the policy reaches no goal or visits
            too few states.

    Example:
        >>> config, agent, _, _ = load("runs/sixty")  # doctest: +SKIP
        >>> reduced(config, agent, 40).net.n_rules  # doctest: +SKIP
        40
    """
    if not agent.net.criterion.grows and not agent.net.given:
        raise ValueError("--reduce is for a network that grows: a fixed one keeps its rules")
    if not 0 < count < agent.net.n_rules:
        raise ValueError(
            f"--reduce {count}: must be from 1 to {agent.net.n_rules - 1}, fewer than there are"
        )
    env = make_env(config)
    try:
        env.reset(seed=seeding.stream("reduction", seed))
        agent.reseed(seeding.stream("reduction", seed))
        plain = visit(env, agent, TRIALS)
        if plain.goals and not any(plain.outcomes):
            raise ValueError(
                f"--reduce: without exploration this policy reaches the goal in none of {TRIALS} "
                "trials: train on first"
            )
        seen, most = [*plain.ways], LONGER * max(map(len, plain.ways))
        for hotter in HOTTER:
            seen += visit(env, agent, TRIALS // 2, hotter, most).states
        if (different := len(np.unique(np.concatenate(seen), axis=0))) < count:
            raise ValueError(f"--reduce {count}: the policy visits only {different} states")
        fit = Fit(agent, np.concatenate(seen), count, seed)
        played: list[tuple[int, tuple[float, float], int, Learner]] = []
        with Progress(plural(count, "rule"), ROUNDS, quiet=quiet) as progress:
            for turn in range(MOST):
                fit.improve(np.concatenate(seen), STEPS if turn else 2 * STEPS)
                small = make_agent(config)
                small.net.replace_rules(*fit.found())
                visited = visit(env, small, TRIALS, most=most)
                while (
                    turn + 1 >= ROUNDS
                    and (good := visited.loss(plain) <= LOSS)
                    and len(visited.steps) < DECIDING
                ):
                    visited = visited.and_then(visit(env, small, TRIALS, most=most))
                seen += visited.lessons
                played.append((len(visited.steps), visited.worth, turn, small))
                progress.update(facts=[f"{np.mean(visited.steps):,.0f} steps"])
                if turn + 1 >= ROUNDS and good:
                    break
                progress.total = ROUNDS if turn + 1 < ROUNDS else MOST
    finally:
        env.close()
    return max(played)[-1]


@dataclass(frozen=True)
class Measured:
    """How a rule base plays, beside the full one.

    Attributes:
        rules: how many.
        outcomes: of each trial: whether it reached the goal, or its return.
        steps: of each trial.
        on_full: share of the decisions on the way of the full policy that are the same.
        on_own: the same on its own way.
    """

    rules: int
    outcomes: list[float]
    steps: list[int]
    on_full: float
    on_own: float


def agreement(one: Learner, other: Learner, states: NDArray[np.float32]) -> float:
    """Share of the states (B, n) at which two policies do the same, or nearly for vectors."""
    a, b = (agent.plan(states).actions.reshape(len(states), -1) for agent in (one, other))
    return float((np.abs(a - b) <= (0 if one.choices else CLOSE)).all(1).mean())


def measured(
    config: Config, full: Learner, small: Sequence[Learner], trials: int, seed: int
) -> list[Measured]:
    """How the plain policies of a full rule base, first, and of small ones play.

    Args:
        config: settings of the run.
        full: the learner with the full rule base.
        small: the others.
        trials: for each, the same ones.
        seed: of the motor noise and the policies' chance.
    """
    env = make_env(config)
    found, way = [], np.zeros(0, np.float32)
    try:
        for agent in (full, *small):
            seeding.begin(env, agent, seed)
            played = visit(env, agent, trials)
            own = np.concatenate(played.ways)
            way = own if agent is full else way
            shares = agreement(agent, full, way), agreement(agent, full, own)
            found.append(Measured(agent.net.n_rules, played.outcomes, played.steps, *shares))
    finally:
        env.close()
    return found


def reduce_run(
    source: Path, loaded: Loaded, counts: Sequence[int], name: str | None, seed: int
) -> None:
    """Make a run with each number of rules out of one, and print how they play.

    Args:
        source: the run or checkpoint file that was named.
        loaded: what it holds.
        counts: numbers of rules.
        name: of the new run, if it is but one.
        seed: of all chance.

    Raises:
        ValueError: a number of rules that cannot be, or a run that cannot be made.
    """
    config, agent = loaded.config, loaded.agent
    homes = [places_of(source, name, f"{count}-rules", "--reduce") for count in counts]
    if name and (taken := next(iter(homes[0]))).exists():
        raise ValueError(f"{taken} is there already: give another --name")
    small = []
    for home, count in zip(homes, counts, strict=True):
        small.append(reduced(config, agent, count, seed, quiet=False))
        why = {"reduced": {"rules": count, "seed": seed}}
        kept = keeping(config, small[-1])
        run = renewed(source, loaded, kept, make_agent(kept), home, why)
        print(f"{run}: {plural(count, 'rule')} instead of {agent.net.n_rules}", flush=True)
    tables.show(table(measured(config, agent, small, TRIALS, seed)))


def table(rows: Sequence[Measured]) -> Table:
    """The curve of rules against outcome and steps, for the terminal."""
    goals = all(outcome in (0.0, 1.0) for row in rows for outcome in row.outcomes)
    head = "goal" if goals else "return"
    view = Table(
        "rules", head, "steps", "as the full policy\non its way", "on its own way", box=SIMPLE_HEAD
    )
    for column in view.columns:
        column.justify = "right"
    for row in rows:
        outcome = np.mean(row.outcomes)
        cells = f"{outcome:.0%}" if goals else f"{outcome:.4g}", f"{np.mean(row.steps):,.1f}"
        shares = (f"{share:.1%}" for share in (row.on_full, row.on_own))
        view.add_row(str(row.rules), *cells, *(shares if row is not rows[0] else ()))
    return view
