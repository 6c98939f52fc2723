"""The trial loop: play, learn, record, save; stop on a signal or when numbers diverge.

A trial is the unit of everything: it is recorded and saved when it is over, and one that is cut
short (a signal, a crash) is played again from its beginning on resume, from the same random
numbers. So nothing that is learned or logged depends on when a run was interrupted.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from sofnn_torch import checkpoint
from sofnn_torch.checkpoint import CheckpointError
from sofnn_torch.config import Agent, Config, from_dict, make_agent, make_env
from sofnn_torch.guard import Divergence, Interrupted, SignalTrap, diagnose, physics_warnings
from sofnn_torch.monitoring import Monitor, Trajectory, TrialRecord
from sofnn_torch.runs import Run, load_config, same_settings, say

WINDOW = 10  # trials that decide which checkpoint is the best


@dataclass(frozen=True)
class RunOptions:
    """How a run is kept and shown; nothing here changes what is learned."""

    runs: Path = Path("runs")
    """Directory of all runs."""
    name: str | None = None
    """Name of the run's directory; by default made from agent, network, pose and seed."""
    checkpoint_every: int = 5
    """Trials from one checkpoint to the next."""
    keep: int = 3
    """Checkpoints that are kept, beside the best one."""
    picture_every: int = 25
    """Trials from one set of TensorBoard pictures to the next; 0 for none."""
    video_every: int = 50
    """Trials from one TensorBoard video to the next; 0 for none."""
    threads: int = 1
    """Threads of torch; one is fastest at this size."""
    quiet: bool = False
    """No progress bar."""

    def __post_init__(self) -> None:
        """Check the numbers; ValueError names the flag."""
        for name, least in LEAST.items():
            if getattr(self, name) < least:
                flag = f"--{name}".replace("_", "-")
                raise ValueError(f"{flag} must be at least {least}, got {getattr(self, name)}")
        if self.name is not None and (
            not self.name.strip(". ") or Path(self.name).name != self.name
        ):
            raise ValueError(f"--name must be a plain directory name, got {self.name!r}")


LEAST = {"checkpoint_every": 1, "keep": 1, "picture_every": 0, "video_every": 0, "threads": 1}


def play(
    env, agent: Agent, learn: bool = True, explore: bool = True, trap: SignalTrap | None = None
) -> tuple[TrialRecord, Trajectory]:
    """One trial from the start to the goal or the trial's limit.

    Args:
        env: the maze.
        agent: the learner.
        learn: learn and grow; otherwise the agent is left as it is.
        explore: choose actions as in training (always so if learn).
        trap: where signals are noted.

    Returns:
        The record of the trial (its number is 0) and the poses from the start on.

    Raises:
        Interrupted: a signal came; the agent is in the middle of a trial then.
        Divergence: the agent, the observation or the physics diverged.
    """
    trap = trap or SignalTrap()
    observation, info = env.reset()
    true, estimated = [info["true_pose"]], [info["estimated_pose"]]
    total = collisions = decisions = 0
    over = False
    try:
        action = agent.start(observation) if learn else agent.act(observation, explore)
        while not over:
            if trap.number:
                raise Interrupted(trap.number)
            observation, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            if learn:
                action = agent.step(reward, observation, terminated)
            elif not over:
                action = agent.act(observation, explore)
            total += reward
            decisions += 1
            collisions += info["collision"]
            true.append(info["true_pose"])
            estimated.append(info["estimated_pose"])
            # One sum stands for all: it is not finite if any of its terms is not.
            if not math.isfinite(sum(observation.tolist(), reward + agent.value)):
                raise Divergence(diagnose(agent, observation) or "a value estimate is not finite")
    except (ArithmeticError, RuntimeError, ValueError, StopIteration) as error:
        # Code that meets a NaN fails in its own ways; what matters is where the NaN is.
        if not isinstance(error, Divergence) and (what := diagnose(agent, observation)):
            raise Divergence(what) from error
        raise
    if what := physics_warnings(env) or (diagnose(agent, observation) if learn else ""):
        raise Divergence(what)
    path = Trajectory(np.array(true), np.array(estimated))
    difference = path.true - path.estimated
    distance = np.hypot(difference[:, 0], difference[:, 1])
    turn = np.abs((difference[:, 2] + math.pi) % (2 * math.pi) - math.pi)
    record = TrialRecord(
        trial=0,
        steps=info["total_steps"],
        decisions=decisions,
        total_steps=info["total_steps"],
        reward=float(total),
        success=bool(info["success"]),
        collisions=int(collisions),
        subgoals=sum(map(bool, info["subgoals"])),
        rules=agent.net.n_rules,
        pose_error=float(distance[1:].mean()),
        pose_error_max=float(distance[1:].max()),
        heading_error=float(turn[1:].mean()),
        statistics=agent.statistics() if learn else {},
    )
    return record, path


def train(config: Config, options: RunOptions | None = None) -> Path:
    """Train from the beginning; the directory of the run.

    Raises:
        ValueError: settings or run directory cannot be used; nothing was written then.
        Interrupted: after saving, on SIGINT or SIGTERM.
        Divergence: after saving, when numbers diverge.
        OSError: the disk refused the last checkpoint; the message says where it is instead.
    """
    options = options or RunOptions()
    with SignalTrap() as trap:
        agent, env = make_agent(config), make_env(config)
        env.reset(seed=environment_seed(config))
        state = _first_state(config, agent, env)
        run = Run.create(options.runs, options.name, config, options.keep)
        return _loop(run, state, agent, env, options, trap)


def resume(path: Path, options: RunOptions | None = None, trials: int | None = None) -> Path:
    """Go on with a run, bit for bit as if it had never stopped; its directory.

    Args:
        path: a run directory, or one checkpoint file to go back to. A file outside a run
            directory goes on in a new one.
        options: how the run is kept and shown.
        trials: new total of trials; None for the one of the run.

    Raises:
        CheckpointError: no checkpoint fits; the message names the last good one, if any.
        ValueError, Interrupted, Divergence, OSError: as `train`.
    """
    options = options or RunOptions()
    with SignalTrap() as trap:
        file = path if path.is_file() else None
        home = path.parent if file else path
        if file and not (home / "config.json").exists():
            run, state = None, checkpoint.load(file)
            config = from_dict(state["config"])
        else:
            config = load_config(home)
            run = Run.open(home, config, options.keep)
            file, state = _choose_state(home, file, config)
        try:
            if trials is not None:
                config = dataclasses.replace(config, trials=trials)
            agent, env = make_agent(config), make_env(config)
            env.reset(seed=environment_seed(config))
            if state is None:
                state = _first_state(config, agent, env)
            else:
                checkpoint.restore(file, state, agent, env)
            done = state["trial"]
            if done > config.trials:
                raise ValueError(f"{path} has {done} trials already: give --trials {done} or more")
            if done == config.trials:
                say(f"{path} has all its {done} trials: go further with --trials N")
                return home
            state["config"] = dataclasses.asdict(config)
            if run is None:
                run = Run.create(options.runs, options.name, config, options.keep)
            else:
                run.config, run.saved = config, done
                run.rewind(done)
        except BaseException:
            if run is not None:
                run.close()
            raise
        return _loop(run, state, agent, env, options, trap)


def saved_config(path: Path) -> Config:
    """The settings of a run directory or of a checkpoint file.

    Raises:
        ValueError: there are none, or this version does not know them.
    """
    home = path.parent if path.is_file() else path
    if path.is_file() and not (home / "config.json").exists():
        return from_dict(checkpoint.load(path)["config"])
    return load_config(home)


def replay(path: Path) -> None:
    """Play the trial again that follows a saved state, e.g. that of a divergence.

    Raises:
        CheckpointError: the file cannot be used.
        Divergence: the trial diverges (again).
    """
    state = checkpoint.load(path)
    config = from_dict(state["config"])
    agent, env = make_agent(config), make_env(config)
    env.reset(seed=environment_seed(config))
    checkpoint.restore(path, state, agent, env)
    record, _ = play(env, agent)
    say(f"trial {state['trial'] + 1}: {record.steps} steps, {record.rules} rules, no divergence")


def environment_seed(config: Config) -> int:
    """Seed of the environment, apart from the agent's: equal seeds would draw equal numbers."""
    return int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])


def _choose_state(
    home: Path, file: Path | None, config: Config
) -> tuple[Path | None, dict[str, Any] | None]:
    """The checkpoint to go on from; (None, None) if no trial was ever finished."""
    problems: list[str] = []
    if file:
        state = checkpoint.load(file)
    elif not checkpoint.checkpoints(home) and not (home / "trials.csv").exists():
        return None, None
    else:
        file, state, problems = checkpoint.find_latest(home)
    if problems:
        raise CheckpointError(f"{problems[0]}. To go on from the last good one: --resume {file}")
    same_settings(file, state, config)
    return file, state


def _first_state(config: Config, agent: Agent, env) -> dict[str, Any]:
    counters = {"trial": 0, "total_steps": 0, "recent": [], "best": []}
    return {"config": dataclasses.asdict(config)} | counters | checkpoint.snapshot(agent, env)


def _next_state(state: dict[str, Any], record: TrialRecord, agent: Agent, env) -> dict[str, Any]:
    recent = [*state["recent"], [record.success, record.steps]][-WINDOW:]
    best = state["best"]
    if len(recent) == WINDOW:  # more successes are better, then fewer steps
        best = max(best, [sum(s for s, _ in recent), -sum(n for _, n in recent)])
    counters = {"trial": record.trial, "total_steps": record.total_steps}
    return {
        **state,
        **counters,
        "recent": recent,
        "best": best,
        **checkpoint.snapshot(agent, env),
    }


def _loop(
    run: Run, state: dict[str, Any], agent: Agent, env, options: RunOptions, trap: SignalTrap
) -> Path:
    """Trials until all are done; whatever ends the loop, the last whole trial is saved."""
    torch.set_num_threads(options.threads)
    trials = run.config.trials
    monitor = Monitor(
        run.path, run.config, state["trial"] + 1, options.picture_every, options.video_every
    )
    progress = tqdm(
        total=trials,
        initial=state["trial"],
        disable=options.quiet,
        unit="trial",
        desc=run.path.name,
        dynamic_ncols=True,
        bar_format="{desc} {percentage:3.0f}%|{bar}| {n}/{total} [{elapsed}<{remaining}{postfix}]",
    )
    try:
        if state["trial"] == 0:
            run.save(state)
        while state["trial"] < trials:
            begin = time.perf_counter()
            record, path = play(env, agent, trap=trap)
            speed = record.steps / (time.perf_counter() - begin)
            trial = state["trial"] + 1
            total_steps = state["total_steps"] + record.steps
            record = dataclasses.replace(record, trial=trial, total_steps=total_steps)
            former, state = state, _next_state(state, record, agent, env)
            run.record(_row(record))
            monitor.trial(record, path, agent, speed)
            if state["best"] != former["best"]:
                run.save_as("best.pt", state)
            if trial % options.checkpoint_every == 0 or trial == trials or run.saved is None:
                monitor.flush()
                run.save(state)
            if agent.net.refused:
                rules = agent.net.max_rules
                run.warn("cap", f"{rules} rules reached (--net.max-rules): no more are added")
            progress.set_postfix_str(_summary(record, state, speed), refresh=False)
            progress.update()
    except Interrupted as stop:
        stop.run = run.path
        raise
    except Divergence as error:
        number = state["trial"] + 1
        name = f"divergence-{number}.pt"
        run.save_as(name, state | {"reason": str(error)})
        raise Divergence(
            f"trial {number} diverged: {error}; the state before it is in {run.path / name} "
            "(--replay plays the trial again)"
        ) from error
    finally:
        progress.close()
        monitor.close()
        try:
            _save_last(run, state)
        finally:
            run.close()
            env.close()
    return run.path


def _save_last(run: Run, state: dict[str, Any]) -> None:
    """Save the last whole trial if it is not saved yet, if need be outside the run directory."""
    if run.saved == state["trial"] or run.save(state):
        return
    place = run.rescue(state)
    raise OSError(
        f"{run.path} cannot be written; trial {state['trial']} is saved outside it: "
        f"go on with --resume {place}"
    )


def _row(record: TrialRecord) -> dict[str, Any]:
    """A line of trials.csv: the fields of the record, the statistics last."""
    row = dataclasses.asdict(record)
    return row | row.pop("statistics")


def _summary(record: TrialRecord, state: dict[str, Any], speed: float) -> str:
    outcome = f"{record.steps} steps" if record.success else "no goal"
    recent = [success for success, _ in state["recent"]]
    share = f"goal in {sum(recent)} of {len(recent)}"
    return f"{outcome}, {record.rules} rules, {share}, {speed:,.0f} steps/s"
