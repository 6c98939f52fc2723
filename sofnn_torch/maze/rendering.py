"""Pictures of the maze: offscreen frames without a display, or MuJoCo's viewer window."""

import atexit
import ctypes.util
import importlib
import itertools
import os
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.odometry import Pose

TRAIL_COLOUR = (0.05, 0.25, 0.7, 1.0)
GHOST_COLOUR = (0.85, 0.1, 0.35, 0.55)
TRAIL_PIECES = 1500  # a longer trail is drawn with fewer points
MAX_GEOMS = 4000
SECONDS_PER_FRAME = 0.025  # in the viewer: 20 x real time

# MuJoCo's module, shared library and Debian package of each way to draw.
BACKENDS = {
    "egl": ("mujoco.egl", "EGL", "libegl1"),
    "osmesa": ("mujoco.osmesa", "OSMesa", "libosmesa6"),
    "glfw": ("mujoco.glfw", None, None),
    "cgl": ("mujoco.cgl", None, None),
}


class RenderingError(ValueError):
    """This machine cannot draw; the message says what to install."""


def has_display() -> bool:
    """Return whether a window could be opened."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def choose_backend() -> str:
    """Return the OpenGL backend to draw offscreen with.

    The environment variable MUJOCO_GL decides if it is set. Otherwise it is EGL or else OSMesa
    where there is no display, and the windowing system's where there is one.

    Raises:
        RenderingError: if there is no display and neither library is installed.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in BACKENDS:
        return wanted
    if sys.platform == "darwin":
        return "cgl"
    if has_display():
        return "glfw"
    for name in ("egl", "osmesa"):
        if ctypes.util.find_library(BACKENDS[name][1]):
            return name
    raise RenderingError(
        "cannot draw without a display: install EGL (Debian: apt install libegl1) "
        "or OSMesa (apt install libosmesa6)"
    )


def create_context(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """Create an offscreen OpenGL context, and MuJoCo's resources for a model in it.

    Unlike `mujoco.Renderer`, which looks at MUJOCO_GL only when `mujoco` is first imported, this
    works in whatever order modules were imported.

    Raises:
        RenderingError: if the chosen backend does not work.
    """
    backend = choose_backend()
    module, _, package = BACKENDS[backend]
    try:
        gl = importlib.import_module(module).GLContext(width, height)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        return gl, context
    except Exception as error:  # backends raise all kinds, down to AttributeError
        hint = f" (Debian: apt install {package})" if package else ""
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RenderingError(
            f"cannot draw with {backend}{hint}: {reason}; "
            "the environment variable MUJOCO_GL chooses another way: egl, osmesa or glfw"
        ) from error


class OffscreenRenderer:
    """Draws a model into RGB arrays."""

    def __init__(self, model: mujoco.MjModel, width: int = 480, height: int = 480) -> None:
        """Create the OpenGL context.

        Raises:
            RenderingError: if this machine cannot draw.
            ValueError: if the size is not positive or above the model's offscreen buffer.
        """
        limit = model.vis.global_
        if not (0 < width <= limit.offwidth and 0 < height <= limit.offheight):
            raise ValueError(
                f"the picture's size must be within 1 x 1 and {limit.offwidth} x "
                f"{limit.offheight}, not {width} x {height}"
            )
        self.model = model
        self.data = mujoco.MjData(model)
        self.scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._gl, self._context = create_context(model, width, height)

    def draw(
        self,
        qpos: NDArray[np.float64],
        trail: Sequence[tuple[float, float]] = (),
        estimate: Pose | None = None,
        camera: str = "top",
    ) -> NDArray[np.uint8]:
        """Draw one picture.

        Args:
            qpos: joint positions (nq,).
            trail: where the robot has been, x and y [m].
            estimate: where it believes to be, drawn as a ghost.
            camera: "top", or "chase" behind the robot.

        Returns:
            RGB array (height, width, 3).

        Raises:
            ValueError: if the model has no such camera.
        """
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if view.fixedcamid < 0:
            names = [self.model.camera(i).name for i in range(self.model.ncam)]
            raise ValueError(f"camera must be one of {names}, not {camera!r}")
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, view, everything, self.scene
        )
        decorate(self.scene, trail, estimate)
        self._gl.make_current()
        mujoco.mjr_render(self._viewport, self.scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return pixels[::-1].copy()

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


class Viewer:
    """MuJoCo's interactive viewer, following a simulation that runs elsewhere."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Open the window.

        Raises:
            RenderingError: if there is no display, or on macOS outside `mjpython`.
        """
        if not has_display():
            raise RenderingError(
                'the viewer needs a display; without one use render_mode="rgb_array" or a video'
            )
        import mujoco.viewer  # needs GLFW, so only now

        self._model = model
        self.data = mujoco.MjData(model)
        others = set(threading.enumerate())
        try:
            self._handle = mujoco.viewer.launch_passive(
                model, self.data, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:
            raise RenderingError(str(error)) from error
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
    ) -> None:
        """Show a new state; arguments as in `OffscreenRenderer.draw`."""
        if not self._handle.is_running():
            return
        with self._handle.lock():
            self.data.qpos[:] = qpos
            mujoco.mj_forward(self._model, self.data)
            self._handle.user_scn.ngeom = 0
            decorate(self._handle.user_scn, trail, estimate)
        self._handle.sync()
        time.sleep(max(0.0, self._next_frame - time.monotonic()))
        self._next_frame = time.monotonic() + SECONDS_PER_FRAME

    def close(self) -> None:
        """Close the window, and wait for its thread: ending Python before it would crash."""
        atexit.unregister(self.close)
        self._handle.close()
        for thread in self._threads:
            thread.join(timeout=5.0)


def decorate(
    scene: mujoco.MjvScene, trail: Sequence[tuple[float, float]], estimate: Pose | None
) -> None:
    """Add the trail of the robot and the ghost of its pose estimate to a scene."""
    points = list(trail)
    if len(points) > TRAIL_PIECES:
        points = points[:: -(-len(points) // TRAIL_PIECES)] + points[-1:]
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        if (x0, y0) != (x1, y1):
            piece = _add_geom(scene, mujoco.mjtGeom.mjGEOM_LINE, TRAIL_COLOUR)
            if piece is not None:
                start, end = np.array([x0, y0, 0.001]), np.array([x1, y1, 0.001])
                mujoco.mjv_connector(piece, mujoco.mjtGeom.mjGEOM_LINE, 4.0, start, end)
    if estimate is not None:
        x, y, heading = estimate
        cos, sin = np.cos(heading), np.sin(heading)
        frame = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        # A disc wider than the robot, so that the robot is seen on it when it is right.
        disc, size = np.array([x, y, 0.001]), (0.036, 0.0005, 0.0)
        _add_geom(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, GHOST_COLOUR, size, disc, frame)
        arrow, size = np.array([x + 0.018 * cos, y + 0.018 * sin, 0.032]), (0.018, 0.002, 0.001)
        _add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, GHOST_COLOUR, size, arrow, frame)


def _add_geom(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    colour: tuple[float, ...],
    size: tuple[float, ...] = (0.0, 0.0, 0.0),
    position: NDArray[np.float64] | None = None,
    frame: NDArray[np.float64] | None = None,
) -> mujoco.MjvGeom | None:
    """Append a decor geom; None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom,
        kind,
        np.array(size),
        np.zeros(3) if position is None else position,
        (np.eye(3) if frame is None else frame).ravel(),
        np.array(colour, dtype=np.float32),
    )
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    scene.ngeom += 1
    return geom
