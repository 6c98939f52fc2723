"""Every number on a page of results comes from the right rows: data by hand, one at a time."""

import dataclasses
import json
import math
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest

from sofnn_torch.pictures import figures
from sofnn_torch.runs.trial import Trajectory
from sofnn_torch.studies import (
    claims,
    collecting,
    drawing,
    report,
    results,
    robustness,
    running,
    statistics,
)
from sofnn_torch.studies.__main__ import Name
from sofnn_torch.studies.studies import STUDIES, settings

OPTIMUM, LIMIT = 468, 20_000
POSE_NAMES = ("x", "y", "heading", "x_estimated", "y_estimated", "heading_estimated")
USUAL = {
    "status": "done",
    "trials": 100,
    "trials_to_learn": 20,
    "greedy_success": 1.0,
    "greedy_steps": 500,
    "greedy_collisions": 1,
    "sampled_success": 1.0,
    "sampled_steps": 500,
    "sampled_collisions": 1,
    "rules": 800,
}


def study(arms, name="section5", seeds=5, **tables):
    """Data of a study in which all seeds of an arm are alike: what differs from `USUAL` by arm."""
    rows = [
        {"arm": arm, "seed": seed} | USUAL | changes
        for arm, changes in arms.items()
        for seed in range(seeds)
    ]
    config = {"maze": {"max_steps": LIMIT}, "trials": 100}
    kept = {"changes": "", "seeds": [*range(seeds)], "config": config}
    info = {"study": name, "optimum": OPTIMUM, "episodes": 100, "arms": dict.fromkeys(arms, kept)}
    return results.Data(info, rows, tables)


def curves(arm, *runs, quantity="steps"):
    """Rows of the table of curves, a run for each seed."""
    return [
        {"arm": arm, "seed": seed, "quantity": quantity, "values": " ".join(map(str, values))}
        for seed, values in enumerate(runs)
    ]


# ------------------------------------------------------------------------------- reading


def test_only_plain_numbers_of_a_table_are_numbers(tmp_path):
    texts = ["1_0", "\u0661", "1e999", "0x1", "Infinity", "sga-1e3", ""]
    (tmp_path / "a.csv").write_text("a,b\n-2.5e1,nan\n" + "".join(f"{t},7\n" for t in texts))
    first, *rest = results.read_table(tmp_path / "a.csv")
    assert first["a"] == -25 and math.isnan(first["b"])
    assert rest == [{"a": text, "b": 7} for text in texts]
    data = results.Data({}, [{"arm": "x", **row} for row in rest], {})
    assert data.column("x", "b").tolist() == [7] * len(texts)
    with pytest.raises(ValueError, match="must be a number, got '1_0'"):
        data.column("x", "a")


def test_only_plain_numbers_make_a_curve():
    rows = [{"arm": "x", "seed": 0, "quantity": "steps", "values": text} for text in ("1 2.5", 7.0)]
    data = results.Data({}, [], {"curves": [rows[0], rows[1] | {"seed": 1}]})
    assert [curve.tolist() for curve in data.curves("x", "steps").values()] == [[1, 2.5], [7]]
    rows[0]["values"] = "1 2_5"
    with pytest.raises(ValueError, match="must be a number, got '2_5'"):
        data.curves("x", "steps")


# ----------------------------------------------------------------------------- claims, goals


def test_an_arriving_seed_reaches_the_goal_in_nine_of_its_last_ten_trials_and_does_not_diverge():
    early = [LIMIT] * 30
    runs = [early + [500] * 10, early + [500] * 9 + [LIMIT], early + [500] * 8 + [LIMIT] * 2]
    runs += [[500] * 30 + [LIMIT] * 10, early + [500] * 10]
    data = study({"sga-sofnn-estimated": {}}, seeds=5, curves=curves("sga-sofnn-estimated", *runs))
    assert claims.arriving(data, "sga-sofnn-estimated") == (3, 5)
    data.rows[4]["status"] = "diverged"
    assert claims.arriving(data, "sga-sofnn-estimated") == (2, 5)


def test_claims_compare_the_sampled_policies():
    arms = {f"{agent}-sofnn-{pose}": {} for agent in ("sga", "q") for pose in ("estimated", "true")}
    arms["sga-sofnn-estimated"] = {"sampled_steps": 600, "rules": 912}
    arms["q-sofnn-estimated"] = {"rules": 10_024}
    arms["sga-fixed-estimated"] = {"trials_to_learn": 80}
    found = {
        claim: (measured, verdict) for claim, _, measured, verdict in claims.claims(study(arms))
    }
    said = {
        "Fig. 10, SGA": ("1.20", claims.FAILS),
        "Fig. 10, Q": ("1.00", claims.HOLDS),
        "Text: both": ("1.20", claims.FAILS),
        "Fig. 9": ("10.99", claims.HOLDS),
        "Fig. 7, SGA: SOFNN learns": ("0.25", claims.HOLDS),
    }
    for begin, expected in said.items():
        assert [row for claim, row in found.items() if claim.startswith(begin)] == [expected], begin


def test_the_closing_table_has_both_policies():
    changes = {"greedy_steps": 500, "sampled_steps": 600, "rules": 700}
    data = study({"q-sofnn-estimated": changes, "q-fixed-estimated": {"rules": 1152}})
    rows = [row[1:] for row in claims.closing_table(data)]
    assert rows == [
        ("528.9", "500.0", "1.068"),
        ("528.9", "600.0", "1.282"),
        ("10,024", "700", ""),
        (r"9,216 \*", "1,152", ""),
    ]


@pytest.mark.parametrize(
    ("changes", "reached"),
    [
        ({}, "yes yes yes yes"),
        ({"greedy_success": 0.99}, "[cannot tell] yes yes yes"),
        ({"greedy_success": 0.9}, "no yes yes yes"),
        ({"greedy_steps": 516.1}, "yes no no yes"),
        ({"trials_to_learn": 51}, "yes yes yes no"),
        ({"trials_to_learn": math.nan, "trials": 30}, "yes yes yes no"),
        ({"sampled_success": 0.5, "sampled_steps": 900}, "yes yes yes yes"),
    ],
)
def test_goals_are_of_the_greedy_policy(changes, reached):
    data = study({"sga-sofnn-estimated": changes})
    found = (yes if " " not in yes else f"[{yes}]" for *_, yes in claims.goals(data))
    assert " ".join(found) == reached


def test_a_goal_within_1_10_of_the_optimum_is_not_within_1_12():
    for steps, reached in ((1.09 * OPTIMUM, "yes"), (1.12 * OPTIMUM, "no")):
        data = study({"q-sofnn-estimated": {"greedy_steps": steps}})
        assert [yes for _, goal, _, yes in claims.goals(data) if "1.10" in goal] == [reached]


def through(zones, errors):
    """A path from outside into each zone and out again, with an error [m] at each pose."""
    points = [
        (x + step, y) for x, y in zones for step in (-0.2, 0.0, 0.2)
    ]  # outside, in the middle, outside
    true = np.array([[x, y, 0.0] for x, y in points])
    return Trajectory(true, true + np.array([[error, 0, 0] for error in errors]))


@pytest.mark.parametrize(
    ("errors", "twice"),
    [
        ([0.02, 0, 0.01, 0.05, 0, 0.02], 1),
        ([0.02, 0, 0.01, 0.05, 0.03, 0.02], 0),  # not at the second
        ([0, 0.03, 0.01, 0.05, 0, 0.02], 0),  # before the first, not after
    ],
)
def test_resets_count_where_the_error_ends_at_both_subgoals(errors, twice, monkeypatch):
    plan = claims.plan_of("s")
    path = through(plan.subgoals, errors)
    monkeypatch.setattr(claims, "last_paths", lambda data, arm: {0: path})
    assert claims.resets(SimpleNamespace(layout="s"), "arm") == (twice, 1, pytest.approx(0.05))
    data = study({"sga-sofnn-estimated": {}})
    measured = {claim[:7]: text for claim, _, text, _ in claims.claims(data)}
    assert measured["Fig. 11"] == f"{twice} of 1 paths; largest error 50 mm (median)"


# ------------------------------------------------------------------------------ tables, pages


def test_each_column_of_the_main_table_is_what_its_head_says():
    arms = {"sga-default": {}, "sga-other": {}}
    arms["sga-default"] = {"greedy_steps": 400}
    arms["sga-other"] = {
        "trials_to_learn": 33,
        "greedy_success": 0.9,
        "greedy_steps": 600,
        "greedy_collisions": 7,
        "sampled_success": 0.8,
        "sampled_steps": 700,
        "sampled_collisions": 2.5,
        "rules": 1234,
    }
    table = report.arm_table(study(arms, "ablation"), [*arms]).splitlines()
    head, row = ([cell.strip() for cell in line.split("|")[1:-1]] for line in (table[0], table[3]))
    assert dict(zip(head, row, strict=True)) == {
        "arm": "sga-other",
        "seeds": "5",
        "arriving": "0",
        "trials to learn": "33",
        "success, greedy [%]": "90.0 (87.0 to 92.5)",
        "steps, greedy": "600",
        "over the optimum": "1.28",
        "over the default": "1.50",
        "success, sampled [%]": "80.0 (76.2 to 83.4)",
        "steps, sampled": "700",
        "collisions a trial": "2.5",
        "rules": "1,234",
    }


def table_of(text):
    """The last line of a table in Markdown by its heads."""
    head, *_, row = ([c.strip() for c in line.split("|")[1:-1]] for line in text.splitlines())
    return dict(zip(head, row, strict=True))


def test_where_the_plain_policy_was_played_the_main_table_has_it_beside_the_greedy_one():
    plain = {"plain_success": 0.8, "plain_steps": 900, "trials_freed": 7}
    found = table_of(report.arm_table(study({"q-x": plain}), ["q-x"]))
    assert found["success, plain [%]"] == "80.0 (76.2 to 83.4)"
    assert (found["steps, plain"], found["trials freed"]) == ("900", "35 of 500")
    assert found["steps, greedy"] == "500"


@pytest.mark.parametrize(("alone", "reached"), [(1.0, "yes"), (0.9, "no")])
def test_the_plain_policy_has_a_goal_of_its_own(alone, reached):
    data = study({"q-sofnn-estimated": {"plain_success": alone, "plain_steps": 500}})
    (last,) = [yes for _, goal, _, yes in claims.goals(data) if "plain" in goal]
    assert last == reached


def test_what_learning_took_is_tabled_arm_by_arm():
    took = {"steps_to_learn": 80_000, "decisions_to_learn": 9_000, "replayed_to_learn": 64_000}
    found = table_of(report.learning_table(study({"q-x": took | {"cpu_seconds": 99}})))
    assert found == {
        "arm": "q-x",
        "trials": "20",
        "steps of the environment": "80,000",
        "decisions taken": "9,000",
        "decisions replayed": "64,000",
        "processor time of a whole run [s]": "99",
    }


def condition(seed, policy, success, steps):
    key = {"arm": "q-sofnn-estimated", "seed": seed, "group": "motor noise [%]", "value": 10.0}
    return key | {"policy": policy, "success": success, "steps": steps, "collisions": 0}


def test_conditions_are_tabled_for_the_greedy_policy():
    rows = [
        condition(seed, "greedy", success, steps)
        for seed, (success, steps) in enumerate(
            [(1, 400), (1, 500), (0.7, 900), (1, 400), (1, 600)]
        )
    ]
    rows += [condition(seed, "sampled", 0.1, 2000) for seed in range(5)]
    data = study({"q-sofnn-estimated": {}}, "robustness", conditions=rows)
    line = report.condition_table(data).splitlines()[-1]
    _, noise, success, steps, _ = (cell.strip() for cell in line.split("|"))
    assert noise == "motor noise 10 [%]"
    assert success.startswith("94 (") and steps == "500 (400 to 900)"


def test_conditions_are_drawn_for_the_greedy_policy():
    rows = [condition(seed, "greedy", 1, 400 + seed) for seed in range(3)]
    rows += [condition(seed, "sampled", 0.1, 2000) for seed in range(3)]
    data = study({"q-sofnn-estimated": {}}, "robustness", conditions=rows)
    figure = drawing.robustness(data)
    heights = [line.get_ydata() for ax in figure.axes for line in ax.lines if len(line.get_ydata())]
    drawn = {float(y) for line in heights for y in line}
    assert 401 in drawn and not {2000, 0.1, 10} & drawn


def test_hours_are_hours():
    info = {"study": "growth", "commits": ["abc"], "versions": [{"torch": "2"}], "made_with": []}
    info |= {"arms": {}, "runs": 3, "wall_seconds": 7200, "cpu_seconds": 1800}
    assert "2.00 hours of wall time and 0.50 of processor time" in report.provenance(info)


def test_a_page_says_when_its_arms_are_of_different_commits():
    info = {"study": "growth", "commits": ["a" * 40, "b" * 40], "versions": [], "made_with": []}
    info |= {"runs": 3, "wall_seconds": 0, "cpu_seconds": 0}
    info["arms"] = {"one": {"commits": ["a" * 40]}, "two": {"commits": ["a" * 40, "b" * 40]}}
    expected = "(**the arms are of different commits**: one aaaaaaa; two aaaaaaa, bbbbbbb)"
    assert expected in report.provenance(info)
    info["arms"]["one"]["commits"].append("b" * 40)
    assert "different" not in report.provenance(info)


def test_arms_of_equal_settings_and_seeds_are_shown_once():
    data = study({"sga-default": {}, "sga-same": {}})
    assert data.arms() == ["sga-default"]


# --------------------------------------------------------------------------------- statistics


def test_the_middle_between_a_number_and_never_is_never():
    values = np.array([0.0, 1.0, 2.0, results.NEVER, results.NEVER, results.NEVER])
    said = results.cell(statistics.median(values))
    assert said.startswith("never (") and "000" not in said
    values = np.array([200.0, *[results.NEVER] * 9])
    assert results.cell(statistics.median(values)) == "never"


def test_a_run_that_never_learns_counts_as_one_trial_more_than_it_had():
    data = study({"q-x": {"trials_to_learn": math.nan, "trials": 60}})
    assert results.censored(data, "q-x").tolist() == [61] * 5


# ------------------------------------------------------------------------------- collected data


def test_a_row_sums_up_one_run(tmp_path):
    head = "trial,steps,decisions,success,rules,learning/replayed\n"
    lines = ["1,20000,2000,False,5,0", "2,500,60,True,6,640", "3,400,50,True,9,320"]
    (tmp_path / "trials.csv").write_text(head + "\n".join(lines) + "\n")
    (tmp_path / "seconds.csv").write_text("10.0,1.0\n30.0,2.5\n")
    records = [
        {"success": True, "steps": 450, "collisions": 0, "freed": 0},
        {"success": False, "steps": 20_000, "collisions": 3, "freed": 7},
    ]
    evaluation = {"greedy": records, "plain": records[1:], "sampled": records[:1]}
    (tmp_path / "evaluation.json").write_text(json.dumps(evaluation))
    row = collecting._row(tmp_path, settings({"agent": "sga"}), OPTIMUM)
    for quantity in ("trials", "steps", "decisions", "replayed"):
        assert math.isnan(row.pop(f"{quantity}_to_learn"))
    assert row == {
        "status": "done",
        "trials": settings({"agent": "sga"}).trials,
        "greedy_success": 0.5,
        "greedy_steps": 10_225,
        "greedy_collisions": 1.5,
        "trials_freed": 1,
        "plain_success": 0,
        "plain_steps": 20_000,
        "plain_collisions": 3,
        "sampled_success": 1,
        "sampled_steps": 450,
        "sampled_collisions": 0,
        "rules": 9,
        "total_steps": 20_900,
        "wall_seconds": 40,
        "cpu_seconds": 3.5,
    }


def test_what_learning_took_is_summed_until_the_run_had_learned(tmp_path):
    head = "trial,steps,decisions,success,rules,learning/replayed\n"
    lines = [f"{n},{900 if n < 3 else 500},{50 + n},True,{n},{64 * n}" for n in range(1, 20)]
    (tmp_path / "trials.csv").write_text(head + "\n".join(lines) + "\n")
    (tmp_path / "evaluation.json").write_text("{}")
    row = collecting._row(tmp_path, settings({"agent": "sga"}), OPTIMUM)
    assert row["trials_to_learn"] == 12  # ten in a row from the third on
    assert row["steps_to_learn"] == 2 * 900 + 10 * 500
    assert row["decisions_to_learn"] == 12 * 50 + 78
    assert row["replayed_to_learn"] == 64 * 78


def test_half_of_the_runs_decide_whether_learning_came_to_an_end():
    rows = [{"arm": "q-x", "steps_to_learn": n} for n in (100, 200, 300, "nan", "nan")]
    data = results.Data({}, rows, {})
    assert results.until_learned(data, "q-x", "steps") == "300 (100 to never)"
    rows[0]["steps_to_learn"] = "nan"
    assert results.until_learned(data, "q-x", "steps") == "never (200 to never)"


def test_every_study_can_be_asked_for():
    assert set(get_args(Name)) == set(STUDIES)


def test_paths_keep_true_and_estimated_poses_apart(tmp_path):
    last = {"last_trial": {"true": [[1, 2, 3], [7, 8, 9]], "estimated": [[4, 5, 6], [0, 0, 0]]}}
    (tmp_path / "evaluation.json").write_text(json.dumps(last))
    rows = [*collecting._path(tmp_path)]
    assert rows[0] == {"decision": 0} | dict(zip(POSE_NAMES, range(1, 7), strict=True))
    data = study({}, paths=[{"arm": "a", "seed": 3.0} | row for row in rows])
    (path,) = drawing.last_paths(data, "a").values()
    assert path.true.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert path.estimated.tolist() == [[4, 5, 6], [0, 0, 0]]


# -------------------------------------------------------------------------------------- figures


def test_each_figure_shows_the_arms_that_its_caption_names(monkeypatch):
    names = [
        f"{agent}-{network}-{pose}"
        for agent in ("sga", "q")
        for network in ("sofnn", "fixed")
        for pose in ("estimated", "true")
    ]
    table = []
    for number, arm in enumerate(names):
        table += curves(arm, [1000 + number] * 3)
        table += curves(arm, [number] * 3, quantity="rules")
    drawn = []
    monkeypatch.setattr(drawing, "maze", lambda plan: None)
    monkeypatch.setattr(drawing, "_legend_above", lambda ax, columns=2: None)
    monkeypatch.setattr(
        figures,
        "learning_curves",
        lambda arms, ax, *_, **__: drawn.append(
            {label: int(run[0]) for label, (run,) in arms.items()}
        ),
    )
    shown = {}
    for name, _, text in drawing._of_the_paper(study({arm: {} for arm in names}, curves=table)):
        shown[name], drawn[:] = (text[: text.index(".", 5)], *drawn), []
    at = {arm: number for number, arm in enumerate(names)}
    steps = {arm: 1000 + number for arm, number in at.items()}
    assert shown["fig7"][0] == "Fig. 7: steps to the goal, SGA, estimated pose"
    for figure, agent in (("fig7", "sga"), ("fig8", "q")):
        assert shown[figure][1] == {
            "SOFNN": steps[f"{agent}-sofnn-estimated"],
            "FSFNN": steps[f"{agent}-fixed-estimated"],
        }
    assert shown["fig9"][1] == {
        "SGA, SOFNN": at["sga-sofnn-estimated"],
        "SGA, FSFNN": at["sga-fixed-estimated"],
        "Q-learning, SOFNN": at["q-sofnn-estimated"],
        "Q-learning, FSFNN": at["q-fixed-estimated"],
    }
    assert shown["fig10"][1:] == tuple(
        {f"{pose} pose": steps[f"{agent}-sofnn-{pose}"] for pose in ("estimated", "true")}
        for agent in ("sga", "q")
    )


def test_the_path_of_median_length_is_the_dark_one():
    poses = {seed: np.zeros((length, 3)) for seed, length in enumerate([9, 3, 5])}
    _, (ax,) = figures.canvas()
    drawing.pose_errors(
        {seed: Trajectory(p, p) for seed, p in poses.items()}, ax, drawing.Physics().plan
    )
    lengths = {line.get_color(): len(line.get_ydata()) for line in ax.lines}
    assert lengths[figures.BLUE] == 5


# ---------------------------------------------------------------------------- other conditions


@pytest.mark.parametrize(
    ("group", "value", "change"),
    [
        ("motor noise", 15, {"motor_noise": 0.15}),
        ("wheel radius", -3, {"wheel_radius_scale": 0.97}),
        ("wheel base", 1.5, {"wheel_base_scale": 1.015}),
        ("scatter", 50, {"start": 0.5}),
    ],
)
def test_a_condition_changes_what_its_name_says(group, value, change):
    (values,) = (v for name, v in robustness.CONDITIONS.items() if name.startswith(group))
    assert values[value] == pytest.approx(change)


def test_the_start_is_scattered_to_both_sides_by_at_most_30_mm_and_20_degrees():
    env = robustness.changed_maze(settings({"agent": "sga"}), {"start": 1.0}, 0)
    poses = np.array([env.reset(seed=0)[1]["true_pose"] for _ in range(40)])
    offset = poses - env.unwrapped.plan.start
    env.close()
    most = np.array([0.03, 0.03, math.radians(20)])
    assert (offset.min(0) < -0.6 * most).all() and (offset.max(0) > 0.6 * most).all()
    assert (abs(offset) <= most + 1e-9).all()


def test_the_greedy_policy_is_played_without_chance_in_other_conditions(monkeypatch):
    config, explored = settings({"agent": "sga"}), []
    record = SimpleNamespace(row=lambda: {"success": True, "steps": 1, "collisions": 0})

    def play(env, agent, learn, explore):
        explored.append(explore)
        return record, None

    monkeypatch.setattr(robustness, "CONDITIONS", {"noise": {0: {"motor_noise": 0.0}}})
    agent = SimpleNamespace(reseed=lambda seed: None)
    monkeypatch.setattr(robustness.evaluate, "load", lambda path: (config, agent, None, None))
    monkeypatch.setattr(robustness, "play", play)
    rows = robustness.under_conditions("run")
    assert [row["policy"] for row in rows] == ["greedy", "sampled"]
    assert explored == [False] * robustness.EPISODES + [True] * robustness.EPISODES


def test_the_greedy_policy_is_evaluated_without_chance_and_the_last_path_is_kept(
    tmp_path, monkeypatch
):
    played = []

    @dataclasses.dataclass
    class Record:
        steps: int

        def row(self):
            return dataclasses.asdict(self)

    def evaluated(config, agent, episodes, explore, seed, plain):
        played.append((episodes, explore, seed, plain))
        return [Record(2 if explore else 3 if plain else 1)]

    true, estimated = np.array([[1.0, 2, 3]]), np.array([[4.0, 5, 6]])
    config = settings({"agent": "sga"}, seed=7)
    monkeypatch.setattr(running.training, "train", lambda *_: None)
    monkeypatch.setattr(running.evaluate, "load", lambda path: (config, None, None, None))
    monkeypatch.setattr(running.evaluate, "evaluate", evaluated)
    monkeypatch.setattr(running, "read_column", lambda path, column: np.array([0.0, 1.0]))
    last = Record(9), Trajectory(true, estimated)
    monkeypatch.setattr(running, "last_trial", lambda path: last)
    data = running._train_and_evaluate(tmp_path, config)
    each = [(False, False), (False, True), (True, False)]  # greedy, plain, sampled
    assert played == [(running.EPISODES, explore, 1007, plain) for explore, plain in each]
    assert [data[name][0]["steps"] for name in ("greedy", "plain", "sampled")] == [1, 3, 2]
    assert data["last_trial"] == {"steps": 9, "true": [[1, 2, 3]], "estimated": [[4, 5, 6]]}


def test_success_rates_are_shares_of_the_seeds_averaged_over_the_last_trials():
    _, (ax,) = figures.canvas()
    runs = [np.array([20, 20, 5.0]), np.array([20, 5, 5.0, 5])]
    drawing.success_rates({"arm": runs}, ax, limit=20)
    (line,) = ax.lines
    assert line.get_xdata().tolist() == [1, 2, 3]
    assert line.get_ydata() == pytest.approx([0, 25, 50])  # means of 0, 1/2 and 1
