"""What one trial was like."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


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
