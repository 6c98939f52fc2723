"""The simulated Khepera: the MJCF as a robot that drives and answers questions."""

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sofnn_torch.maze.arguments import choice, show, whole
from sofnn_torch.maze.odometry import STEP_SECONDS, WHEEL_RADIUS, Pose, wrap_angle

INFRARED = (
    "ir_left_90",
    "ir_left_45",
    "ir_left_0",
    "ir_right_0",
    "ir_right_45",
    "ir_right_90",
    "ir_back_right",
    "ir_back_left",
)
INFRARED_RANGE = 0.1  # m
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def default_model_path() -> Path:
    """Return the maze's MJCF, from the installed package or the checkout around it."""
    package = Path(str(resources.files("sofnn_torch")))
    installed = package / "assets" / "khepera_maze.xml"
    return installed if installed.is_file() else package.parent / "assets" / installed.name


def load_model(path: str | Path | None = None, drawn: bool = True) -> mujoco.MjModel:
    """Compile an MJCF, by default the standard maze.

    Without the `drawn` geoms that collide with nothing, physics is the same and faster.

    Raises:
        ValueError: if there is no such file, or MuJoCo cannot read it.
    """
    if not isinstance(path, str | Path | None):
        raise ValueError(f"model_path must be the path of an MJCF file, not {show(path)}")
    path = Path(path) if path is not None else default_model_path()
    if not path.is_file():
        raise ValueError(f"no MJCF file at {path}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.discardvisual = not drawn
        return spec.compile()
    except Exception as error:  # MuJoCo's own are of several kinds and lines
        raise ValueError(f"{path} is no MJCF model: {' '.join(str(error).split())}") from error


def heading_of(w: float, x: float, y: float, z: float) -> float:
    """Return the yaw [rad, in [-pi, pi)] of a unit quaternion."""
    return wrap_angle(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


@dataclass(frozen=True)
class MazePlan:
    """The maze as seen from above, in metres; read from the MJCF, the only source of geometry."""

    size: tuple[float, float]
    walls: list[tuple[float, float, float, float]]  # x0, y0, x1, y1, outer walls included
    start: Pose
    goal: tuple[float, float]
    goal_radius: float
    subgoals: list[tuple[float, float]]
    subgoal_radius: float
    start_radius: float
    robot_radius: float

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> "MazePlan":
        """Read walls, zones, robot size and start pose from named geoms, sites and the keyframe."""
        walls = []
        for geom in (model.geom(i) for i in range(model.ngeom)):
            if geom.name.startswith("wall"):
                (x, y, _), (a, b, _) = geom.pos.tolist(), geom.size.tolist()
                walls.append((x - a, y - b, x + a, y + b))
        if not walls:
            raise KeyError("a geom whose name begins with wall")
        sites = [model.site(i) for i in range(model.nsite)]
        zones = {site.name: (tuple(site.pos[:2].tolist()), site.size.item(0)) for site in sites}
        subgoals = [zones[name] for name in sorted(zones) if name.startswith("subgoal")]
        x, y, _, *quaternion = model.key("start").qpos[:7].tolist()
        return cls(
            # The outer walls begin where the arena ends.
            size=(max(wall[0] for wall in walls), max(wall[1] for wall in walls)),
            walls=walls,
            start=(x, y, heading_of(*quaternion)),
            goal=zones["goal"][0],
            goal_radius=zones["goal"][1],
            subgoals=[position for position, _ in subgoals],
            subgoal_radius=subgoals[0][1] if subgoals else 0.0,
            start_radius=zones["start"][1],
            robot_radius=model.geom("rim").size.item(0),
        )

    def clearance(self, x: float, y: float) -> float:
        """Return the free distance [m] between a robot centred at (x, y) and the nearest wall."""
        return (
            min(
                math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1))
                for x0, y0, x1, y1 in self.walls
            )
            - self.robot_radius
        )


class Physics:
    """The simulated robot: drives, and answers questions about its state."""

    def __init__(self, model: str | Path | mujoco.MjModel | None = None) -> None:
        """Take a model or an MJCF file with the element names of the standard maze (default).

        Raises:
            ValueError: if the file is missing or the timestep does not divide 0.5 s.
        """
        self.model = model if isinstance(model, mujoco.MjModel) else load_model(model, drawn=False)
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
            for name in INFRARED:
                self.model.sensor(name)
        except KeyError as error:
            what = str(error.args[0]).split(". Valid")[0]
            raise ValueError(f"the model lacks an element of the standard maze: {what}") from error
        self._look_at_data()
        self.place(self.plan.start)

    def _look_at_data(self) -> None:
        self._qpos, self._ctrl = self.data.qpos, self.data.ctrl

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle takes along; its views will be of its own data."""
        return {name: self.__dict__[name] for name in self.__dict__.keys() - {"_qpos", "_ctrl"}}

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
        """Return the free distance [m] before each of the 8 infrared sensors, at most 0.1."""
        options = self.model.opt
        options.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_sensorPos(self.model, self.data)
        options.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        ranges = (self.data.sensor(name).data.item() for name in INFRARED)
        return [distance if distance >= 0.0 else INFRARED_RANGE for distance in ranges]

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
