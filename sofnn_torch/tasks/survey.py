"""What a space does not say of a task, from random play: where inputs lie, what rewards are worth.

Both are needed before anything is learned: widths of rules are a share of an input's range, and
the learners' step sizes and temperature are for values of about 1.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gymnasium.spaces import Discrete

from sofnn_torch.network.axes import Axis
from sofnn_torch.tasks.env import Spaces, TaskEnv, look, make

STEPS = 2_000  # of random play
MARGIN = 0.25  # of the range that was seen, on either side: a learned policy gets further
DISCOUNT = 0.99


@functools.cache
def survey(env_id: str, seed: int) -> Spaces:
    """The spaces of an environment with all ends and the scale of its rewards.

    Known tasks have them already; others are played at random.

    Args:
        env_id: as in `gymnasium.make`.
        seed: of the play.

    Raises:
        ValueError: as `make`.
    """
    found = look(env_id)
    if found.reward_scale is not None:
        return found
    env = make(env_id)
    try:
        return explored(env, found, seed)
    finally:
        env.close()


def explored(env: TaskEnv, found: Spaces, seed: int) -> Spaces:
    """The spaces of an environment, with what `STEPS` steps of random play say of it."""
    states, rewards = play_at_random(env, seed)
    axes = tuple(map(within, found.axes, states.min(0).tolist(), states.max(0).tolist()))
    known = found.reward_scale is not None
    tuned = found.tuned if known else {"q": optimism(rewards)}
    return replace(found, axes=axes, reward_scale=scale(rewards), tuned=tuned)


def play_at_random(env: TaskEnv, seed: int) -> tuple[np.ndarray, list[list[float]]]:
    """States (T, n) and the rewards of each trial, with actions drawn uniformly."""
    rng = np.random.default_rng(seed)
    space = env.action_space
    states = [env.reset(seed=seed)[0]]
    trials: list[list[float]] = [[]]
    for _ in range(STEPS):
        chosen = (
            rng.integers(space.n)
            if isinstance(space, Discrete)
            else rng.uniform(-1, 1, space.shape)
        )
        state, reward, terminated, truncated, _ = env.step(chosen)
        trials[-1].append(reward)
        if terminated or truncated:
            states.append(state)
            state, _ = env.reset()
            trials.append([])
        states.append(state)
    return np.array(states, np.float64), trials


def within(axis: Axis, low: float, high: float) -> Axis:
    """The axis with its missing ends where the values seen, and a margin, end.

    Args:
        axis: as its space has it.
        low: the least value that was seen.
        high: the greatest.
    """
    margin = MARGIN * (high - low) or 0.5  # an input that never changed
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"{axis.name} was {low, high} in random play: give its ends by --axes")
    below = axis.low if math.isfinite(axis.low) else low - margin
    above = axis.high if math.isfinite(axis.high) else high + margin
    return replace(axis, low=below, high=max(above, below + margin))


def scale(trials: Sequence[Sequence[float]]) -> float:
    """Factor that makes the values of a task about 1, or 1 where they are less.

    Rewards are not enlarged: a goal that random play misses may be worth far more than they.

    A value is the larger of the discounted return of a trial, and of what rewards of the mean size
    are worth if they go on for ever.
    """
    returns = [0.0]
    for rewards in trials:
        value = 0.0
        for reward in reversed(rewards):
            value = reward + DISCOUNT * value
            returns.append(abs(value))
    sizes = [abs(reward) for rewards in trials for reward in rewards]
    value = max(*returns, float(np.mean(sizes)) / (1 - DISCOUNT))
    return float(f"{1 / value:.2g}") if 1 < value < math.inf else 1.0


def optimism(trials: Sequence[Sequence[float]]) -> dict[str, float]:
    """Settings of Q-learning: what an unknown state is worth, and the most that any may be.

    Where nearly every step costs something, 0 is optimistic. Where a policy may do nothing for
    nothing it is not, and is a trap. Random play may miss a goal worth far more than all it saw.
    """
    steps = np.array([reward for rewards in trials for reward in rewards])
    costly = np.quantile(steps, 0.95) < 0.5 * steps.mean() < 0.0
    return {"initial": 0.0 if costly else 1.0, "value_limit": 100.0}
