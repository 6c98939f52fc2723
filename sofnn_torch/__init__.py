"""Self-organized fuzzy-neuro reinforcement learning for a wheeled robot, in PyTorch and MuJoCo."""

import os
import sys

from gymnasium.envs.registration import register

__version__ = "0.1.0"

try:
    import mujoco  # noqa: F401
except Exception as error:  # MuJoCo looks at MUJOCO_GL when it loads and then raises all kinds
    if "MUJOCO_GL" not in os.environ:
        raise
    reason = " ".join(str(error).split())
    print(
        f"error: MuJoCo does not load with MUJOCO_GL={os.environ['MUJOCO_GL']} ({reason}): "
        "set it to egl, osmesa or glfw, or unset it",
        file=sys.stderr,
    )
    sys.exit(2)  # nothing works without it, and every command ends here in one line

register(id="KheperaMaze-v0", entry_point="sofnn_torch.maze.env:KheperaMazeEnv")
