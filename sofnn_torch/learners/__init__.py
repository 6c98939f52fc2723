"""What learns by reinforcement on the network: SGA (section 3), Q-learning (section 4)."""

import pkgutil

from sofnn_torch.learners.learner import Learner, Output, Plan, Task
from sofnn_torch.learners.qlearning import QConfig, QLearning
from sofnn_torch.learners.sga import SGA, SGAConfig

__all__ = [
    "SGA",
    "Learner",
    "Output",
    "Plan",
    "QConfig",
    "QLearning",
    "SGAConfig",
    "Task",
    "learner_class",
]

BUILT_IN: dict[str, type[Learner]] = {SGA.name: SGA, QLearning.name: QLearning}


def learner_class(agent: str) -> type[Learner]:
    """The class of a learner by its name: ``sga``, ``q``, or ``module:Class`` of one's own.

    Raises:
        ValueError: there is none, or it is no `Learner`.
    """
    if agent in BUILT_IN:
        return BUILT_IN[agent]
    wanted = f"--agent must be {', '.join(BUILT_IN)} or module:Class of a learner, got {agent!r}"
    if ":" not in agent:
        raise ValueError(wanted)
    try:
        found = pkgutil.resolve_name(agent)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{wanted} ({' '.join(str(error).split())})") from None
    if not (isinstance(found, type) and issubclass(found, Learner)):
        raise ValueError(f"{wanted}, which is none")
    return found
