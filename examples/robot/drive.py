"""Drive a robot by an exported policy over a plain line of text, without torch.

    python -m sofnn_torch.export RUN --to policy.json
    python examples/robot/simulated.py --port 4000 &
    python examples/robot/drive.py policy.json 127.0.0.1:4000

In place of host and port a serial device will do, set up by ``stty``: the robot has to speak the
lines of simulated.py. Where it is the driver works out from encoders, infrared and marks on the
floor, as the learner did. No hardware was at hand: this has been tried on the simulated robot only.
"""

import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sofnn_torch.export.runtime import Policy, read
from sofnn_torch.maze.odometry import DeadReckoning
from sofnn_torch.maze.sensors import felt_walls

PATIENCE = 2.0  # s for an answer

Ask = Callable[[str], str]


class Driver:
    """The closed loop: an answer of the robot in, speeds of the wheels out.

    Args:
        policy: as exported, of the maze.
        ask: sends a line and returns the robot's answer, empty if none came.
    """

    def __init__(self, policy: Policy, ask: Ask):
        self.policy, self.ask = policy, ask
        base = policy.robot["wheel_base"]
        self.place = DeadReckoning(wheel_base=base, right_angles=True)  # walls along x or y
        self.counted = (0.0, 0.0)

    def trial(self, limit: int = 4000) -> int | None:
        """Drive from the start to the goal; steps of 0.5 s, or None if it did not arrive."""
        self.place.fix(self.policy.robot["start"])
        self.counted, at_goal = (0.0, 0.0), False
        self._understand(self.ask("start"), 0.0)
        action: Any = self.policy.start(self.place.pose)
        hold, steps = self.policy.robot["hold"], 0
        while steps < limit:
            left, right = self.policy.command(action)
            line, touching = f"{left:.5f} {right:.5f}", False
            for _ in range(hold):
                at_goal, touching = self._understand(self.ask(line), left + right)
                steps += 1
                if touching or at_goal:
                    break
            if at_goal:
                return steps
            action = self.policy.step(self.place.pose)
        return None

    def _understand(self, answer: str, forward: float) -> tuple[bool, bool]:
        """Take in a reading; whether the robot is at the goal, and whether it drives at a wall.

        Encoders count on while lines are lost: the next one makes up for them.
        """
        words = answer.split()
        if not words:
            return False, False
        left, right, *ranges = map(float, words[:10])
        rolled = left - self.counted[0], right - self.counted[1]
        walls = felt_walls(ranges, forward) if forward else []
        self.place.update(*rolled, walls)
        self.counted = left, right
        mark = words[10:]
        if len(mark) == 3:
            x, y, heading = map(float, mark)
            self.place.fix((x, y, heading))
        return mark == ["goal"], bool(walls)


def over(connection: socket.socket) -> Ask:
    """Lines over a socket."""
    connection.settimeout(PATIENCE)
    lines = connection.makefile("r")

    def ask(line: str) -> str:
        connection.sendall(f"{line}\n".encode())
        try:
            return lines.readline()
        except TimeoutError:
            return ""

    return ask


def along(device: Path) -> Ask:
    """Lines over a serial device; ``stty -F DEVICE 38400 raw -echo min 0 time 20`` sets it up."""
    port = open(device, "r+b", buffering=0)  # noqa: SIM115 - open as long as the robot drives

    def ask(line: str) -> str:
        port.write(f"{line}\n".encode())
        return port.readline().decode(errors="replace")

    return ask


def main() -> None:
    """Drive one trial."""
    if len(sys.argv) != 3:
        sys.exit(f"usage: python {Path(sys.argv[0]).name} policy.json HOST:PORT|DEVICE")
    try:
        policy, where = read(sys.argv[1], seed=0), sys.argv[2]
        if not policy.robot:
            raise ValueError(f"{sys.argv[1]} is of no robot in a maze")
        host, _, port = where.rpartition(":")
        ask = over(socket.create_connection((host, int(port)))) if host else along(Path(where))
        steps = Driver(policy, ask).trial()
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    print("did not arrive" if steps is None else f"arrived after {steps} steps, {steps / 2:.0f} s")


if __name__ == "__main__":
    main()
