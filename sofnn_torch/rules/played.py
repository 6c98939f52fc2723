"""A trial that a policy plays without learning, decision by decision, and as a file."""

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.rules.checks import strengths
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_env
from sofnn_torch.runs.rule_files import shortest
from sofnn_torch.runs.settings import Config
from sofnn_torch.runs.trial import TrialRecord
from sofnn_torch.training import play


@dataclass(frozen=True)
class Played:
    """One trial.

    Attributes:
        record: what it was like.
        states: what the learner saw at each decision. Shape: (T, n).
        actions: what it did. T of them.
        rewards: what it got. Shape: (T,).
        infos: what the environment said before each decision. T of them.
    """

    record: TrialRecord
    states: NDArray[np.float32]
    actions: list[Any]
    rewards: list[float]
    infos: list[dict[str, Any]]


class Diary(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes what passes between an environment and a policy in its last trial."""

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        """Begin a trial, and its notes."""
        observation, info = self.env.reset(**arguments)
        self.seen, self.infos = [observation], [info]
        self.actions: list[Any] = []
        self.rewards: list[float] = []
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Pass an action on, and note it with what it led to."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.actions.append(action)
        self.rewards.append(float(reward))
        self.seen.append(observation)
        self.infos.append(info)
        return observation, reward, terminated, truncated, info


def trial(config: Config, agent: Learner, number: int, seed: int) -> Played:
    """The trial of a number, from 1, that `evaluate` plays with a seed."""
    diary = Diary(make_env(config))
    try:
        seeding.begin(diary, agent, seed)
        for _ in range(number):
            record, _ = play(diary, agent, learn=False, explore=False)
    finally:
        diary.close()
    states = np.array(diary.seen[:-1], np.float32)
    return Played(record, states, diary.actions, diary.rewards, diary.infos[:-1])


def moments(agent: Learner, states: NDArray[np.float32]) -> NDArray[np.int64]:
    """The decision, from 0, at which each rule (K,) has its largest share along states (T, n)."""
    return np.array([agent.firing(state).numpy().mean(0) for state in states]).argmax(0)


def to_csv(agent: Learner, played: Played) -> bytes:
    """A line for each decision: where, what, which rule fires most.

    Columns: decision, from 1; steps before it; in the maze the true pose; what the learner saw;
    action; reward; the rule with the largest share, from 1; its share; the firing strength of the
    strongest rule.
    """
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    names = [f"{axis.name}_{axis.unit}".strip("_").replace(" ", "_") for axis in agent.task.axes]
    tell = _teller(agent)
    knows = "true_pose" in played.infos[0]
    true = [f"true_{name}" for name in ("x_m", "y_m", "heading_rad")] if knows else []
    last = ["action", "reward", "rule", "share", "firing"]
    lines.writerow(["decision", "steps", *true, *names, *last])
    firing, seen = strengths(agent, played.states), shortest(played.states).tolist()
    for t, state in enumerate(played.states):
        info = played.infos[t]
        share = agent.firing(state).double().numpy().mean(0)
        pose = info["true_pose"].tolist() if knows else []
        rule = int(share.argmax())
        lines.writerow(
            [t + 1, info.get("total_steps", t), *pose, *seen[t], tell(played.actions[t])]
            + [played.rewards[t], rule + 1, f"{share[rule]:.6g}", f"{firing[t]:.6g}"]
        )
    return text.getvalue().encode()


def _teller(agent: Learner) -> Callable[[Any], str]:
    """How an action is written: by its name, or its numbers between blanks."""
    if agent.task.discrete:
        return lambda action: agent.task.actions[int(action)]
    return lambda action: " ".join(f"{value:.6g}" for value in np.ravel(action))


def asked(played: Played, decision: int) -> NDArray[np.float32]:
    """What the learner saw at a decision, from 1.

    Raises:
        ValueError: the trial had fewer.
    """
    if decision > len(played.states):
        count = len(played.states)
        raise ValueError(f"--decision must be at most {count}, as many as the trial has")
    return played.states[decision - 1]


def chance(played: Played, agent: Learner, decision: int) -> bool:
    """Whether another action was taken at a decision, from 1, than the policy has without chance.

    A policy that leaves circles takes chance at a rule that it does not get away from.
    """
    without = agent.plan(played.states[decision - 1][None]).actions[0]
    return not np.allclose(without, played.actions[decision - 1], atol=1e-6)


def outcome(record: TrialRecord) -> str:
    """How a trial ended, in a few words."""
    if record.success is None:
        return f"return {record.reward:,.4g} in {record.steps:,} steps"
    return f"{'goal' if record.success else 'no goal'} after {record.steps:,} steps"
