"""Stable-Baselines3's DQN and PPO on the tasks of tasks.py, with the settings that its zoo tuned.

    pip install -e '.[peers]'
    python benchmarks/zoo.py --out docs/results/zoo.json
    python benchmarks/zoo.py --table docs/results/zoo.json    # the table of docs/tasks.md

Settings and steps are those of https://github.com/DLR-RM/rl-baselines3-zoo (hyperparams/, 22e3ff2).
Each seed trains once for the zoo's steps; its return is the mean of 20 episodes of the
deterministic policy, after the steps that our learners have and at the end. Seconds are processor
time. Seeds that are in the file already are not repeated.
"""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tasks import EPISODES, STEPS

from sofnn_torch.studies.results import markdown
from sofnn_torch.studies.statistics import mean

WIDE = {"net_arch": [256, 256]}


def falling(first: float) -> Any:
    """A value that falls to 0 in a line over the training."""
    return lambda left: left * first


@dataclasses.dataclass(frozen=True)
class Tuned:
    """What the zoo has for a task: steps, settings, environments at once, normalised or not."""

    steps: int
    settings: dict[str, Any]
    envs: int = 1
    normal: bool = False


ZOO = {
    ("MountainCar-v0", "dqn"): Tuned(
        120_000,
        dict(
            learning_rate=4e-3,
            batch_size=128,
            buffer_size=10_000,
            learning_starts=1000,
            gamma=0.98,
            target_update_interval=600,
            train_freq=16,
            gradient_steps=8,
            exploration_fraction=0.2,
            exploration_final_eps=0.07,
            policy_kwargs=WIDE,
        ),
    ),
    ("CartPole-v1", "dqn"): Tuned(
        50_000,
        dict(
            learning_rate=2.3e-3,
            batch_size=64,
            buffer_size=100_000,
            learning_starts=1000,
            gamma=0.99,
            target_update_interval=10,
            train_freq=256,
            gradient_steps=128,
            exploration_fraction=0.16,
            exploration_final_eps=0.04,
            policy_kwargs=WIDE,
        ),
    ),
    ("Acrobot-v1", "dqn"): Tuned(
        100_000,
        dict(
            learning_rate=6.3e-4,
            batch_size=128,
            buffer_size=50_000,
            learning_starts=0,
            gamma=0.99,
            target_update_interval=250,
            train_freq=4,
            gradient_steps=-1,
            exploration_fraction=0.12,
            exploration_final_eps=0.1,
            policy_kwargs=WIDE,
        ),
    ),
    ("MountainCar-v0", "ppo"): Tuned(
        1_000_000,
        dict(n_steps=16, gae_lambda=0.98, gamma=0.99, n_epochs=4, ent_coef=0.0),
        envs=16,
        normal=True,
    ),
    ("CartPole-v1", "ppo"): Tuned(
        100_000,
        dict(
            n_steps=32,
            batch_size=256,
            gae_lambda=0.8,
            gamma=0.98,
            n_epochs=20,
            ent_coef=0.0,
            learning_rate=falling(0.001),
            clip_range=falling(0.2),
        ),
        envs=8,
    ),
    ("Acrobot-v1", "ppo"): Tuned(
        1_000_000,
        dict(n_steps=256, gae_lambda=0.94, gamma=0.99, n_epochs=4, ent_coef=0.0),
        envs=16,
        normal=True,
    ),
    ("MountainCarContinuous-v0", "ppo"): Tuned(
        20_000,
        dict(
            n_steps=8,
            batch_size=256,
            gae_lambda=0.9,
            gamma=0.9999,
            n_epochs=10,
            ent_coef=0.00429,
            learning_rate=7.77e-5,
            clip_range=0.1,
            max_grad_norm=5,
            vf_coef=0.19,
            use_sde=True,
            policy_kwargs={"log_std_init": -3.29, "ortho_init": False},
        ),
        normal=True,
    ),
    ("Pendulum-v1", "ppo"): Tuned(
        100_000,
        dict(
            n_steps=1024,
            gae_lambda=0.95,
            gamma=0.9,
            n_epochs=10,
            ent_coef=0.0,
            learning_rate=1e-3,
            clip_range=0.2,
            use_sde=True,
            sde_sample_freq=4,
        ),
        envs=4,
    ),
}


@dataclasses.dataclass
class Options:
    """Train the agents of others on tasks and play what they learned."""

    algorithm: tuple[str, ...] = ("dqn", "ppo")
    """Which agents."""
    env: tuple[str, ...] = tuple(STEPS)
    """Tasks; the zoo has no DQN for those with continuous actions."""
    seeds: int = 5
    """Seeds 0, 1, ... of each."""
    out: Path = Path("zoo.json")
    """Where the numbers go and are kept."""
    table: Path | None = None
    """Measure nothing: print the table of this JSON."""


def learned(algorithm: str, env: str, seed: int, steps: int | None = None) -> dict[str, Any]:
    """Train one agent; returns after our steps and at the end, and seconds."""
    import stable_baselines3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

    tuned = ZOO[env, algorithm]
    world, played = make_vec_env(env, tuned.envs, seed), make_vec_env(env, 1, seed + 10_000)
    if tuned.normal:
        world = VecNormalize(world, gamma=tuned.settings["gamma"])
        played = VecNormalize(played, training=False, norm_reward=False)
    kind = getattr(stable_baselines3, algorithm.upper())
    model = kind("MlpPolicy", world, seed=seed, device="cpu", **tuned.settings)
    spent = 0.0

    def value() -> float:
        nonlocal spent
        begin = time.process_time()
        if tuned.normal:
            sync_envs_normalization(world, played)
        returns, _ = evaluate_policy(
            model, played, EPISODES, warn=False, return_episode_rewards=True
        )
        spent += time.process_time() - begin
        return float(np.mean(returns))

    class Between(BaseCallback):
        found: float | None = None

        def _on_step(self) -> bool:
            if self.found is None and self.num_timesteps >= STEPS[env]:
                self.found = value()
            return True

    between, begin = Between(), time.process_time()
    model.learn(steps or tuned.steps, callback=between)
    seconds = time.process_time() - begin - spent
    row = {"seed": seed, "ours": between.found, "return": value(), "seconds": round(seconds, 1)}
    world.close()
    played.close()
    return row


def table(cells: dict[str, list[dict[str, Any]]]) -> str:
    """What was measured, in Markdown."""
    head = ["Task", "Agent", "Seeds", "Return after our steps", "Return at its end", "Seconds"]
    lines = []
    for name, rows in cells.items():
        env, algorithm = name.split()
        ends = ((STEPS[env], "ours"), (ZOO[env, algorithm].steps, "return"))
        shown = [
            f"{_cell([row[key] for row in rows])} ({steps:,})"
            if all(row[key] is not None for row in rows)
            else ""
            for steps, key in ends
        ]
        seconds = f"{np.median([row['seconds'] for row in rows]):.0f}"
        lines.append([env, algorithm.upper(), str(len(rows)), *shown, seconds])
    return markdown(head, lines, 2)


def _cell(values: list[float]) -> str:
    found = mean(np.array(values))
    if np.isnan(found.low):
        return ", ".join(f"{value:.1f}" for value in values)
    return f"{found.value:.1f}, {found.low:.1f} to {found.high:.1f}"


def main() -> None:
    """Print a line for each seed, then the table."""
    options = tyro.cli(Options, description=__doc__)
    if options.table:
        print(table(json.loads(options.table.read_text())))
        return
    cells: dict[str, list[dict[str, Any]]] = {}
    if options.out.exists():
        cells = json.loads(options.out.read_text())
    for env in options.env:
        for algorithm in (name for name in options.algorithm if (env, name) in ZOO):
            rows = cells.setdefault(f"{env} {algorithm}", [])
            for seed in sorted(set(range(options.seeds)) - {row["seed"] for row in rows}):
                rows.append(learned(algorithm, env, seed))
                print(env, algorithm, rows[-1], flush=True)
                options.out.write_text(json.dumps(cells, indent=1) + "\n")
    print(table(cells))


if __name__ == "__main__":
    main()
