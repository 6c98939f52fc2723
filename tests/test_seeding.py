"""Random numbers: each thing that is left to chance has a stream of its own."""

import numpy as np
import pytest

from sofnn_torch import evaluate
from sofnn_torch.rules import __main__ as rules
from sofnn_torch.rules import played
from sofnn_torch.runs import seeding
from sofnn_torch.runs.factory import make_agent
from sofnn_torch.runs.session import build
from sofnn_torch.studies import robustness

SEED = 2007  # of the trials in other conditions, for the run's seed 7


def numbers(seed, after=0):
    return tuple(np.random.default_rng(seed).random(after + 3)[after:])


def test_no_two_streams_of_a_seed_are_equal_and_none_is_that_of_the_plain_seed():
    seeds = [SEED, *(seeding.stream(name, SEED) for name in seeding.NUMBERS)]
    assert len({numbers(seed) for seed in seeds}) == len(seeding.NUMBERS) + 1


def test_training_draws_the_numbers_that_it_always_drew(quick):
    agent, env = build(quick(seed=7))
    maze = np.random.SeedSequence([7, 1]).generate_state(1)[0]
    assert tuple(env.np_random.random(3)) == numbers(maze)
    assert tuple(agent.rng.random(3)) == numbers(7)


class Seen(Exception):
    """Carries the first random numbers of the maze, the policy and the start."""


@pytest.mark.parametrize("player", ["evaluate", "rules", "robustness"])
def test_trials_without_learning_have_three_streams_of_their_own(player, quick, monkeypatch):
    def look(env, agent, **_):
        places = [env.unwrapped.np_random, agent.rng]
        places += [env.rng] if player == "robustness" else []
        raise Seen(*(tuple(place.random(3)) for place in places))

    config = quick(seed=7)
    monkeypatch.setattr(evaluate, "load", lambda path: (config, make_agent(config), path, {}))
    monkeypatch.setattr(robustness, "CONDITIONS", {"scatter": {1: {"start": 1.0}}})
    module, play = {
        "evaluate": (evaluate, lambda: evaluate.evaluate(config, make_agent(config), seed=SEED)),
        "rules": (played, lambda: rules.firing_along_a_trial(config, make_agent(config), SEED)),
        "robustness": (robustness, lambda: robustness.under_conditions("run")),
    }[player]
    monkeypatch.setattr(module, "play", look)
    with pytest.raises(Seen) as seen:
        play()
    drawn = {"maze": 0, "policy": 0, "start": 3}  # by the reset that seeds the maze
    expected = tuple(numbers(seeding.stream(name, SEED), after) for name, after in drawn.items())
    assert seen.value.args == expected[: len(seen.value.args)]
