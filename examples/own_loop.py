"""Learn in a loop of one's own: a robot behind a socket, here a simulated one.

    python examples/own_loop.py

The robot sends a line of JSON with its reading after each command and expects the next command. It
is no Gymnasium environment, so the agent is told its axes, its actions and the scale of its reward,
and `start` and `step` stand in the loop.
"""

import json
import socket
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from sofnn_torch import Axis, QLearning

GOAL, LIMIT = 0.9, 200  # metres along a corridor of 1 m; steps of a trial
STEP = 0.05  # metres for a command
AXES = [Axis("place", "m", 0.0, 1.0)]
SPACES = SimpleNamespace(
    observation_space=Box(0.0, 1.0, (1,)),
    action_space=Discrete(2),  # back, forth
)


def robot(connection: socket.socket, seed: int = 0) -> None:
    """Drive by commands until the other side hangs up: 0 back, 1 forth, -1 to the start."""
    rng, place = np.random.default_rng(seed), 0.0
    with connection, connection.makefile("rw") as line:
        for command in line:
            move = {0: -STEP, 1: STEP}.get(int(command))
            place = 0.1 if move is None else place + move * rng.uniform(0.8, 1.2)
            place = min(max(place, 0.0), 1.0)
            line.write(json.dumps({"place": place}) + "\n")
            line.flush()


def drive(line: Any, agent: Any) -> int:
    """One trial of learning; its steps."""

    def ask(command: int) -> np.ndarray:
        line.write(f"{command}\n")
        line.flush()
        return np.array([json.loads(line.readline())["place"]])

    action, steps = agent.start(ask(-1)), 0
    while action is not None:
        seen, steps = ask(int(action)), steps + 1
        arrived = bool(seen[0] >= GOAL)
        action = agent.step(-1.0, seen, terminated=arrived, truncated=steps == LIMIT)
    return steps


def main(trials: int = 20) -> None:
    """Learn the shortest way to the goal, which takes about 16 steps."""
    # Each step costs 1: no state is worth more than 0, and unknown ones are worth a visit.
    agent = QLearning.for_env(SPACES, seed=0, axes=AXES, reward_scale=0.01, initial=0.0)
    here, there = socket.socketpair()  # a robot of your own: socket.create_connection(address)
    simulated = threading.Thread(target=robot, args=(there,))
    simulated.start()
    with here, here.makefile("rw") as line:
        steps = [drive(line, agent) for _ in range(trials)]
    simulated.join()
    print(f"{steps[0]} steps in the first trial, {steps[-1]} in the last")


if __name__ == "__main__":
    main()
