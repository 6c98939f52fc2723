"""Self-organized fuzzy-neuro reinforcement learning for a wheeled robot, in PyTorch and MuJoCo."""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

register(id="KheperaMaze-v0", entry_point="sofnn_torch.maze:KheperaMazeEnv")
