"""Other learners in the same maze: what it takes each of them, and ours, to learn it.

    python -m sofnn_torch.studies.peers                  # tile coding, SGA and Q: an hour or two
    pip install -e '.[peers]'                            # Stable-Baselines3
    python -m sofnn_torch.studies.peers --learners dqn ppo --tries 4
    python -m sofnn_torch.studies.peers --report-only    # the page from the data

The best settings of a learner that is not ours are searched first: some drawn by chance are tried
with one seed, the best quarter of them with two more. What the best reach with other seeds, which
the search has not seen, is the result. All play the same trials, of the default maze with its
estimated pose; time is that of the processor until a run has learned, physics included.
"""

import dataclasses
import functools
import json
import math
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

if __name__ == "__main__":  # Ctrl-C while libraries load
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from sofnn_torch import terminal
from sofnn_torch.bounds import Count, Settings
from sofnn_torch.maze.layouts import STANDARD
from sofnn_torch.maze.optimum import mean_optimum
from sofnn_torch.maze.robot import plan_of
from sofnn_torch.runs import parallel, places, seeding
from sofnn_torch.runs.factory import make_agent, make_env
from sofnn_torch.runs.session import arithmetic
from sofnn_torch.runs.settings import Config
from sofnn_torch.studies.collecting import IN_A_ROW, WITHIN, trials_to_learn
from sofnn_torch.studies.results import NEVER, cell, markdown, read_table, write_table
from sofnn_torch.studies.statistics import FAILS, HOLDS, OPEN, judge, median, ratio
from sofnn_torch.studies.tiles import TileCoder, TileConfig
from sofnn_torch.terminal import say

TITLES = {
    "sga": "SGA, SOFNN (ours)",
    "q": "Q-learning, SOFNN (ours)",
    "tiles": "Sarsa or Q(lambda), tile coding",
    "dqn": "DQN, Stable-Baselines3",
    "ppo": "PPO, Stable-Baselines3",
}
OURS = ("sga", "q")
COUNTS = ("seeds", "tries", "trials", "decisions", "max_steps")  # options of a measurement
FIRST = 1000  # seed of the first try of a search
PLAYED = 20  # greedy trials after learning
GOAL = 0.25  # steps to learn over those of tile coding
TILES: dict[str, tuple[Any, ...]] = {
    "tilings": (1, 2, 4, 8),
    "tiles": ((4, 4, 6), (6, 6, 8), (8, 8, 8), (10, 10, 12), (14, 14, 16)),
    "rate": (0.1, 0.2, 0.5, 0.8),
    "trace_decay": (0.5, 0.8, 0.9, 0.95),
    "initial": (0.5, 0.65, 0.8),
    "epsilon": (0.0, 0.01, 0.05),
    "watkins": (False, True),
}
DQN: dict[str, tuple[Any, ...]] = {
    "learning_rate": (1e-4, 5e-4, 1e-3),
    "batch_size": (64, 128),
    "learning_starts": (1_000,),
    "target_update_interval": (250, 1_000, 4_000),
    "train_freq": (1, 4),
    "gamma": (0.98, 0.99),
    "exploration_fraction": (0.1, 0.3),
    "exploration_final_eps": (0.02, 0.1),
}
PPO: dict[str, tuple[Any, ...]] = {
    "learning_rate": (1e-4, 3e-4, 1e-3),
    "n_steps": (256, 1_024, 2_048),
    "batch_size": (64,),
    "n_epochs": (4, 10),
    "gamma": (0.98, 0.99),
    "gae_lambda": (0.8, 0.95),
    "ent_coef": (0.0, 0.01, 0.05),
}
SPACES = {"tiles": TILES, "dqn": DQN, "ppo": PPO}


@dataclass(frozen=True)
class Options(Settings):
    """Let other learners, and ours, learn the maze."""

    learners: tuple[Literal["sga", "q", "tiles", "dqn", "ppo"], ...] = ("sga", "q", "tiles")
    """Learners to run; dqn and ppo need Stable-Baselines3."""
    seeds: str = "0-4"
    """Seeds of each learner."""
    tries: Count = 24
    """Settings that a search draws for a learner that is not ours."""
    trials: Count = 100
    """Trials of a run."""
    decisions: Count = 300_000
    """Decisions after which a run ends, at the end of its trial."""
    max_steps: Count = 20_000
    """Steps after which a trial ends."""
    out: Path = Path("docs/results")
    """Where data and page go; learners that are not asked for stay there."""
    report_only: bool = False
    """Run nothing: the page from the data that is there."""


@dataclass(frozen=True)
class Trial:
    """One trial of any learner, and the processor time when it was over."""

    steps: int
    decisions: int
    success: bool
    seconds: float


def play(env: Any, agent: Any, learn: bool = True) -> Trial:
    """One trial; a learner that does not learn takes its greedy actions."""
    observation, info = env.reset()
    action = agent.start(observation) if learn else agent.act(observation)
    decisions = 0
    while action is not None:
        observation, reward, terminated, truncated, info = env.step(action)
        decisions += 1
        if learn:
            action = agent.step(float(reward), observation, terminated, truncated)
        else:
            action = None if terminated or truncated else agent.act(observation)
    return Trial(info["total_steps"], decisions, info["success"], time.process_time())


def learn(
    learner: str, settings: dict[str, Any], seed: int, options: Options, enough: bool = False
) -> tuple[list[Trial], list[Trial], float]:
    """Trials of learning, greedy ones after it (none if enough), and the time at the beginning.

    Args:
        learner: its name.
        settings: of a learner that is not ours.
        seed: of everything.
        options: trials and decisions.
        enough: stop as soon as it has learned.
    """
    config = Config(agent="q" if learner == "q" else "sga", seed=seed)
    actions = config.maze.actions if learner in OURS else "three"
    maze = dataclasses.replace(config.maze, actions=actions, max_steps=options.max_steps)
    config = dataclasses.replace(config, maze=maze)
    env: Any = make_env(config)
    begin = time.process_time()
    trials: list[Trial] = []

    def over(trial: Trial) -> bool:
        trials.append(trial)
        taken = sum(t.decisions for t in trials)
        done = len(trials) == options.trials or taken >= options.decisions
        return done or (enough and not math.isnan(learned(trials)))

    agent: Any
    if learner in ("dqn", "ppo"):
        from sofnn_torch.studies.deep import train

        agent, env = train(learner, env, settings, seed, options.decisions, over)
    else:
        agent = make_agent(config)
        if learner == "tiles":
            agent = TileCoder(TileConfig(**settings), env.unwrapped.axes, 3, seed)
        env.reset(seed=seeding.stream("training", seed))
        while not over(play(env, agent)):
            pass
    env.reset(seed=FIRST + seed)
    greedy = [] if enough else [play(env, agent, learn=False) for _ in range(PLAYED)]
    env.close()
    return trials, greedy, begin


def learned(trials: list[Trial], layout: str = STANDARD) -> float:
    """The trial that completes the first ten good ones in a row in a maze, or NaN."""
    steps, success = zip(*((t.steps, t.success) for t in trials), strict=True)
    return trials_to_learn(steps, success, optimum(layout))


@functools.cache
def optimum(layout: str) -> float:
    """The fewest steps in a maze, with actions held as in training."""
    return mean_optimum(plan_of(layout))


def search(learner: str, options: Options) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The best settings of a learner, and all tries."""
    rng, space = np.random.default_rng(FIRST), SPACES[learner]
    drawn = [
        {name: values[rng.integers(len(values))] for name, values in space.items()}
        for _ in range(options.tries)
    ]
    tries: list[dict[str, Any]] = [{"settings": chosen, "scores": []} for chosen in drawn]
    for number in range(3):
        rows = tries if number == 0 else sorted(tries, key=_rank)[: max(1, len(tries) // 4)]
        for row in rows:
            trials, _, _ = learn(learner, row["settings"], FIRST + number, options, enough=True)
            row["scores"].append(score(trials))
            say(f"{learner} {row['settings']}: {row['scores'][-1]:,.0f}")
    return min(tries, key=_rank)["settings"], tries


def score(trials: list[Trial]) -> float:
    """Steps until learned; a run that has not learned is worse, by the steps of its last trials."""
    if not math.isnan(learned(trials)):
        return float(sum(t.steps for t in trials))
    return 1e7 + float(np.mean([t.steps for t in trials[-IN_A_ROW:]]))


def _rank(row: dict[str, Any]) -> tuple[int, float]:
    """Those that were tried more often come first, then those with the better mean."""
    return -len(row["scores"]), float(np.mean(row["scores"] or [math.inf]))


def measure(learner: str, settings: dict[str, Any], seed: int, options: Options) -> dict[str, Any]:
    """One row of the data: a learner with a seed."""
    trials, greedy, begin = learn(learner, settings, seed, options)
    after = learned(trials)
    until = len(trials) if math.isnan(after) else int(after)
    taken = trials[:until]
    row: dict[str, Any] = {"learner": learner, "seed": seed, "trials_to_learn": after}
    row |= {
        "steps_to_learn": sum(t.steps for t in taken),
        "decisions_to_learn": sum(t.decisions for t in taken),
        "seconds_to_learn": round(taken[-1].seconds - begin, 1),
    }
    if math.isnan(after):
        row |= {name: math.nan for name in row if name.endswith("_to_learn")}
    row |= {"trials": len(trials), "decisions": sum(t.decisions for t in trials)}
    row["greedy_success"] = float(np.mean([t.success for t in greedy]))
    row["greedy_steps"] = float(np.mean([t.steps for t in greedy]))
    return row


# ------------------------------------------------------------------------------------- page

HOW = f"""\
A run has learned when {IN_A_ROW} trials in a row, exploration included, stay under {WITHIN} times
the optimum; what it took until then, the number of seeds that got there, and {PLAYED} greedy trials
at the end, without any cure for loops. Medians with their 95 % intervals. Processor time includes
the physics, and is that of one core shared with other work."""


def page(rows: list[dict[str, Any]], info: dict[str, Any]) -> str:
    """The page of what was measured."""
    head = ["learner", "seeds", "learned", "trials", "steps of the environment", "decisions"]
    head += ["processor time [s]", "success, greedy", "steps, greedy"]
    table = []
    for learner in (name for name in TITLES if name in info):
        mine = [row for row in rows if row["learner"] == learner]
        columns = {name: np.array([float(row[name]) for row in mine]) for name in list(mine[0])[1:]}
        took = {name: np.where(np.isnan(v), NEVER, v) for name, v in columns.items()}
        line = [TITLES[learner], str(len(mine))]
        line.append(str(int((~np.isnan(columns["trials_to_learn"])).sum())))
        counted = ("trials", "steps", "decisions", "seconds")
        line += [cell(median(took[f"{name}_to_learn"])) for name in counted]
        line.append(f"{100 * columns['greedy_success'].mean():.0f} %")
        table.append([*line, cell(median(columns["greedy_steps"]))])
    parts = ["# Other learners in the same maze", HOW, markdown(head, table)]
    parts += _compared(rows) * ({"tiles", *OURS} <= info.keys())
    for learner, told in info.items():
        if learner not in OURS:
            parts += [f"## {TITLES[learner]}: the search", _searched(learner, told)]
    made = "; ".join(f"{TITLES[name]}: `{told['command']}`" for name, told in info.items())
    parts += ["## Provenance", f"{made}. A row for each run: [peers.csv](peers.csv)."]
    return "\n\n".join(parts) + "\n"


def _compared(rows: list[dict[str, Any]]) -> list[str]:
    """Ours over tile coding in steps of the environment, the real competitor."""

    def took(learner: str) -> Any:
        values = [float(row["steps_to_learn"]) for row in rows if row["learner"] == learner]
        return np.nan_to_num(values, nan=NEVER)

    found = {name: ratio(took(name), took("tiles")) for name in OURS}
    said = {HOLDS: "fewer", FAILS: "more", OPEN: "not clearly fewer or more"}
    texts = [
        f"{TITLES[name]}: {cell(measured, 2)}, {said[judge(measured, 0.0, 1.0)]}"
        f"{', the goal reached' * (judge(measured, 0.0, GOAL) == HOLDS)}"
        for name, measured in found.items()
    ]
    return [
        "Steps of the environment to learn over those of tile coding, ratios of medians (the goal "
        f"is {GOAL}): {'; '.join(texts)}. Each verdict is single. An end at 0 comes from draws of "
        "seeds in which tile coding never learned."
    ]


def _searched(learner: str, told: dict[str, Any]) -> str:
    space = "; ".join(f"{n} {', '.join(map(str, v))}" for n, v in SPACES[learner].items())
    often = sum(len(row["scores"]) for row in told["tries"])
    reached = sum(min(row["scores"]) < 1e7 for row in told["tries"])
    best = ", ".join(f"{name} {value}" for name, value in told["settings"].items())
    return (
        f"{len(told['tries'])} settings drawn by chance from: {space}. Runs: {often}. Settings "
        f"with which a run learned at all: {reached}. The best, by the mean steps to learn: {best}."
    )


def report(out: Path) -> None:
    """Write the page from the data.

    Raises:
        ValueError: there is no data.
    """
    if not (out / "peers.json").exists():
        raise ValueError(f"{out}: no data of peers; run some first")
    info = json.loads((out / "peers.json").read_text())
    (out / "peers.md").write_text(page(read_table(out / "peers.csv"), info))
    say(f"written: {out}/peers.md")


@arithmetic()
def run(options: Options) -> int:
    """What the command does; the exit code.

    Raises:
        ValueError: options that fit nothing.
    """
    table, notes = options.out / "peers.csv", options.out / "peers.json"
    if not options.report_only:
        seeds = parallel.parse(options.seeds)
        places.directory(options.out, "--out")
        for learner in options.learners:
            told: dict[str, Any] = {"command": command(learner, options), "settings": {}}
            if learner not in OURS:
                told["settings"], told["tries"] = search(learner, options)
            rows = [measure(learner, told["settings"], seed, options) for seed in seeds]
            info = json.loads(notes.read_text()) if notes.exists() else {}
            kept = read_table(table) if table.exists() else []
            write_table(table, [*(r for r in kept if r["learner"] != learner), *rows])
            notes.write_text(json.dumps(info | {learner: told}, indent=1) + "\n")
    report(options.out)
    return 0


def command(learner: str, options: Options) -> str:
    """The command that measures a learner."""
    given, usual = vars(options), vars(Options())
    changed = [name for name in COUNTS if given[name] != usual[name]]
    flags = [f"--{name.replace('_', '-')} {given[name]}" for name in changed]
    return " ".join([f"python -m sofnn_torch.studies.peers --learners {learner}", *flags])


def main() -> None:
    """Entry point of ``python -m sofnn_torch.studies.peers``."""
    terminal.command(run, Options, __doc__)


if __name__ == "__main__":
    main()
