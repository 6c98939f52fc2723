"""The trial loop: play, learn, record, save; stop on a signal or when numbers diverge.

A trial is the unit of everything: it is recorded and saved when it is over, and one that is cut
short (a signal, a crash) is played again from its beginning on resume, from the same random
numbers. So nothing that is learned or logged depends on when a run was interrupted.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium

from sofnn_torch.learners.frozen import FrozenPolicy
from sofnn_torch.learners.learner import Action, Learner
from sofnn_torch.pictures.tensorboard import Monitor
from sofnn_torch.progress import Progress
from sofnn_torch.runs import checkpoint, session
from sofnn_torch.runs.guard import Divergence, Watch
from sofnn_torch.runs.session import RunOptions, Session, arithmetic
from sofnn_torch.runs.settings import Config, from_dict
from sofnn_torch.runs.signals import Interrupted, SignalTrap
from sofnn_torch.runs.trial import Recorder, Trajectory, TrialRecord
from sofnn_torch.streams import output
from sofnn_torch.terminal import plural, say

After = Callable[[TrialRecord], bool]

__all__ = ["RunOptions", "play", "play_again", "resume", "train"]


def play(
    env: gymnasium.Env[Any, Any],
    agent: Learner,
    learn: bool = True,
    explore: bool = True,
    trap: SignalTrap | None = None,
    plain: bool = False,
    seen: Callable[[int], None] | None = None,
) -> tuple[TrialRecord, Trajectory]:
    """One trial from the start to the goal or the trial's limit.

    Args:
        env: as `make_env` makes it, or a wrapper around it.
        agent: the learner.
        learn: learn and grow; otherwise the agent is left as it is.
        explore: choose actions as in training (always so if learn).
        trap: where signals are noted.
        plain: a frozen policy does without its cure for loops.
        seen: called with the steps so far after each decision.

    Returns:
        The record of the trial (its number is 0) and the poses from the start on.

    Raises:
        Interrupted: a signal came; the agent is in the middle of a trial then.
        Divergence: the agent, the observation or the physics diverged.
    """
    frozen = None if learn else FrozenPolicy(agent, explore, plain)
    policy = frozen or agent
    observation, info = env.reset()
    recorder = Recorder(env, observation, info)
    with Watch(agent, env, observation) as watch:
        action: Action | None = policy.start(observation)
        while action is not None:
            if trap and trap.number:
                raise Interrupted(trap.number)
            observation, gain, terminated, truncated, info = env.step(action)
            reward = float(gain)
            watch.observation = observation
            action = policy.step(reward, observation, terminated, truncated)
            recorder.add(reward, observation, info)
            watch.check(reward)
            if seen:
                seen(info["total_steps"])
    if frozen:
        return recorder.finish(agent, {}, frozen.freed)
    return recorder.finish(agent, agent.statistics())


def train(config: Config, options: RunOptions | None = None, after: After | None = None) -> Path:
    """Train from the beginning; the directory of the run.

    Args:
        config: the settings.
        options: how the run is kept and shown.
        after: called with the record of each trial; a true answer ends the run, which is saved.

    Raises:
        ValueError: settings or run directory cannot be used; nothing was written then.
        Interrupted: after saving, on a signal that asks to stop.
        Divergence: after saving, when numbers diverge.
        OSError: the disk refused the last checkpoint; the message says where it is instead.
    """
    options = options or RunOptions()
    with SignalTrap() as trap, output(), arithmetic(options.threads, options.portable):
        return _loop(session.begin(config, options), options, trap, after)


def resume(
    path: Path | str,
    options: RunOptions | None = None,
    trials: int | None = None,
    after: After | None = None,
) -> Path:
    """Go on with a run, bit for bit as if it had never stopped; its directory.

    Args:
        path: a run directory, or one checkpoint file to go back to. A file outside a run
            directory goes on in a new one.
        options: how the run is kept and shown.
        trials: new total of trials; None for the one of the run.
        after: as for `train`.

    Raises:
        CheckpointError: no checkpoint fits; the message names the last good one, if any.
        ValueError, Interrupted, Divergence, OSError: as `train`.
    """
    options = options or RunOptions()
    with SignalTrap() as trap, output(), arithmetic(options.threads, options.portable):
        reopened = session.reopen(Path(path), options, trials)
        if reopened.trial == reopened.run.config.trials:
            reopened.close()
            say(f"{path} has all its {reopened.trial} trials: go further with --trials N")
            return reopened.run.path
        return _loop(reopened, options, trap, after)


@arithmetic()
def play_again(path: Path | str) -> None:
    """Play the trial again that follows a saved state, e.g. that of a divergence.

    Raises:
        CheckpointError: the file cannot be used.
        Divergence: the trial diverges (again).
    """
    path = Path(path)
    state = checkpoint.load(path)
    agent, env = session.build(from_dict(state["config"]))
    checkpoint.restore(path, state, agent, env)
    record, _ = play(env, agent)
    learned = f"{record.steps} steps, {plural(record.rules, 'rule')}"
    say(f"trial {state['trial'] + 1}: {learned}, no divergence")


def _loop(
    session: Session, options: RunOptions, trap: SignalTrap, after: After | None = None
) -> Path:
    """Trials until all are done; whatever ends the loop, the last whole trial is saved."""
    run, agent = session.run, session.agent
    monitor = Monitor(
        run.path, run.config, session.trial + 1, options.picture_every, options.video_every
    )
    progress = Progress(run.path.name, run.config.trials, session.trial, options.quiet)

    def seen(steps: int) -> None:
        progress.within(f"trial {session.trial + 1}: {steps:,} steps")

    try:
        while session.trial < run.config.trials:
            begin = time.perf_counter()
            record, path = play(session.env, agent, trap=trap, seen=seen)
            seconds = time.perf_counter() - begin
            speed = record.steps / seconds
            record = dataclasses.replace(
                record,
                trial=session.trial + 1,
                total_steps=session.state["total_steps"] + record.steps,
            )
            is_best = session.advance(record)
            run.record(record.row())
            monitor.trial(record, path, agent, speed)
            if is_best:
                run.save_as("best.pt", session.state)
            last = session.trial == run.config.trials
            if last or session.trial % options.checkpoint_every == 0 or run.saved is None:
                monitor.flush()  # the curves must not be behind the checkpoint
                session.save()
            if agent.net.refused:
                rules = plural(agent.net.max_rules, "rule")
                run.warn("cap", f"{rules} reached (--net.max-rules): no more are added")
            progress.update(seconds=seconds, facts=summary(record, session.state["recent"], speed))
            if after and after(record):
                break
    except Interrupted as stop:
        stop.run = run.path
        raise
    except Divergence as error:
        number = session.trial + 1
        name = f"divergence-{number}.pt"
        run.save_as(name, session.state | {"reason": str(error)})
        raise Divergence(
            f"trial {number} diverged: {error}; the state before it is in {run.path / name} "
            "(--again plays the trial again)"
        ) from error
    except ValueError as error:  # not of the user: settings were checked before the first trial
        raise RuntimeError(f"trial {session.trial + 1} failed: {error}") from error
    finally:
        progress.close()
        monitor.close()
        session.close()
    return run.path


def summary(record: TrialRecord, recent: Sequence[Any], speed: float) -> list[str]:
    """What the progress shows of a trial, the most important first.

    Args:
        record: the trial.
        recent: outcome and steps of the last trials.
        speed: steps in a second.
    """
    outcome = f"{record.steps} steps" if record.success else "no goal"
    outcomes = [outcome for outcome, _ in recent]
    share = f"goal in {sum(outcomes)} of {len(outcomes)}"
    if record.success is None:
        outcome = f"return {record.reward:,.4g}"
        share = f"{sum(outcomes) / len(outcomes):,.4g} in the last {len(outcomes)}"
    return [f"{speed:,.0f} steps/s", share, outcome, plural(record.rules, "rule")]
