"""The simulated Khepera: the MJCF as a robot that drives and answers questions."""

import functools
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sofnn_torch.maze.arguments import choice, whole
from sofnn_torch.maze.layouts import STANDARD, content, mjcf
from sofnn_torch.maze.odometry import STEP_SECONDS, WHEEL_RADIUS, Pose, wrap_angle
from sofnn_torch.maze.plan import MazePlan, heading_of
from sofnn_torch.maze.sensors import INFRARED, INFRARED_RANGE

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def load_model(layout: str | Path = STANDARD, drawn: bool = True) -> mujoco.MjModel:
    """Compile a layout, by default the standard maze.

    Without the `drawn` geoms that collide with nothing, physics is the same and faster.

    Raises:
        ValueError: if there is no such layout, or MuJoCo cannot read it.
    """
    text = mjcf(content(layout))
    try:
        spec = mujoco.MjSpec.from_string(text)
        spec.compiler.discardvisual = not drawn
        return spec.compile()
    except Exception as error:  # MuJoCo's own are of several kinds and lines
        raise ValueError(f"it is no MJCF model: {' '.join(str(error).split())}") from error


class Physics:
    """The simulated robot: drives, and answers questions about its state."""

    def __init__(self, layout: str | Path | mujoco.MjModel = STANDARD) -> None:
        """Take a layout or a model with the element names of the standard maze (default).

        Raises:
            ValueError: one line if it is no maze, or its timestep does not divide 0.5 s.
        """
        model = layout if isinstance(layout, mujoco.MjModel) else None
        self.model = load_model(layout, drawn=False) if model is None else model
        timestep = self.model.opt.timestep
        self.substeps = round(STEP_SECONDS / timestep)
        if abs(self.substeps * timestep - STEP_SECONDS) > 1e-9:
            raise ValueError(f"timestep {timestep} s does not divide {STEP_SECONDS} s")
        # Sensors are evaluated on demand: 8 rays in every timestep would double its cost.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        self.data = mujoco.MjData(self.model)
        try:
            self.plan = MazePlan.from_model(self.model)
            self._left_wheel = self.model.joint("wheel_left").qposadr.item()
            self._right_wheel = self.model.joint("wheel_right").qposadr.item()
            self._floor = self.model.geom("floor").id
            self._infrared = [self.model.sensor(name).adr.item() for name in INFRARED]
        except KeyError as error:
            what = str(error.args[0]).split(". Valid")[0]
            raise ValueError(f"the model lacks an element of the standard maze: {what}") from error
        self._look_at_data()
        self.place(self.plan.start)

    def _look_at_data(self) -> None:
        data = self.data
        self._qpos, self._ctrl, self._sensors = data.qpos, data.ctrl, data.sensordata

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle takes along; its views will be of its own data."""
        views = {"_qpos", "_ctrl", "_sensors"}
        return {name: self.__dict__[name] for name in self.__dict__.keys() - views}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy."""
        self.__dict__.update(state)
        self._look_at_data()

    def check_view(self, camera: str, width: int, height: int) -> tuple[str, int, int]:
        """Return a camera and the size [pixels] of its pictures as plain values.

        Raises:
            ValueError: if there is no such camera, or the offscreen buffer is smaller.
        """
        cameras = tuple(self.model.camera(i).name for i in range(self.model.ncam))
        limit = self.model.vis.global_
        return (
            choice("camera", camera, cameras),
            whole("width", width, limit.offwidth),
            whole("height", height, limit.offheight),
        )

    def place(self, pose: Pose) -> None:
        """Put the robot down at rest at a pose (x [m], y [m], heading [rad])."""
        x, y, heading = pose
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.key("start").id)
        self._qpos[:2] = x, y
        self._qpos[3:7] = math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
        mujoco.mj_forward(self.model, self.data)

    def drive(self, left: float, right: float) -> None:
        """Simulate one step of 0.5 s at wheel speeds in m/s."""
        self._ctrl[0] = left / WHEEL_RADIUS
        self._ctrl[1] = right / WHEEL_RADIUS
        mujoco.mj_step(self.model, self.data, self.substeps)

    def position(self) -> tuple[float, float]:
        """Return x and y of the robot's centre [m]."""
        return self._qpos.item(0), self._qpos.item(1)

    def pose(self) -> Pose:
        """Return x [m], y [m] and heading [rad, in [-pi, pi)] of the robot."""
        x, y, _, *quaternion = self._qpos.tolist()[:7]
        return x, y, heading_of(*quaternion)

    def bumped(self) -> bool:
        """Return whether the robot touches a wall at the end of the step."""
        # Their number does not tell: a tyre or caster may have left the floor.
        return any(geom != self._floor for geom in self.data.contact.geom1.tolist())

    def wall_bearings(self) -> list[float]:
        """Return the direction of each touched wall, seen from the robot's heading [rad]."""
        heading = self.pose()[2]
        normals = self.data.contact.frame[:, :2].tolist()  # those of the floor are vertical
        return [wrap_angle(math.atan2(y, x) - heading) for x, y in normals if x * x + y * y > 0.5]

    def wheel_travel(self) -> tuple[float, float]:
        """Return the distances [m] that the encoders of the left and right wheel have counted."""
        left, right = self._qpos.item(self._left_wheel), self._qpos.item(self._right_wheel)
        return left * WHEEL_RADIUS, right * WHEEL_RADIUS

    def infrared_ranges(self) -> list[float]:
        """Return the free distance [m] before each of the 8 infrared sensors, at most 0.05."""
        options = self.model.opt
        options.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_sensorPos(self.model, self.data)
        options.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        ranges = self._sensors[self._infrared].tolist()
        return [min(r, INFRARED_RANGE) if r >= 0.0 else INFRARED_RANGE for r in ranges]

    def state(self) -> list[float]:
        """Return all numbers that the simulation's future depends on."""
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        return state.tolist()

    def set_state(self, state: list[float]) -> None:
        """Go back to a state returned by `state`.

        Raises:
            ValueError: if it belongs to another model.
        """
        size = mujoco.mj_stateSize(self.model, STATE)
        if len(state) != size:
            raise ValueError(f"the saved physics state has {len(state)} numbers, this model {size}")
        mujoco.mj_setState(self.model, self.data, np.asarray(state, dtype=np.float64), STATE)


@functools.lru_cache(maxsize=64)
def plan_of(layout: str) -> MazePlan:
    """The plan of a layout as `layouts.content` returns it.

    Raises:
        ValueError: one line if it is no maze for this robot.
    """
    return Physics(layout).plan


def checked(name: str, layout: str | Path) -> str:
    """Return a layout as it is kept (`layouts.content`) if it is a maze for this robot.

    Args:
        name: of the setting, for the message.
        layout: a name, a file or a text.

    Raises:
        ValueError: one line on what is wrong.
    """
    try:
        text = content(layout)
        plan_of(text)
        return text
    except ValueError as error:
        which = "" if "\n" in str(layout) else f" {str(layout)[:120]}"
        raise ValueError(f"{name}{which}: {error}") from None
