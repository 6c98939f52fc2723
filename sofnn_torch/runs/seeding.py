"""Random numbers: one stream for each thing that is left to chance, all from one seed.

Generators with equal seeds draw equal numbers, so that the noise of a motor would decide the action
of the policy too. Here a seed and the name of a stream make another seed, by NumPy's SeedSequence.
"""

from typing import Any

import numpy as np

from sofnn_torch.learners.learner import Learner

# Training's motor noise is not what a policy is then judged by, whatever the seeds. The learner in
# training draws from the plain seed.
NUMBERS = {"training": 1, "maze": 2, "policy": 3, "start": 4, "reduction": 5}


def stream(name: str, seed: int) -> int:
    """Seed of a stream.

    Args:
        name: ``training`` (motor noise while a robot learns), and in trials without learning
            ``maze`` (motor noise), ``policy`` (the policy's chance) or ``start`` (where it begins);
            ``reduction``, all chance while a rule base is made smaller.
        seed: seed of the run or of the evaluation.
    """
    return int(np.random.SeedSequence([seed, NUMBERS[name]]).generate_state(1)[0])


def begin(env: Any, agent: Learner, seed: int) -> None:
    """Let the chance of trials without learning begin from a seed: the maze's and the policy's.

    Args:
        env: the maze; it is reset.
        agent: the learner; only its random generator changes.
        seed: seed of the trials; equal ones give equal trials.
    """
    env.reset(seed=stream("maze", seed))
    agent.reseed(stream("policy", seed))
