"""Cost and fidelity of the simulated robot against MuJoCo's default settings.

The reference is the same robot at a timestep of 0.005 s with every option at MuJoCo's default
(integrator, cone, jacobian, flags); without sensors and without geoms that are only drawn, which
it would be unfair to count; calibrated to the same 5 mm a step. All variants run in one process,
interleaved, one after the other in every repeat; times are medians over the repeats, ratios
medians of the ratios in each repeat.

    python benchmarks/physics.py --out physics.json
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from timing import arguments, median, ratio, report

from sofnn_torch.maze.layouts import standard_path
from sofnn_torch.maze.odometry import MotorNoise, wrap_angle
from sofnn_torch.maze.optimum import optimal_steps
from sofnn_torch.maze.robot import Physics

STRAIGHT, LEFT, RIGHT = (0.010, 0.010), (-0.004, 0.004), (0.004, -0.004)
Change = Callable[[mujoco.MjSpec], None]


def option(**values: float) -> Change:
    """Return a change of options, e.g. `option(timestep=0.01)`."""

    def change(spec: mujoco.MjSpec) -> None:
        for name, value in values.items():
            setattr(spec.option, name, value)

    return change


def default_options(spec: mujoco.MjSpec) -> None:
    """Set timestep 0.005 s and all other options to MuJoCo's defaults."""
    default = mujoco.MjSpec().option
    for name in ("integrator", "cone", "jacobian", "solver", "disableflags", "enableflags"):
        setattr(spec.option, name, getattr(default, name))
    spec.option.timestep = 0.005


def default_contacts(spec: mujoco.MjSpec) -> None:
    """Also set the softness and margins of all contacts to MuJoCo's defaults."""
    default_options(spec)
    default = mujoco.MjSpec().worldbody.add_geom()
    for geom in spec.geoms:
        geom.solref, geom.solimp, geom.margin = default.solref, default.solimp, default.margin


@dataclass
class Variant:
    """A way to simulate the robot."""

    name: str
    change: Change
    sensors: bool = False
    drawn: bool = False
    calibrate: bool = False  # scale wheel speeds to 5 mm a step: tyres may sag more or less

    def build(self) -> "Robot":
        """Compile the model."""
        spec = mujoco.MjSpec.from_file(str(standard_path()))
        spec.compiler.discardvisual = not self.drawn
        self.change(spec)
        robot = Robot(spec.compile())
        if self.sensors:
            robot.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        if self.calibrate:
            robot.scale = 0.1 / (robot.straight_way(21) - robot.straight_way(1))
        return robot


class Robot(Physics):
    """The robot, with wheel speeds that can be scaled."""

    scale = 1.0

    def run(self, speeds: list[tuple[float, float]]) -> None:
        """Drive from the start."""
        self.place(self.plan.start)
        for left, right in speeds:
            self.drive(left * self.scale, right * self.scale)

    def straight_way(self, steps: int) -> float:
        """Return how far the robot comes from rest in some straight steps [m]."""
        self.run([STRAIGHT] * steps)
        return self.pose()[0] - self.plan.start[0]


VARIANTS = [
    Variant("reference: 5 ms, default options", default_options, calibrate=True),
    Variant("... and default contacts", default_contacts, calibrate=True),
    Variant("ours", option()),
    Variant("ours, timestep 10 ms", option(timestep=0.01)),
    Variant("ours, timestep 25 ms", option(timestep=0.025)),
    Variant("ours, timestep 100 ms", option(timestep=0.1)),
    Variant(
        "ours, integrator implicitfast", option(integrator=mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    ),
    Variant("ours, pyramidal cone", option(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL), calibrate=True),
    Variant("ours, solver CG", option(solver=mujoco.mjtSolver.mjSOL_CG)),
    Variant("ours, islands and midphase on", option(disableflags=0)),
    Variant("ours, drawn geoms kept", option(), drawn=True),
    Variant("ours, sensors at every timestep", option(), sensors=True),
]


def optimal_run(plan_of: Physics) -> list[tuple[float, float]]:
    """Return wheel speeds of 516 collision-free steps: the optimal run, then turning."""
    best = optimal_steps(plan_of.plan)
    speeds = [(RIGHT, STRAIGHT, LEFT)[action] for action in best.actions for _ in range(10)]
    speeds = speeds[: best.steps]
    return speeds + [LEFT] * (516 - len(speeds))


def end_difference(robot: Robot, reference: Robot) -> tuple[float, float]:
    """Return the differences of two robots' poses in m and rad."""
    (x0, y0, heading0), (x1, y1, heading1) = robot.pose(), reference.pose()
    return math.hypot(x1 - x0, y1 - y0), abs(wrap_angle(heading1 - heading0))


def rough_drive(robot: Robot, steps: int = 3000) -> tuple[float, float]:
    """Return the longest step [m] and the deepest sinking into a wall [m] of a random drive."""
    rng = np.random.default_rng(0)
    noise = MotorNoise()
    robot.place(robot.plan.start)
    longest = deepest = 0.0
    for _ in range(steps // 10):
        left, right = (STRAIGHT, STRAIGHT, STRAIGHT, LEFT, RIGHT)[rng.integers(5)]
        for first, second in rng.random((10, 2)).tolist():
            before = robot.position()
            robot.drive(*noise.apply(left, right, first, second))
            longest = max(longest, math.dist(before, robot.position()))
            deepest = max(deepest, -robot.plan.clearance(*robot.position()))
            if not robot.plan.clearance(*robot.position()) > -0.02:
                robot.place(robot.plan.start)  # it went through a wall
    return longest, deepest


def microseconds_per_step(robot: Robot, speeds: list[tuple[float, float]]) -> float:
    """Return the time of one 0.5 s step."""
    begin = time.perf_counter()
    robot.run(speeds)
    return (time.perf_counter() - begin) / len(speeds) * 1e6


def stage_times(robot: Robot, repeats: int) -> dict[str, float]:
    """Return the microseconds that parts of one timestep take, called one by one from Python."""
    robot.run([STRAIGHT] * 5)
    stages = {
        "kinematics": mujoco.mj_kinematics,
        "centres of mass": mujoco.mj_comPos,
        "mass matrix": mujoco.mj_makeM,
        "collision": mujoco.mj_collision,
        "constraints": mujoco.mj_makeConstraint,
        "velocity": mujoco.mj_fwdVelocity,
        "actuation": mujoco.mj_fwdActuation,
        "acceleration": mujoco.mj_fwdAcceleration,
        "solver": mujoco.mj_fwdConstraint,
        "whole timestep": mujoco.mj_step,
    }
    times: dict[str, list[float]] = {name: [] for name in stages}
    for _ in range(repeats):
        for name, function in stages.items():
            begin = time.perf_counter()
            for _ in range(100):
                function(robot.model, robot.data)
            times[name].append((time.perf_counter() - begin) * 1e4)
    return {name: float(np.median(values)) for name, values in times.items()}


def main() -> None:
    """Measure, print tables, and write them as JSON."""
    options = arguments(__doc__, repeats=15)
    robots = {variant.name: variant.build() for variant in VARIANTS}
    reference = robots[VARIANTS[0].name]
    run = optimal_run(reference)
    pushing = [STRAIGHT] * 258 + [LEFT] * 4 + [STRAIGHT] * 254  # most of it against a wall

    times: dict[str, list[float]] = {name: [] for name in [*robots, "pushing"]}
    for _ in range(options.repeats):
        for name, robot in robots.items():
            times[name].append(microseconds_per_step(robot, run))
        times["pushing"].append(microseconds_per_step(robots["ours"], pushing))
    alone = {name: np.array(values) for name, values in times.items()}
    over = {name: ratio(values, alone[VARIANTS[0].name]) for name, values in alone.items()}

    rows = []
    for name, robot in robots.items():
        reference.run(run)
        robot.run(run)
        position, heading = end_difference(robot, reference)
        longest, deepest = rough_drive(robot)
        row = {"variant": name, "us/step": median(alone[name]), "ratio": over[name]}
        row |= {"end mm": position * 1e3, "end rad": heading}
        rows.append(row | {"longest step mm": longest * 1e3, "deepest mm": deepest * 1e3})
    stages = stage_times(robots["ours"], options.repeats)
    report(
        options,
        a_step_of_half_a_second=rows,
        pushing_against_a_wall=[{"us/step": median(alone["pushing"]), "ratio": over["pushing"]}],
        one_timestep_of_ours=[{"stage": name, "us": value} for name, value in stages.items()],
    )


if __name__ == "__main__":
    main()
