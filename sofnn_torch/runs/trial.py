"""What one trial was like."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.learners.learner import Learner
from sofnn_torch.maze.env import KheperaMazeEnv


@dataclass(frozen=True)
class TrialRecord:
    """What one trial was like; a line of ``trials.csv``. Nothing in it depends on the clock."""

    trial: int
    """Number of the trial, from 1."""
    steps: int
    """Simulator steps until the goal or the limit."""
    decisions: int
    """Actions chosen; one is held for up to `hold` steps."""
    total_steps: int
    """Simulator steps since the start of the run."""
    reward: float
    """Undiscounted sum of the rewards."""
    success: bool
    """The goal was reached."""
    collisions: int
    """Decisions that ended in a bump."""
    subgoals: int
    """Sub-goals found in this trial."""
    rules: int
    """Rules after the trial."""
    pose_error: float
    """Mean distance of true and estimated position over the decisions, in metres."""
    pose_error_max: float
    """The largest of these distances, in metres."""
    heading_error: float
    """Mean absolute difference of true and estimated heading, in radians."""
    statistics: dict[str, float] = field(default_factory=dict)
    """What the learner measured (`agent.statistics()`)."""


@dataclass
class Trajectory:
    """Poses (x [m], y [m], heading [rad]) at the start and after every decision of a trial.

    Attributes:
        true: where the robot was. Shape: (T, 3).
        estimated: where it believed to be. Shape: (T, 3).
    """

    true: NDArray[np.float64]
    estimated: NDArray[np.float64]

    def decided_at(self, pose: str) -> NDArray[np.float64]:
        """The states (T - 1, 3) of the decisions, for a robot that knows its pose by this mode."""
        return (self.true if pose == "true" else self.estimated)[:-1]


class Recorder:
    """Notes what happens in a trial, one decision after another.

    Args:
        info: what the environment said at the start.
    """

    def __init__(self, info: dict[str, Any]):
        self.reward, self.decisions, self.collisions = 0.0, 0, 0
        self.true, self.estimated = [info["true_pose"]], [info["estimated_pose"]]
        self.info = info

    def add(self, reward: float, info: dict[str, Any]) -> None:
        """Note the reward of a decision and what the environment said of it."""
        self.reward += reward
        self.decisions += 1
        self.collisions += info["collision"]
        self.true.append(info["true_pose"])
        self.estimated.append(info["estimated_pose"])
        self.info = info

    def finish(
        self, env: KheperaMazeEnv, agent: Learner, statistics: dict[str, float]
    ) -> tuple[TrialRecord, Trajectory]:
        """The record of the trial and the poses from the start on."""
        path, info = Trajectory(np.array(self.true), np.array(self.estimated)), self.info
        record = TrialRecord(
            trial=0,
            steps=info["total_steps"],
            decisions=self.decisions,
            total_steps=info["total_steps"],
            reward=float(self.reward),
            success=bool(info["success"]),
            collisions=int(self.collisions),
            subgoals=sum(map(bool, info["subgoals"])),
            rules=agent.net.n_rules,
            statistics=statistics,
            **env.unwrapped.measure(path.true, path.estimated),
        )
        return record, path
