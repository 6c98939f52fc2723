"""Questions to a learner about many states at once: what would it do, what is it worth there.

Nothing is learned, no rule is added and no random number is drawn.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from sofnn_torch.learners.qlearning import QLearning

if TYPE_CHECKING:
    from sofnn_torch.runs.factory import Agent

CHUNK = 512  # states at a time: memory stays near CHUNK x rules numbers


@dataclass(frozen=True)
class Survey:
    """What a learner would do at B states, without exploration.

    Attributes:
        forward: speed forward over the fastest. Shape: (B,).
        turn: turning over the fastest, positive to the left. Shape: (B,).
        value: V or max Q; None if the learner keeps no value. Shape: (B,).
    """

    forward: NDArray[np.float64]
    turn: NDArray[np.float64]
    value: NDArray[np.float64] | None


@torch.no_grad()
def survey(agent: "Agent", states: NDArray[Any]) -> Survey:
    """The mean action (SGA) or the greedy one (Q-learning) at states of shape (B, 3)."""
    parts = [
        _ask(agent, torch.as_tensor(part))
        for part in np.array_split(states, 1 + len(states) // CHUNK)
    ]
    forward, turn, value = (torch.cat(p).double().numpy() for p in zip(*parts, strict=True))
    return Survey(forward, turn, None if np.isnan(value).any() else value)


def _ask(agent: "Agent", states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x = states.to(agent.net.default_width)
    if isinstance(agent, QLearning):
        inputs = agent.inputs(x)
        firing = agent.net.normalised_firing(inputs.reshape(-1, inputs.shape[-1]))
        values = agent.action_values(x, firing.reshape(*inputs.shape[:-1], -1))
        value, best = values.max(1)
        action = x.new_tensor(agent.representatives)[best]
    else:
        outputs = agent.net(x)
        value = outputs[:, -1] if agent.learned else outputs.new_full((len(x),), math.nan)
        action = outputs[:, : agent.m].clamp(-1, 1)
        if agent.m == 2:  # left and right wheel; the fastest turn is 0.4 of the fastest wheel
            left, right = action.T
            return (left + right) / 2, ((right - left) / 0.8).clamp(-1, 1), value
        action = action[:, 0]
        if agent.config.actions == "three":
            action = (action > 1 / 3).to(action) - (action < -1 / 3).to(action)
    return 1 - action.abs(), action, value


def usage(agent: "Agent", states: NDArray[Any]) -> NDArray[np.float64]:
    """Mean normalised firing of each rule along a trial, from its states (T, 3). Shape: (K,)."""
    net = agent.net
    x = torch.as_tensor(states).to(net.default_width)
    if net.n_inputs > x.shape[1]:  # the action is an antecedent too: take the mean over actions
        x = torch.cat([torch.cat([x, code.expand(len(x), -1)], 1) for code in agent.codes])
    with torch.no_grad():
        total = sum(net.normalised_firing(part).sum(0) for part in x.split(CHUNK))
    return (total / len(x)).double().numpy()
