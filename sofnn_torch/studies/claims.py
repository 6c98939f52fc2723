"""What the paper claims and what was to be reached, judged on the data by stated criteria."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sofnn_torch.maze.robot import plan_of
from sofnn_torch.studies.drawing import AGENTS, NETWORKS, last_paths
from sofnn_torch.studies.results import Data, cell, censored, learned_after, success
from sofnn_torch.studies.statistics import (
    FAILS,
    HOLDS,
    OPEN,
    Measured,
    judge,
    median,
    proportion,
    ratio,
    verdicts,
)

PRINTED = {  # steps after learning, rules of SOFNN, rules of FSFNN (printed the other way round)
    "sga": (515.9, 912, 1152),
    "q": (528.9, 10024, 9216),
}
SWAPPED = """\
The paper's maze is lost: this one is ours, drawn after its text, so the steps are of two mazes.

\\* The paper prints 1152 for Q-learning and 9216 for SGA; we take them to be swapped
([errata](../paper.md#errata))."""
LAST = 10  # training trials at the end that say whether a seed arrives
SAME = (0.9, 1.1)  # ratios in between count as equal
RESET = 0.003  # m, largest error after a decision in which a position estimate was corrected

NOTHING = Measured(float("nan"))
REACHED = {HOLDS: "yes", FAILS: "no", OPEN: "cannot tell"}
HOW = """\
A claim *holds* if the whole interval of what we measured agrees with the criterion, it *does not
hold* if the whole interval contradicts it, and otherwise we *cannot tell*. The intervals shown are
of 95 % each; the verdicts are together right with 95 % confidence (Holm's method). A seed *arrives*
if at least 9 of its last 10 training trials end at the goal (what Figs 7 and 8 show); intervals of
shares are exact (Clopper and Pearson), those of ratios of medians a percentile bootstrap over
seeds."""
GOALS = """\
A goal is reached if the whole 95 % interval reaches it. Each verdict is single, not corrected for
their number."""


def arriving(data: Data, arm: str) -> tuple[int, int]:
    """How many seeds of an arm arrive, and how many there are; one that diverged does not."""
    limit = data.info["arms"][arm]["config"]["maze"]["max_steps"]
    done = {row["seed"] for row in data.rows if row["arm"] == arm and row["status"] == "done"}
    arrived = [
        np.mean(steps[-LAST:] < limit) >= 0.9
        for seed, steps in data.curves(arm, "steps").items()
        if seed in done
    ]
    return sum(arrived), len(data.column(arm, "trials"))


def resets(data: Data, arm: str) -> tuple[int, int, float]:
    """Paths with a reset at both sub-goals, all paths, median largest error [m]."""
    plan = plan_of(data.layout)
    twice, largest = 0, []
    paths = last_paths(data, arm)
    for path in paths.values():
        error = np.hypot(*(path.true - path.estimated)[:, :2].T)
        largest.append(error.max())
        twice += all(
            (error[1:][_distances(path.true, centre) < plan.subgoal_radius] < RESET).any()
            for centre in plan.subgoals
        )
    return twice, len(paths), float(np.median(largest)) if largest else 0.0


def _distances(poses: NDArray[Any], point: tuple[float, float]) -> NDArray[np.float64]:
    """Least distance of each stretch of a path to a point. Shape: (T - 1,)."""
    begin, way = poses[:-1, :2], np.diff(poses[:, :2], axis=0)
    length = np.maximum((way**2).sum(1), 1e-18)
    share = np.clip(((point - begin) * way).sum(1) / length, 0, 1)
    return np.hypot(*(begin + share[:, None] * way - point).T)


def claims(data: Data) -> list[tuple[str, str, str, str]]:
    """Rows: claim, criterion, what we measured, verdict."""
    rows = list(_claims(data))
    found = verdicts([(measured, *bounds) for _, _, _, measured, bounds in rows])
    return [(*row[:3], verdict) for row, verdict in zip(rows, found, strict=True)]


def _claims(data: Data) -> Iterator[tuple[str, str, str, Measured, tuple[float, float]]]:
    """Claim, criterion, what we measured in words and numbers, and where it must lie."""
    known = set(data.info["arms"])
    for number, (agent, title) in zip((7, 8), AGENTS.items(), strict=True):
        for network, text, share in (
            ("sofnn", "the proposed (SOFNN) could arrive at the goal", (0.5, 1)),
            ("fixed", "the conventional (FSFNN) could not arrive at the goal", (0, 0.5)),
        ):
            if (arm := f"{agent}-{network}-estimated") in known:
                arrived, seeds = arriving(data, arm)
                measured = proportion(arrived, seeds)
                interval = f"{100 * measured.low:.0f} to {100 * measured.high:.0f} %"
                yield (
                    f"Fig. {number}, {title}: {text}",
                    f"{'more' if share[1] == 1 else 'less'} than half of the seeds arrive",
                    data.remark(f"{arrived} of {seeds} seeds ({interval})", arm),
                    measured,
                    share,
                )
        arms = [f"{agent}-{network}-estimated" for network in ("sofnn", "fixed")]
        if known.issuperset(arms):
            measured = ratio(*(censored(data, arm) for arm in arms))
            yield (
                f"Fig. {number}, {title}: SOFNN learns in fewer trials than FSFNN (implied)",
                "ratio of median trials to learn below 1",
                data.remark(cell(measured, 2), *arms),
                NOTHING if measured.low == measured.high == 1 else measured,  # neither learns
                (0, 1 - 1e-9),
            )
    sofnn = {agent: f"{agent}-sofnn-estimated" for agent in AGENTS}
    if known.issuperset(sofnn.values()):
        measured = ratio(*(data.column(sofnn[agent], "rules") for agent in ("q", "sga")))
        yield (
            "Fig. 9: Q-learning grows many more rules than SGA (10024 and 912: 11 times)",
            "ratio of median rules above 2",
            data.remark(cell(measured, 2), *sofnn.values()),
            measured,
            (2, np.inf),
        )
    for agent, title in AGENTS.items():
        arms = [f"{agent}-sofnn-{pose}" for pose in ("estimated", "true")]
        if known.issuperset(arms):
            measured = ratio(*(data.column(arm, "sampled_steps") for arm in arms))
            yield (
                f"Fig. 10, {title}: the estimated pose does as well as the true one (implied)",
                "ratio of median steps, sampled, in 0.9 to 1.1",
                data.remark(cell(measured, 2), *arms),
                measured,
                SAME,
            )
    for agent, title in AGENTS.items():
        if sofnn[agent] in known:
            twice, paths, largest = resets(data, sofnn[agent])
            text = "no seed reached the goal in its last trial"
            if paths:
                text = f"{twice} of {paths} paths; largest error {1000 * largest:.0f} mm (median)"
            yield (
                f"Fig. 11, {title}: on the way to the goal the error is reset to 0 two times",
                "at both sub-goals, on more than half of the paths of the last trial",
                text,
                proportion(twice, paths),
                (0.5, 1),
            )
    if known.issuperset(sofnn.values()):
        measured = ratio(*(data.column(sofnn[agent], "sampled_steps") for agent in AGENTS))
        yield (
            "Text: both may have the same performance (515.9 and 528.9 steps: 0.98)",
            "ratio of median steps of SGA and Q, sampled, in 0.9 to 1.1",
            data.remark(cell(measured, 2), *sofnn.values()),
            measured,
            SAME,
        )


def closing_table(data: Data) -> Iterator[tuple[str, ...]]:
    """Rows: quantity, the paper's number, ours, ours over the optimum."""
    optimum = data.info["optimum"]
    for agent, title in AGENTS.items():
        steps, *rules = PRINTED[agent]
        if (arm := f"{agent}-sofnn-estimated") in data.info["arms"]:
            for policy in ("greedy", "sampled"):
                ours = median(data.column(arm, f"{policy}_steps"))
                text = f"{title} with SOFNN: mean steps of 10 trials, {policy}"
                here = data.remark(cell(ours, 1), arm)
                yield text, str(steps), here, cell(ours, 3, 1 / optimum)
        for network, count in zip(("sofnn", "fixed"), rules, strict=True):
            if (arm := f"{agent}-{network}-estimated") in data.info["arms"]:
                here = data.remark(cell(median(data.column(arm, "rules"))), arm)
                printed = f"{count:,}" + r" \*" * (network == "fixed")
                yield f"{title} with {NETWORKS[network]}: rules", printed, here, ""


def goals(data: Data) -> Iterator[tuple[str, str, str, str]]:
    """Rows: learner, what was to be reached, what was, whether it is."""
    for agent, title in AGENTS.items():
        arm = f"{agent}-sofnn-estimated"
        if arm not in data.info["arms"]:
            continue
        steps, learned = median(data.column(arm, "greedy_steps")), learned_after(data, arm)
        arrived = success(data, arm, "greedy")
        optimum, trials = data.info["optimum"], data.column(arm, "trials")[0]
        most, within = {"sga": (516, 50), "q": (529, 45)}[agent]
        plain = []
        if data.has("plain_steps"):
            alone = success(data, arm, "plain")
            text = "success of the plain policy, without a cure for loops, at least 99 %"
            plain = [(text, f"{cell(alone, 1, 100)} %", alone, 0.99, 1)]
        for text, said, measured, *bounds in (
            ("success at least 99 %", f"{cell(arrived, 1, 100)} %", arrived, 0.99, 1),
            (f"steps at most {most}", cell(steps, 1), steps, 0, most),
            (
                "steps within 1.10 of the optimum",
                cell(steps, 3, 1 / optimum),
                steps,
                0,
                1.1 * optimum,
            ),
            (
                f"trials to learn at most {within}",
                cell(learned, limit=trials),
                learned,
                0,
                min(within, trials),
            ),
            *plain,
        ):
            verdict = REACHED[judge(measured, *bounds)]
            yield title, text, data.remark(said, arm), verdict
