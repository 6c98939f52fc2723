"""What one trial was like."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner


@dataclass(frozen=True)
class TrialRecord:
    """What one trial was like; a line of ``trials.csv``. Nothing in it depends on the clock.

    Examples:
        >>> TrialRecord(1, 512, 60, 512, 0.9, True, 300).outcome
        True
    """

    trial: int
    """Number of the trial, from 1."""
    steps: int
    """Simulator steps until the goal or the limit."""
    decisions: int
    """Actions chosen; in the maze one is held for up to `hold` steps."""
    total_steps: int
    """Simulator steps since the start of the run."""
    reward: float
    """Undiscounted sum of the rewards."""
    success: bool | None
    """The goal was reached; None for a task that does not say so."""
    rules: int
    """Rules after the trial."""
    measures: dict[str, float] = field(default_factory=dict)
    """What the environment measured (`env.measure`)."""
    statistics: dict[str, float] = field(default_factory=dict)
    """What the learner measured (`agent.statistics()`)."""
    freed: int | None = None
    """Decisions at which a frozen policy got more chance, to leave a loop; None in training."""

    @property
    def outcome(self) -> float:
        """What a trial is judged by: whether it reached the goal, or else its return."""
        return self.reward if self.success is None else self.success

    def row(self) -> dict[str, Any]:
        """All numbers by their names, in the order of ``trials.csv``: counts before the rules."""
        names = ("trial", "steps", "decisions", "total_steps", "reward", "success")
        row = {name: getattr(self, name) for name in names}
        if self.success is None:
            del row["success"]
        if self.freed is not None:
            row["freed"] = self.freed
        counts = {name: n for name, n in self.measures.items() if isinstance(n, int)}
        return row | counts | {"rules": self.rules} | self.measures | self.statistics


@dataclass
class Trajectory:
    """States at the start and after every decision of a trial.

    In the maze they are poses (x [m], y [m], heading [rad]). In other tasks nobody knows more than
    the learner: both are its observations.

    Attributes:
        true: where it was. Shape: (T, n).
        estimated: where the learner believed to be. Shape: (T, n).
        goal: where the goal of the trial was, if the learner was told. Shape: (0,) or (2,).

    Examples:
        >>> poses = np.zeros((5, 3))
        >>> Trajectory(true=poses, estimated=poses + 0.01).decided_at("estimated").shape
        (4, 3)
    """

    true: NDArray[Any]
    estimated: NDArray[Any]
    goal: NDArray[Any] = field(default_factory=lambda: np.zeros(0))

    def decided_at(self, pose: str) -> NDArray[Any]:
        """The states (T - 1, n) of the decisions, for a robot that knows its pose by this mode."""
        states = (self.true if pose == "true" else self.estimated)[:-1]
        return (
            np.hstack([states, np.tile(self.goal, (len(states), 1))]) if len(self.goal) else states
        )


class Recorder:
    """Notes what happens in a trial, one decision after another.

    Args:
        env: the environment, which says what else is measured.
        observation: the first of the trial.
        info: what the environment said with it.
    """

    def __init__(self, env: Any, observation: NDArray[Any], info: dict[str, Any]):
        self.env, self.reward = env, 0.0
        self.observations, self.infos = [observation], [info]

    def add(self, reward: float, observation: NDArray[Any], info: dict[str, Any]) -> None:
        """Note a decision: its reward, what it led to, and what the environment said of it."""
        self.reward += reward
        self.observations.append(observation)
        self.infos.append(info)

    def finish(
        self, agent: Learner, statistics: dict[str, float], freed: int | None = None
    ) -> tuple[TrialRecord, Trajectory]:
        """The record of the trial and the states from the start on.

        Args:
            agent: the learner.
            statistics: what it measured.
            freed: decisions at which a frozen policy got more chance.
        """
        last, seen = self.infos[-1], list(zip(self.infos, self.observations, strict=True))
        true, estimated = (
            np.array([info.get(name, x) for info, x in seen])
            for name in ("true_pose", "estimated_pose")
        )
        path = Trajectory(true, estimated, last.get("goal", np.zeros(0)))
        success = last.get("success")
        record = TrialRecord(
            trial=0,
            steps=last["total_steps"],
            decisions=len(self.infos) - 1,
            total_steps=last["total_steps"],
            reward=float(self.reward),
            success=None if success is None else bool(success),
            rules=agent.net.n_rules,
            measures=self.env.unwrapped.measure(self.infos),
            statistics=statistics,
            freed=freed,
        )
        return record, path
