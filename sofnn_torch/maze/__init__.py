"""Robot and maze of the simulation (section 5), as a Gymnasium environment."""

import os
import sys
from typing import Any


class MuJoCoError(ImportError):
    """MuJoCo does not load here; where nobody catches it, it is shown in one line."""


try:
    import mujoco  # noqa: F401
except Exception as error:  # MuJoCo looks at MUJOCO_GL when it loads and then raises all kinds
    if "MUJOCO_GL" not in os.environ:
        raise
    former = sys.excepthook

    def show(kind: type[BaseException], value: BaseException, traceback: Any) -> None:
        """Every command imports this first, and ends here if it fails."""
        if not issubclass(kind, MuJoCoError):
            return former(kind, value, traceback)
        print(f"error: {value}", file=sys.stderr)
        sys.exit(2)

    sys.excepthook = show
    raise MuJoCoError(
        f"MuJoCo does not load with MUJOCO_GL={os.environ['MUJOCO_GL']} "
        f"({' '.join(str(error).split())}): set it to egl, osmesa or glfw, or unset it"
    ) from None
