"""Pictures of the maze, drawn without a display."""

import atexit
import contextlib
import ctypes
import ctypes.util
import importlib
import itertools
import os
import queue
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.odometry import Pose

TRAIL_COLOUR = (0.05, 0.25, 0.7, 1.0)
GHOST_COLOUR = (0.85, 0.1, 0.35, 0.55)
TRAIL_PIECES = 1500  # a longer trail is drawn with fewer points
MAX_GEOMS = 4000

# MuJoCo's module, shared library and Debian package of each way to draw.
BACKENDS = {
    "egl": ("mujoco.egl", "EGL", "libegl1"),
    "osmesa": ("mujoco.osmesa", "OSMesa", "libosmesa6"),
    "glfw": ("mujoco.glfw", None, None),
    "cgl": ("mujoco.cgl", None, None),
}


class RenderingError(ValueError):
    """This machine or process cannot draw; the message says what to do."""


def check_process(first: int) -> None:
    """Compare this process with the one that drew first.

    Raises:
        RenderingError: if it is a fork, in which OpenGL would wait for ever.
    """
    if first != os.getpid():
        raise RenderingError(
            "cannot draw in a process that was forked from one that has drawn: start it with "
            'multiprocessing\'s "spawn", or draw in one of them only'
        )


class DrawingThread:
    """The one thread that calls OpenGL: a context belongs to the thread that has made it.

    So pictures can be asked for in any thread, also in several at once.
    """

    def __init__(self) -> None:
        """Start nothing yet: a process that has not drawn can be forked."""
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._starting = threading.Lock()
        self._process: int | None = None

    def post(self, job: Callable[..., Any], *arguments: Any) -> Future:
        """Have a job done, without waiting for it.

        Raises:
            RenderingError: after a fork.
        """
        with self._starting if self._process is None else contextlib.nullcontext():
            if self._process is None:
                self._process = os.getpid()
                # A daemon still works while functions of `atexit` are called.
                threading.Thread(target=self._work, name="drawing", daemon=True).start()
        check_process(self._process)
        future: Future = Future()
        self._jobs.put((future, job, arguments))
        return future

    def call(self, job: Callable[..., Any], *arguments: Any) -> Any:
        """Have a job done and return its result, or raise its exception."""
        return self.post(job, *arguments).result()

    def _work(self) -> None:
        while True:
            future, job, arguments = self._jobs.get()
            try:
                future.set_result(job(*arguments))
            except Exception as error:
                future.set_exception(error)
            del future, job, arguments  # while it waits it must keep nothing alive


_thread = DrawingThread()
_contexts: dict[int, tuple[Any, Any]] = {}  # those that are open, by the number of the first


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
    if sys.platform == "darwin":
        return "cgl"  # windows belong to the main thread there
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in BACKENDS:
        return wanted
    if has_display():
        return "glfw"
    for name, (_, library, _) in BACKENDS.items():
        if library and ctypes.util.find_library(library):
            return name
    raise RenderingError(
        "cannot draw without a display: install EGL (Debian: apt install libegl1) "
        "or OSMesa (apt install libosmesa6)"
    )


def create_context(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """Create an offscreen OpenGL context in this thread, and MuJoCo's resources for a model in it.

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
        _contexts[id(gl)] = (gl, context)
        return gl, context
    except Exception as error:  # backends raise all kinds, down to AttributeError
        hint = f" (Debian: apt install {package})" if package else ""
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RenderingError(
            f"cannot draw with {backend}{hint}: {reason}; "
            "the environment variable MUJOCO_GL chooses another way: egl, osmesa or glfw"
        ) from error


def free_context(gl: Any, context: mujoco.MjrContext) -> None:
    """Free what `create_context` has created."""
    _contexts.pop(id(gl), None)
    gl.make_current()
    context.free()
    if type(gl).__module__ == "mujoco.osmesa":
        # PyOpenGL cannot pass on the missing buffer with which MuJoCo lets the context go.
        library = ctypes.CDLL(ctypes.util.find_library("OSMesa"))
        library.OSMesaMakeCurrent(None, None, 0, 0, 0)
    gl.free()


def _forget_contexts() -> None:
    """In a forked process, leave the contexts to the one that owns them."""
    for resource in itertools.chain(*_contexts.values()):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(resource))  # deleted, it would call OpenGL
    egl: Any = sys.modules.get("mujoco.egl")
    if egl:
        egl.EGL_DISPLAY = None  # as would MuJoCo at exit


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_contexts)


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
        gl, self._context = _thread.call(create_context, model, width, height)
        self._free = weakref.finalize(self, _thread.post, free_context, gl, self._context)
        self._free.atexit = False
        self._gl = gl
        _open.add(self)
        # Later than MuJoCo's own function, so that it is called before.
        atexit.unregister(_close_all)
        atexit.register(_close_all)

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
            RenderingError: if the renderer is closed, or this process a fork of its own.
            ValueError: if the model has no such camera.
        """
        if not self._free.alive:
            raise RenderingError("cannot draw with a renderer that is closed")
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
        if view.fixedcamid < 0:
            names = [self.model.camera(i).name for i in range(self.model.ncam)]
            raise ValueError(f"camera must be one of {names}, not {camera!r}")
        return _thread.call(self._draw, np.array(qpos), list(trail), estimate, view)

    def _draw(
        self,
        qpos: NDArray[np.float64],
        trail: list[tuple[float, float]],
        estimate: Pose | None,
        view: mujoco.MjvCamera,
    ) -> NDArray[np.uint8]:
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
        """Free the OpenGL context; a renderer that is deleted or open at the end does so itself."""
        with contextlib.suppress(RenderingError):  # a fork leaves it to its owner
            if (freed := self._free()) is not None:
                freed.result()


_open: weakref.WeakSet[OffscreenRenderer] = weakref.WeakSet()


def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()


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
