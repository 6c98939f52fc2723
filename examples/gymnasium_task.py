"""Learn a task of Gymnasium in a few lines.

python examples/gymnasium_task.py
"""

import gymnasium

from sofnn_torch import SGA


def main(trials: int = 60) -> None:
    """Learn to balance a pole, and say how long it stands before and after."""
    env = gymnasium.make("CartPole-v1")
    agent = SGA.for_env(env, seed=0)
    first = agent.learn(env, trials=1, quiet=True)[0].reward
    agent.learn(env, trials=trials - 1)
    returns = [record.reward for record in agent.evaluate(env, trials=5)]
    print(f"return {first:.0f} in the first trial, {sum(returns) / len(returns):.0f} learned")


if __name__ == "__main__":
    main()
