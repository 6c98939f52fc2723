"""A simulated Khepera behind a socket, which stands for a real one on a serial line.

    python examples/robot/simulated.py --port 4000 --late 0.1 --lost 0.05

It knows two lines. ``start`` puts it back to the start; ``left right`` sets the speeds of the
wheels [m/s]. After each it drives for 0.5 s and then answers with one line:

    left right  ir ir ir ir ir ir ir ir  [goal | x y heading]

what the encoders of the wheels have counted since the start [m], eight infrared ranges [m, off by
at most 10 %], and which mark it is on: the goal, or one on which it has just come and that says
where it is. An empty line stands for an answer that did not come in time.
"""

import argparse
import math
import socket
from dataclasses import dataclass

import numpy as np

from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.maze.odometry import STEP_SECONDS, MotorNoise
from sofnn_torch.maze.robot import Physics
from sofnn_torch.maze.sensors import INFRARED, readings

Speeds = tuple[float, float]


@dataclass(frozen=True)
class Faults:
    """What goes wrong on the way to the robot, and in it.

    Attributes:
        late: seconds that a line takes, there and back, each at most half a step.
        lost: chance of each line, there and back, to be lost.
        radius: wheels over those that the driver believes.
        base: distance of the wheels over the one that the driver believes.
        left: speed of the left wheel over what it is told.
    """

    late: float = 0.0
    lost: float = 0.0
    radius: float = 1.0
    base: float = 1.0
    left: float = 1.0


class SimulatedRobot:
    """A robot in a maze that obeys and answers lines, with faults.

    Args:
        faults: what goes wrong.
        seed: of the motor noise and of the lines that are lost.
        layout: the maze.
    """

    def __init__(self, faults: Faults | None = None, seed: int = 0, layout: str = STANDARD):
        self.faults, self.rng = faults or Faults(), np.random.default_rng(seed)
        self.physics, self.noise = Physics(layout), MotorNoise()
        self.timestep = self.physics.model.opt.timestep
        plan = self.physics.plan
        self.goals = [(centre, plan.goal_radius) for centre in plan.goals]
        self.marks = [(centre, plan.subgoal_radius) for centre in plan.subgoals]
        self.steps, self.marked = 0, False
        self.speeds: Speeds = (0.0, 0.0)

    def answer(self, line: str) -> str:
        """Obey a line for 0.5 s; what the robot says of it."""
        reset = line.strip() == "start"
        if reset:
            self.physics.place(self.physics.plan.start)
            self.steps, self.marked = 0, False
            self.speeds = told = (0.0, 0.0)
        elif self._arrives():
            left, right = map(float, line.split())
            told = (left, right)
        else:
            told = self.speeds
        late = self.faults.late
        self._drive(self.speeds, late)
        noisy = self.noise.apply(*told, *self.rng.random(2))
        self._drive(noisy, STEP_SECONDS - 2 * late)
        said = self._reading()
        self._drive(noisy, late)
        self.speeds, self.steps = told, self.steps + (not reset)
        return said if reset or self._arrives() else ""

    def _arrives(self) -> bool:
        return bool(self.rng.random() >= self.faults.lost)

    def _drive(self, speeds: Speeds, seconds: float) -> None:
        """Drive for some of the simulator's steps, with wheels that are not as believed.

        Seen from its wheels and encoders, a robot with a wider base is one that turns less.
        """
        faults = self.faults
        left, right = speeds[0] * faults.left * faults.radius, speeds[1] * faults.radius
        middle, turn = (left + right) / 2, (right - left) / 2 / faults.base
        self.physics.substeps = round(seconds / self.timestep)
        if self.physics.substeps:
            self.physics.drive(middle - turn, middle + turn)

    def _reading(self) -> str:
        left, right = self.physics.wheel_travel()
        middle, turn = (left + right) / 2, (right - left) / 2 * self.faults.base
        counted = ((middle + side * turn) / self.faults.radius for side in (-1, 1))
        draws = self.rng.random(len(INFRARED)).tolist()
        numbers = [*counted, *readings(self.physics.infrared_ranges(), 0.1, draws)]
        before, self.marked = self.marked, self._on(self.marks)
        word = "goal" if self._on(self.goals) else ""
        if self.marked and not before:
            word = " ".join(f"{part:.4f}" for part in self.physics.pose())
        return " ".join(f"{number:.5f}" for number in numbers) + f" {word}"

    def _on(self, marks: list[tuple[tuple[float, ...], float]]) -> bool:
        here = self.physics.position()
        return any(math.dist(here, centre) <= radius for centre, radius in marks)


def serve(connection: socket.socket, robot: SimulatedRobot) -> None:
    """Answer lines until the other side hangs up."""
    with connection, connection.makefile("r") as lines:
        for line in lines:
            connection.sendall((robot.answer(line) + "\n").encode())


def main() -> None:
    """Wait for one driver after another."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--port", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    for name, default in vars(Faults()).items():
        parser.add_argument(f"--{name}", type=float, default=default)
    given = vars(parser.parse_args())
    port, seed = given.pop("port"), given.pop("seed")
    with socket.create_server(("127.0.0.1", port)) as server:
        print(f"waiting on port {port}", flush=True)
        while True:
            serve(server.accept()[0], SimulatedRobot(Faults(**given), seed))


if __name__ == "__main__":
    main()
