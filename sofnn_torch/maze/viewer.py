"""MuJoCo's viewer window, following a simulation that runs elsewhere."""

import atexit
import os
import sys
import threading
import time
import warnings
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.odometry import STEP_SECONDS, Pose
from sofnn_torch.maze.rendering import RenderingError, check_process, decorate, has_display

SLOWEST, FASTEST = 0.5, 1000.0  # times real time
PAUSED_FRAME = 0.03  # s
HELP = {"space": "pause", "right arrow": "one step", "+ and -": "speed", "enter": "follow"}
# Key codes of GLFW, which keeps those of the keyboard and of the keypad apart.
SPACE, RIGHT_ARROW = 32, 262
ENTER, PLUS, MINUS = (257, 335), (61, 334), (45, 333)


class Viewer:
    """A window that shows the robot on its way, with a text in its corner.

    Keys: the space bar pauses and goes on, and while it is paused the right arrow makes one step;
    + and - double and halve the speed; enter follows the robot, or stops to. The others are
    MuJoCo's, F1 lists them.
    """

    def __init__(self, model: mujoco.MjModel, speed: float = 20.0, camera: str = "top") -> None:
        """Open the window.

        Args:
            model: what is shown.
            speed: how many times as fast as the robot.
            camera: "top" to begin with a view from above, "chase" to follow the robot.

        Raises:
            RenderingError: if there is no display, or on macOS outside `mjpython`.
        """
        if not has_display():
            raise RenderingError(
                'the viewer needs a display: without one use render_mode="rgb_array"'
            )
        self._model = model
        self.data = mujoco.MjData(model)
        self.speed, self.paused, self.following = speed, False, camera == "chase"
        self._single_step, self._followed = False, False
        self._process = os.getpid()
        others = set(threading.enumerate())
        try:
            from mujoco import viewer  # needs GLFW, so only now

            _check_display()
            self._handle = viewer.launch_passive(
                model, self.data, key_callback=self._key, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # GLFW and mjpython fail in ways of their own
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RenderingError(f"cannot open the viewer: {reason}") from error
        self._threads = set(threading.enumerate()) - others
        mujoco.mjv_defaultFreeCamera(model, self._handle.cam)
        self._handle.opt.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
        self._next_frame = 0.0
        atexit.register(self.close)

    def draw(
        self,
        qpos: NDArray[np.float64],
        trail: Sequence[tuple[float, float]] = (),
        estimate: Pose | None = None,
        texts: Mapping[str, str] | None = None,
    ) -> None:
        """Show a new state, and wait until it is time for the next one or the pause is over.

        Args:
            qpos: joint positions (nq,).
            trail: where the robot has been, x and y [m].
            estimate: where it believes to be, drawn as a ghost.
            texts: names and values, shown in the corner.

        Raises:
            RenderingError: if this process is a fork of the one that has opened the window.
        """
        check_process(self._process)
        if not self._handle.is_running():
            return
        with self._handle.lock():
            self.data.qpos[:] = qpos
            mujoco.mj_forward(self._model, self.data)
            self._handle.user_scn.ngeom = 0
            decorate(self._handle.user_scn, trail, estimate)
        self._refresh(texts or {})
        while self.paused and not self._single_step and self._handle.is_running():
            time.sleep(PAUSED_FRAME)
            self._refresh(texts or {})
        self._single_step = False
        time.sleep(max(0.0, self._next_frame - time.monotonic()))
        self._next_frame = time.monotonic() + STEP_SECONDS / self.speed

    def close(self) -> None:
        """Close the window, and wait for its thread: ending Python before it would crash."""
        atexit.unregister(self.close)
        if self._process != os.getpid():
            return  # a fork leaves it to its owner
        self._handle.close()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def _refresh(self, texts: Mapping[str, str]) -> None:
        """Show what a key has changed."""
        if self.following != self._followed:
            with self._handle.lock():
                self._point_camera()
        corner = mujoco.mjtGridPos
        state = {**texts, "speed": "paused" if self.paused else f"{self.speed:g} x"}
        self._handle.set_texts(
            [
                (None, corner.mjGRID_TOPLEFT, "\n".join(state), "\n".join(state.values())),
                (None, corner.mjGRID_BOTTOMLEFT, "\n".join(HELP), "\n".join(HELP.values())),
            ]
        )
        self._handle.sync()

    def _point_camera(self) -> None:
        camera, self._followed = self._handle.cam, self.following
        chase = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, "chase")
        if self.following and chase >= 0:
            camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, chase
        else:
            mujoco.mjv_defaultFreeCamera(self._model, camera)

    def _key(self, key: int) -> None:
        """Note a key; this is called in the window's thread."""
        if key == SPACE:
            self.paused = not self.paused
        elif key == RIGHT_ARROW:
            self._single_step = self.paused
        elif key in PLUS:
            self.speed = min(2.0 * self.speed, FASTEST)
        elif key in MINUS:
            self.speed = max(0.5 * self.speed, SLOWEST)
        elif key in ENTER:
            self.following = not self.following


def _check_display() -> None:
    """Raise RuntimeError where MuJoCo would wait for ever, as no display answers."""
    import glfw

    if sys.platform != "darwin":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns of what is an error here
            if not glfw.init():
                raise RuntimeError("no display answers")
