"""The Khepera in its maze as a Gymnasium environment: decisions, rewards, pose estimates."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np

from sofnn_torch.maze.arguments import choice, real, show, vector
from sofnn_torch.maze.odometry import (
    FORWARD_SPEED,
    STEP_SECONDS,
    WHEEL_BASE,
    DeadReckoning,
    MotorNoise,
    Pose,
    pose_errors,
)
from sofnn_torch.maze.plan import MazePlan
from sofnn_torch.maze.rendering import OffscreenRenderer
from sofnn_torch.maze.robot import Physics, load_model
from sofnn_torch.maze.sensors import INFRARED, felt_walls, readings
from sofnn_torch.maze.settings import MazeConfig, axes
from sofnn_torch.maze.spaces import (
    ACTION_NAMES,
    LEFT,
    RIGHT,
    STRAIGHT,
    action_space,
    commanded,
    observation_space,
)
from sofnn_torch.maze.viewer import Viewer
from sofnn_torch.network.axes import Axis

__all__ = ["LEFT", "RIGHT", "STRAIGHT", "KheperaMazeEnv", "MazePlan", "Physics"]

START, GOAL = -2, -1  # zones; the others are the numbers of sub-goals


class KheperaMazeEnv(gymnasium.Env[np.ndarray, Any]):
    """Drive from the start to the goal of the maze.

    One `step` is one decision: the action is held for `hold` simulator steps of 0.5 s, or until
    the robot bumps into a wall, reaches the goal or runs out of steps.

    Observation, float32 (3,): x [m], y [m], heading [rad, in [-pi, pi)] by the chosen `pose`:
    "estimated" adds up commanded movements, "odometry" wheel encoders, "true" is the simulated
    robot's. With `range_sensors` (12,): 8 infrared readings [m] and the bump (0 or 1) follow.

    Actions: "three" is Discrete(3), the paper's right turn (0), straight (1), left turn (2).
    "steer" is Box(1,) from -1 (right turn) over 0 (straight) to 1 (left turn). "wheels" is Box(2,),
    left and right wheel speed in units of 10 mm/s.

    Rewards add up over a decision: `goal_reward` at the goal, where the trial ends,
    `collision_reward` for a bump, `subgoal_reward` for each sub-goal, once a trial, and
    `step_reward` for the decision itself.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("sofnn_torch:KheperaMaze-v0", pose="true", layout="rooms")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(1)  # straight on
        >>> terminated, info["steps"]
        (False, 10)
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        pose: str = "estimated",
        range_sensors: bool = False,
        render_mode: str | None = None,
        camera: str = "top",
        width: int = 480,
        height: int = 480,
        speed: float = 20.0,
        **settings: Any,
    ) -> None:
        """Build the environment.

        Args:
            pose: "estimated", "odometry" or "true": what the observation holds.
            range_sensors: add 8 infrared readings and the bump to the observation.
            render_mode: None, "rgb_array" or "human".
            camera: "top" or "chase".
            width: of the picture in pixels.
            height: of the picture in pixels.
            speed: of the window, times real time.
            settings: fields of `MazeConfig`: layout, actions, rewards, noise, dead reckoning.

        Raises:
            ValueError: if a setting is of the wrong type or out of range.
            TypeError: if there is no such setting.
        """
        self.settings = chosen = MazeConfig(**settings)
        self.pose_mode = choice("pose", pose, ("estimated", "odometry", "true"))
        self.render_mode = choice(
            "render_mode", render_mode, (None, *self.metadata["render_modes"])
        )
        if not isinstance(range_sensors, bool | np.bool_):
            raise ValueError(f"range_sensors must be True or False, not {show(range_sensors)}")
        self.range_sensors = bool(range_sensors)
        self.speed = real("speed", speed)
        if self.speed <= 0.0:
            raise ValueError(f"speed must be positive, not {speed}")
        self.physics = Physics(chosen.layout)
        self.camera, self.width, self.height = self.physics.check_view(camera, width, height)
        self.plan = plan = self.physics.plan
        self.noise = MotorNoise(chosen.motor_noise, chosen.wheel_noise)
        base = WHEEL_BASE * chosen.wheel_base_scale
        self.estimator = DeadReckoning(chosen.dead_reckoning, base, plan.size, chosen.right_angles)
        self.action_space = action_space(chosen.actions)
        # Without its guard an estimate may leave the arena, by at most what a trial can drive.
        free = pose != "true" and not self.estimator.guarded
        way = chosen.max_steps * STEP_SECONDS * FORWARD_SPEED * chosen.wheel_radius_scale
        self.observation_space = observation_space(plan, way * free, self.range_sensors)
        self._aim(0)

        self.trial = self.decision = 0  # numbers that the window shows
        self.caption = ""  # what it shows beside them, e.g. the rule that decides
        self.total_steps = 0
        self.done = True
        self.subgoals = [False] * len(plan.subgoals)
        self.trail: list[tuple[float, float]] = []
        self._senses = np.random.default_rng(0)  # of the noise of the infrared sensors
        self.on_simulator_step: Callable[[], None] | None = None  # e.g. to record each frame
        self._renderer: OffscreenRenderer | Viewer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a trial at the start, or at `options={"pose": (x, y, heading)}` [m, m, rad].

        Raises:
            ValueError: if there are other options, or the pose is not free of walls.
        """
        super().reset(seed=seed)
        pose = self._start_pose(options or {})
        if self.plan.told:
            self._aim(int(self.np_random.integers(len(self.plan.goals))))
        # Of their own, so that the robot moves as it would without them.
        self._senses = np.random.default_rng(self.np_random.bit_generator.state["state"]["state"])
        self._draws = self._draw(1)
        self.physics.place(pose)
        self.estimator.fix(pose)
        self.trial, self.decision, self.caption = self.trial + 1, 0, ""
        self.total_steps = 0
        self.done = False
        self.subgoals = [False] * len(self.plan.subgoals)
        self._inside = self._around(pose[:2])
        self.trail = [pose[:2]]
        if self.render_mode == "human":
            self.render()
        return self._observation(False), self._info(0, False, False)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action and return observation, reward, terminated, truncated, info.

        Raises:
            ValueError: if the action is not in the action space.
            gymnasium.error.ResetNeeded: if the trial is over.
        """
        if self.done:
            raise gymnasium.error.ResetNeeded("the trial is over: call reset() before step()")
        left, right = self.wheel_speeds(action)
        self.decision += 1
        # One draw for a whole decision, however early it ends: fast, and easy to reproduce.
        draws = iter(self.np_random.random(2 * self.settings.hold).tolist())
        self._draws = self._draw(self.settings.hold + 1)
        reward = self.settings.step_reward
        steps, bumped, success = 0, False, False
        limit = min(self.settings.hold, self.settings.max_steps - self.total_steps)
        while steps < limit and not (bumped or success):
            reward_now, bumped, success = self._simulate(left, right, next(draws), next(draws))
            reward += reward_now
            steps += 1
        self.total_steps += steps
        truncated = self.total_steps >= self.settings.max_steps and not success
        self.done = success or truncated
        info = self._info(steps, bumped, success)
        return self._observation(bumped), reward, success, truncated, info

    def wheel_speeds(self, action: Any) -> tuple[float, float]:
        """Return the commanded speeds of the left and right wheel [m/s] for an action."""
        return commanded(self.settings.actions, action)

    def render(self) -> np.ndarray | None:
        """Return the view of the maze as an RGB array (height, width, 3), or update the window.

        Shown are the trail of this trial and, as a ghost, where the robot believes to be.

        Raises:
            RenderingError: if this machine cannot draw.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() needs render_mode="rgb_array" or "human"')
            return None
        qpos, estimate = self.physics.data.qpos, self.estimator.pose
        if self._renderer is None:
            model = load_model(self.settings.layout)
            if self.render_mode == "human":
                self._renderer = Viewer(model, self.speed, self.camera)
            else:
                self._renderer = OffscreenRenderer(model, self.width, self.height)
        if isinstance(self._renderer, Viewer):
            texts = {
                "trial": f"{self.trial}",
                "time": f"{self.physics.data.time:.1f} s",
                "decision": f"{self.decision}",
            }
            texts |= {"rule": self.caption} if self.caption else {}
            self._renderer.draw(qpos, self.trail, estimate, texts)
            return None
        return self._renderer.draw(qpos, self.trail, estimate, self.camera)

    def close(self) -> None:
        """Free the renderer or close the viewer window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @property
    def axes(self) -> tuple[Axis, ...]:
        """What the first observations are: x, y and heading, and the goal where that varies."""
        return axes(self.plan)

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the actions are called: one name for each choice, or for each number."""
        return ACTION_NAMES[self.settings.actions]

    def measure(self, infos: Sequence[dict[str, Any]]) -> dict[str, float]:
        """Return what a trial was like, from the info at its start and of each decision.

        `collisions`, decisions that ended in a bump, `subgoals` that were found, and how far the
        pose estimates were from the truth, see `pose_errors`.
        """
        poses = (np.array([info[n] for info in infos]) for n in ("true_pose", "estimated_pose"))
        return {
            "collisions": sum(int(info["collision"]) for info in infos[1:]),
            "subgoals": sum(map(bool, infos[-1]["subgoals"])),
            **pose_errors(*poses),
        }

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle takes along: all but the renderer and the callback.

        A copy drives on like the original, and draws with a renderer of its own.
        """
        return self.__dict__ | {"_renderer": None, "on_simulator_step": None}

    def state_dict(self) -> dict[str, Any]:
        """Return the full state as plain numbers and lists; from it the future is bit-identical."""
        goal = {"goal": self.goal} if self.plan.told else {}
        return goal | {
            "physics": self.physics.state(),
            "generator": self.np_random.bit_generator.state,
            "senses": self._senses.bit_generator.state,
            "estimate": list(self.estimator.pose),
            "total_steps": self.total_steps,
            "done": self.done,
            "subgoals": list(self.subgoals),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state returned by `state_dict` of an environment built alike."""
        self.physics.set_state(state["physics"])
        self.np_random.bit_generator.state = state["generator"]
        self._senses.bit_generator.state = state["senses"]
        self.estimator.pose = tuple(state["estimate"])
        self.total_steps = state["total_steps"]
        self.done = state["done"]
        self.subgoals = list(state["subgoals"])
        self.trail = [self.physics.position()]
        self._aim(state.get("goal", 0))
        self._inside = self._around(self.physics.position())

    def _simulate(
        self, left: float, right: float, first: float, second: float
    ) -> tuple[float, bool, bool]:
        """Simulate one step of 0.5 s; return its reward, whether it bumped and reached the goal."""
        physics, scale = self.physics, self.settings.wheel_radius_scale
        encoders = physics.wheel_travel() if self.pose_mode == "odometry" else None
        physics.drive(*self.noise.apply(left, right, first, second))
        walls = self._walls(left + right)
        bumped = bool(walls)

        if encoders is None:
            rolled_left, rolled_right = left * STEP_SECONDS, right * STEP_SECONDS
        else:
            now = physics.wheel_travel()
            rolled_left, rolled_right = now[0] - encoders[0], now[1] - encoders[1]
        self.estimator.update(rolled_left * scale, rolled_right * scale, walls)

        reward = self.settings.collision_reward if bumped else 0.0
        position = physics.position()
        before, self._inside = self._inside, self._around(position)
        for zone in self._inside:
            reward += self._enter(zone, zone not in before)
        success = GOAL in self._inside
        if self.render_mode is not None:
            self.trail.append(position)
            if self.render_mode == "human":
                self.render()
        if self.on_simulator_step is not None:
            self.on_simulator_step()
        return reward, bumped, success

    def _aim(self, goal: int) -> None:
        """Let a goal be that of the trial, beside the others unless the robot is told which."""
        self.goal, plan = goal, self.plan
        goals = [plan.goals[goal]] if plan.told else plan.goals
        zones = [(i, centre, plan.subgoal_radius) for i, centre in enumerate(plan.subgoals)]
        zones += [(START, start[:2], plan.start_radius) for start in plan.starts]
        zones += [(GOAL, centre, plan.goal_radius) for centre in goals]
        self._zones = [(zone, (*at, r * r)) for zone, at, r in zones if r > 0.0]

    def _around(self, position: tuple[float, float]) -> list[int]:
        """Return the zones in which a position lies."""
        x, y = position
        zones = []
        for zone, (centre_x, centre_y, square) in self._zones:
            dx, dy = x - centre_x, y - centre_y
            if dx * dx + dy * dy <= square:
                zones.append(zone)
        return zones

    def _enter(self, zone: int, entry: bool) -> float:
        """Return the reward inside a zone; correct the estimate at landmarks."""
        if zone == GOAL:
            return self.settings.goal_reward
        new = zone != START and not self.subgoals[zone]
        told = self.settings.landmarks == "inside" or (
            zone != START and (new if self.settings.landmarks == "first" else entry)
        )
        if told:
            x, y, heading = self.physics.pose()
            keeps = self.settings.landmarks == "position"
            self.estimator.fix((x, y, self.estimator.pose[2] if keeps else heading))
        if new:
            self.subgoals[zone] = True
        return self.settings.subgoal_reward * new

    def _walls(self, forward: float) -> Sequence[float]:
        """Return the directions [rad] of the walls that the robot bumps into."""
        if self.settings.bumps == "contact":
            return self.physics.wall_bearings() if self.physics.bumped() else ()
        return felt_walls(self._infrared(), forward) if forward else ()

    def _infrared(self) -> list[float]:
        noise, draws = self.settings.infrared_noise, next(self._draws)
        return readings(self.physics.infrared_ranges(), noise, draws)

    def _draw(self, readings: int) -> Iterator[list[float]]:
        return iter(self._senses.random((readings, len(INFRARED))).tolist())

    def _observation(self, bumped: bool) -> np.ndarray:
        pose = self.physics.pose() if self.pose_mode == "true" else self.estimator.pose
        goal = self.plan.goals[self.goal] if self.plan.told else ()
        if not self.range_sensors:
            return np.array([*pose, *goal], dtype=np.float32)
        return np.array([*pose, *goal, *self._infrared(), bumped], dtype=np.float32)

    def _info(self, steps: int, bumped: bool, success: bool) -> dict[str, Any]:
        goal = {"goal": np.array(self.plan.goals[self.goal])} if self.plan.told else {}
        return goal | {
            "steps": steps,
            "total_steps": self.total_steps,
            "collision": bumped,
            "success": success,
            "is_success": success,  # the name that evaluation callbacks read
            "subgoals": np.array(self.subgoals, dtype=np.int8),
            "true_pose": np.array(self.physics.pose()),
            "estimated_pose": np.array(self.estimator.pose),
        }

    def _start_pose(self, options: dict[str, Any]) -> Pose:
        unknown = set(options) - {"pose"}
        if unknown:
            raise ValueError(f'unknown reset options {sorted(unknown)}: only "pose" is known')
        if "pose" not in options:
            return self.plan.draw_start(self.np_random)
        x, y, heading = vector("the reset pose", options["pose"], 3)
        if not self.plan.has_room(x, y):
            raise ValueError(f"the robot cannot be put at {(x, y)}: a wall is there")
        return x, y, heading
