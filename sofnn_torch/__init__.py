"""Self-organizing fuzzy neural networks that learn by reinforcement, in PyTorch and MuJoCo.

    from sofnn_torch import SOFNN, Axis, grid, train, load

The network and the learners load without MuJoCo; the rest loads when it is first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

if TYPE_CHECKING:
    from sofnn_torch.evaluate import load
    from sofnn_torch.learners import SGA, Learner, QConfig, QLearning, SGAConfig, Task
    from sofnn_torch.library import Agent
    from sofnn_torch.maze.env import KheperaMazeEnv
    from sofnn_torch.maze.settings import MazeConfig
    from sofnn_torch.network.axes import Axis
    from sofnn_torch.network.settings import NetworkConfig
    from sofnn_torch.network.sofnn import SOFNN, grid
    from sofnn_torch.runs.session import RunOptions
    from sofnn_torch.runs.settings import Config
    from sofnn_torch.training import resume, train

__version__ = "0.2.0"

PLACES = {
    "network.sofnn": ("SOFNN", "grid"),
    "network.axes": ("Axis",),
    "learners": ("SGA", "SGAConfig", "QLearning", "QConfig", "Learner", "Task"),
    "maze.env": ("KheperaMazeEnv",),
    "runs.settings": ("Config", "MazeConfig", "NetworkConfig"),
    "runs.session": ("RunOptions",),
    "training": ("train", "resume"),
    "evaluate": ("load",),
    "library": ("Agent",),
}
HOMES = {name: f"sofnn_torch.{module}" for module, names in PLACES.items() for name in names}

__all__ = [
    "SGA",
    "SOFNN",
    "Agent",
    "Axis",
    "Config",
    "KheperaMazeEnv",
    "Learner",
    "MazeConfig",
    "NetworkConfig",
    "QConfig",
    "QLearning",
    "RunOptions",
    "SGAConfig",
    "Task",
    "grid",
    "load",
    "resume",
    "train",
]

register(id="KheperaMaze-v0", entry_point="sofnn_torch.maze.env:KheperaMazeEnv")


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *HOMES})
