"""An agent of Stable-Baselines3 in the maze.

pip install -e '.[peers]'
python examples/sb3_maze.py
"""

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy


def main(decisions: int = 50_000, trials: int = 5) -> None:
    """Learn for so many decisions, and say what the policy reaches before and after."""
    env = gymnasium.make("sofnn_torch:KheperaMaze-v0", pose="true", actions="three", max_steps=5000)
    model = PPO("MlpPolicy", env, n_steps=500, batch_size=100, gamma=0.999, seed=0, device="cpu")
    returns = []
    for chunk in (0, decisions):
        if chunk:
            model.learn(chunk)
        returns.append(evaluate_policy(model, model.get_env(), trials)[0])
    print(f"mean return {returns[0]:.0f} untrained, {returns[1]:.0f} after {decisions:,} decisions")


if __name__ == "__main__":
    main()
