"""The Khepera in its maze as a Gymnasium environment: decisions, rewards, pose estimates."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from sofnn_torch.maze.arguments import choice, real, show, vector, whole
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
from sofnn_torch.maze.robot import Physics, checked, load_model
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

MAX_HOLD = 10_000  # steps; motor noise is drawn for a whole decision at once
START, GOAL = -2, -1  # zones; the others are the numbers of sub-goals


class KheperaMazeEnv(gymnasium.Env[np.ndarray, Any]):
    """Drive from the start to the goal of the maze.

    One `step` is one decision: the action is held for `hold` simulator steps of 0.5 s, or until
    the robot bumps into a wall, reaches the goal or runs out of steps.

    Observation, float32 (3,): x [m], y [m], heading [rad, in [-pi, pi)] by the chosen `pose`:
    "estimated" adds up commanded movements, "odometry" wheel encoders, "true" is the simulated
    robot's. With `range_sensors` (12,): 8 infrared ranges [m] and the bumper (0 or 1) follow.

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
        layout: str | Path = MazeConfig.layout,
        actions: str = MazeConfig.actions,
        hold: int = MazeConfig.hold,
        max_steps: int = MazeConfig.max_steps,
        motor_noise: float = MazeConfig.motor_noise,
        wheel_noise: str = MazeConfig.wheel_noise,
        dead_reckoning: str = MazeConfig.dead_reckoning,
        goal_reward: float = MazeConfig.goal_reward,
        collision_reward: float = MazeConfig.collision_reward,
        subgoal_reward: float = MazeConfig.subgoal_reward,
        step_reward: float = MazeConfig.step_reward,
        wheel_radius_scale: float = MazeConfig.wheel_radius_scale,
        wheel_base_scale: float = MazeConfig.wheel_base_scale,
        range_sensors: bool = False,
        render_mode: str | None = None,
        camera: str = "top",
        width: int = 480,
        height: int = 480,
        speed: float = 20.0,
    ) -> None:
        """Build the environment.

        Args:
            pose: "estimated", "odometry" or "true": what the observation holds.
            layout: a maze that is built in, a file or the text of a map or an MJCF, see `layouts`.
            actions: "three", "steer" or "wheels".
            hold: simulator steps for which an action is held.
            max_steps: trial limit in simulator steps.
            motor_noise: relative half-width of the uniform motor noise, see `MotorNoise`.
            wheel_noise: "common" or "independent", see `MotorNoise`.
            dead_reckoning: "guarded", "still" or "literal", see `DeadReckoning`.
            goal_reward: reward at the goal.
            collision_reward: reward for a decision that ends in a bump.
            subgoal_reward: reward for each sub-goal, once a trial.
            step_reward: reward for every decision.
            wheel_radius_scale: wheel radius that dead reckoning believes, over the true one.
            wheel_base_scale: wheel base that dead reckoning believes, over the true one.
            range_sensors: add 8 infrared ranges and the bumper to the observation.
            render_mode: None, "rgb_array" or "human".
            camera: "top" or "chase".
            width: of the picture in pixels.
            height: of the picture in pixels.
            speed: of the window, times real time.

        Raises:
            ValueError: if a setting is unknown or out of range.
        """
        pose = choice("pose", pose, ("estimated", "odometry", "true"))
        actions = choice("actions", actions, tuple(ACTION_NAMES))
        render_mode = choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        for name, scale in (("radius", wheel_radius_scale), ("base", wheel_base_scale)):
            if real(f"wheel_{name}_scale", scale) <= 0.0:
                raise ValueError(f"wheel_{name}_scale must be positive, not {scale}")
        if not isinstance(range_sensors, bool | np.bool_):
            raise ValueError(f"range_sensors must be True or False, not {show(range_sensors)}")

        self.layout = checked("layout", layout)
        self.physics = Physics(self.layout)
        self.camera, self.width, self.height = self.physics.check_view(camera, width, height)
        self.plan = plan = self.physics.plan
        self.speed = real("speed", speed)
        if self.speed <= 0.0:
            raise ValueError(f"speed must be positive, not {speed}")
        self.noise = MotorNoise(motor_noise, wheel_noise)
        self.estimator = DeadReckoning(
            dead_reckoning, WHEEL_BASE * float(wheel_base_scale), self.plan.size
        )
        self.pose_mode, self.actions, self.render_mode = pose, actions, render_mode
        self.hold = whole("hold", hold, MAX_HOLD)
        self.max_steps = whole("max_steps", max_steps)
        self.goal_reward = real("goal_reward", goal_reward)
        self.collision_reward = real("collision_reward", collision_reward)
        self.subgoal_reward = real("subgoal_reward", subgoal_reward)
        self.step_reward = real("step_reward", step_reward)
        self.wheel_radius_scale = float(wheel_radius_scale)
        self.range_sensors = bool(range_sensors)
        self.action_space = action_space(actions)
        # Without its guard an estimate may leave the arena, by at most what a trial can drive.
        free = pose != "true" and not self.estimator.guarded
        reach = self.max_steps * STEP_SECONDS * FORWARD_SPEED * self.wheel_radius_scale * free
        self.observation_space = observation_space(plan, reach, self.range_sensors)
        self._aim(0)

        self.trial = self.decision = 0  # numbers that the window shows
        self.caption = ""  # what it shows beside them, e.g. the rule that decides
        self.total_steps = 0
        self.done = True
        self.subgoals = [False] * len(plan.subgoals)
        self.trail: list[tuple[float, float]] = []
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
        self.physics.place(pose)
        self.estimator.fix(pose)
        self.trial, self.decision, self.caption = self.trial + 1, 0, ""
        self.total_steps = 0
        self.done = False
        self.subgoals = [False] * len(self.plan.subgoals)
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
        draws = iter(self.np_random.random(2 * self.hold).tolist())
        reward = self.step_reward
        steps, bumped, success = 0, False, False
        limit = min(self.hold, self.max_steps - self.total_steps)
        while steps < limit and not (bumped or success):
            reward_now, bumped, success = self._simulate(left, right, next(draws), next(draws))
            reward += reward_now
            steps += 1
        self.total_steps += steps
        truncated = self.total_steps >= self.max_steps and not success
        self.done = success or truncated
        info = self._info(steps, bumped, success)
        return self._observation(bumped), reward, success, truncated, info

    def wheel_speeds(self, action: Any) -> tuple[float, float]:
        """Return the commanded speeds of the left and right wheel [m/s] for an action."""
        return commanded(self.actions, action)

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
            model = load_model(self.layout)
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
        return ACTION_NAMES[self.actions]

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
            "estimate": list(self.estimator.pose),
            "total_steps": self.total_steps,
            "done": self.done,
            "subgoals": list(self.subgoals),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state returned by `state_dict` of an environment built alike."""
        self.physics.set_state(state["physics"])
        self.np_random.bit_generator.state = state["generator"]
        self.estimator.pose = tuple(state["estimate"])
        self.total_steps = state["total_steps"]
        self.done = state["done"]
        self.subgoals = list(state["subgoals"])
        self.trail = [self.physics.position()]
        self._aim(state.get("goal", 0))

    def _simulate(
        self, left: float, right: float, first: float, second: float
    ) -> tuple[float, bool, bool]:
        """Simulate one step of 0.5 s; return its reward, whether it bumped and reached the goal."""
        physics, scale = self.physics, self.wheel_radius_scale
        encoders = physics.wheel_travel() if self.pose_mode == "odometry" else None
        physics.drive(*self.noise.apply(left, right, first, second))
        bumped = physics.bumped()
        x, y = physics.position()

        if encoders is None:
            rolled_left, rolled_right = left * STEP_SECONDS, right * STEP_SECONDS
        else:
            now = physics.wheel_travel()
            rolled_left, rolled_right = now[0] - encoders[0], now[1] - encoders[1]
        walls = physics.wall_bearings() if bumped else ()
        self.estimator.update(rolled_left * scale, rolled_right * scale, walls)

        reward, success = self.collision_reward if bumped else 0.0, False
        for zone, (centre_x, centre_y, square) in self._zones:
            dx, dy = x - centre_x, y - centre_y
            if dx * dx + dy * dy <= square:
                reward += self._enter(zone)
                success = success or zone == GOAL
        if self.render_mode is not None:
            self.trail.append((x, y))
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

    def _enter(self, zone: int) -> float:
        """Return the reward inside a zone; correct the estimate at landmarks."""
        if zone == GOAL:
            return self.goal_reward
        new = zone != START and not self.subgoals[zone]
        if new or self.estimator.guarded:
            self.estimator.fix(self.physics.pose())
        if new:
            self.subgoals[zone] = True
        return self.subgoal_reward * new

    def _observation(self, bumped: bool) -> np.ndarray:
        pose = self.physics.pose() if self.pose_mode == "true" else self.estimator.pose
        goal = self.plan.goals[self.goal] if self.plan.told else ()
        if not self.range_sensors:
            return np.array([*pose, *goal], dtype=np.float32)
        return np.array([*pose, *goal, *self.physics.infrared_ranges(), bumped], dtype=np.float32)

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
