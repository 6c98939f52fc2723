"""Studies: arms make sound settings, runs are shared and kept, data become tables and figures."""

import dataclasses
import io
import itertools
import json
import math
import sys

import numpy as np
import pytest
from conftest import fixed_interval
from PIL import Image

from sofnn_torch import cli, evaluate, training
from sofnn_torch.pictures.figures import read_column
from sofnn_torch.runs.guard import Divergence
from sofnn_torch.studies import __main__ as command
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
from sofnn_torch.studies.studies import STUDIES, Times, changed, essence, settings

OPTIMUM = 468
TINY = {"trials": 3, "maze.max_steps": 40, "net.grid": (3, 3, 3)}
ARMS = [(study, arm) for study, entry in STUDIES.items() for arm in entry.arms]


def job(tmp_path, name="run", conditions=False, **changes):
    config = settings({"agent": "sga"} | TINY | changes)
    return running.Job(tmp_path / name, config, conditions)


def done(work):
    """Do a job in this process, as the child would."""
    return running.work(work.path, running._process(work).arguments)


# ------------------------------------------------------------------------------------ studies


@pytest.mark.parametrize(("study", "arm"), ARMS)
def test_every_arm_is_a_set_of_valid_settings(study, arm):
    entries = STUDIES[study].arms[arm]
    config = settings(entries, seed=3, **TINY)
    assert config.seed == 3 and config.maze.max_steps == 40
    assert arm.startswith(f"{config.agent}-")
    reference = {"section5", "paper", "robustness"}
    own = set(entries) - {"agent", "network", "preset"}
    own -= {"pose"} if study in reference else set()
    assert bool(own) != (study in reference or arm.endswith("-default"))
    start = {name: entries[name] for name in ("agent", "network", "preset") if name in entries}
    flags = (cli.Flags(settings(part), cli.RunOptions()) for part in (entries, start))
    cli._refuse_idle(*flags)  # a page of results shows no flag that train.py would refuse


def test_a_factor_follows_the_preset():
    base, scaled = settings({"agent": "q"}), settings({"agent": "q", "net.theta": Times(0.5)})
    assert scaled == dataclasses.replace(
        base, net=dataclasses.replace(base.net, theta=base.net.theta / 2)
    )


@pytest.mark.parametrize("name", ["net.thetta", "theta", "preset.theta"])
def test_a_change_of_no_setting_is_refused(name):
    with pytest.raises(ValueError, match="is not a setting"):
        settings({"agent": "q", name: 1.0})


CHANGES = {
    "fixed": {"net.grid": (5, 6, 7), "q.trace_limit": None, "q.trace_cut": False},
    "sofnn": {"net.growth": "input", "pose": "true", "net.theta": Times(0.123456789)},
}


@pytest.mark.parametrize("network", CHANGES)
def test_changes_are_printed_as_flags_that_mean_the_same(network):
    arm = {"agent": "q", "network": network, "preset": "paper"} | CHANGES[network]
    words = ["--agent", "q", "--network", network, "--preset", "paper", *changed(arm).split()]
    assert cli.parse(words).config == settings(arm)


def test_settings_without_effect_do_not_make_another_run():
    same = [{}, {"sga.gamma": 0.5}, {"net.grid": (5, 5, 5)}, {"net.width_action": 0.7}]
    other = [{"q.gamma": 0.5}, {"net.theta": 0.6}, {"seed": 1}, {"trials": 9}, {"network": "fixed"}]
    keys = [essence(settings({"agent": "q"} | change)) for change in same + other]
    assert len(set(keys[: len(same)])) == 1
    assert len(set(keys)) == 1 + len(other)


# --------------------------------------------------------------------------------------- runs


def test_studies_share_equal_runs_and_leave_others_alone(tmp_path):
    changes = {"trials": 2}
    taken = tmp_path / "growth-q-rule-s0"
    taken.mkdir()  # of other settings
    jobs = running.plan(tmp_path, ["growth", "robustness"], "", [0, 1], changes)
    names = [work.path.name for work in jobs]
    assert len(set(names)) == len(names)
    assert "growth-q-rule-s0-2" in names and "growth-q-rule-s1" in names
    assert not any(name.startswith("robustness-q-sofnn") for name in names)  # has it as q-rule
    assert {work.path.name for work in jobs if work.conditions} == {
        *("growth-q-rule-s0-2", "growth-q-rule-s1", "growth-sga-rule-s0", "growth-sga-rule-s1"),
        *(f"robustness-{agent}-fixed-estimated-s{s}" for agent in ("sga", "q") for s in (0, 1)),
    }
    assert [w.path.name for w in running.plan(tmp_path, ["growth"], "sga-in", [4], {})] == [
        "growth-sga-input-s4"
    ]


def test_a_run_is_trained_and_evaluated_and_then_kept(tmp_path, monkeypatch):
    work = job(tmp_path)
    assert done(work) == 0 and work.done()
    steps = read_column(work.path / "trials.csv", "steps")
    assert len(steps) == 3
    data = json.loads((work.path / "evaluation.json").read_text())
    assert len(data["greedy"]) == len(data["sampled"]) == running.EPISODES
    config, agent, _, _ = evaluate.load(work.path)
    again = evaluate.evaluate(config, agent, running.EPISODES, True, data["seed"])
    assert data["sampled"] == [record.row() for record in again]
    monkeypatch.setattr(training, "train", None)
    monkeypatch.setattr(training, "resume", None)
    assert done(work) == 0
    assert running.find_runs(tmp_path) == ({essence(work.config): work.path}, set())
    (found,) = running.plan(tmp_path, ["section5"], "sga-sofnn-est", [0], TINY)
    assert found == dataclasses.replace(work, conditions=False) and found.done()


def test_runs_of_other_code_and_other_evaluations_are_not_reused(tmp_path, monkeypatch, capsys):
    work = job(tmp_path)
    assert done(work) == 0

    def planned(**options):
        return running.plan(tmp_path, ["section5"], "sga-sofnn-est", [0], TINY, **options)[0]

    assert planned().done()
    evaluation = work.path / "evaluation.json"
    evaluation.write_text(evaluation.read_text().replace('"episodes": 20', '"episodes": 10'))
    assert planned().path == work.path and not planned().done()
    assert done(work) == 0 and planned().done()
    assert "other code" not in capsys.readouterr().err
    monkeypatch.setattr(running, "code", lambda: "another")
    assert planned().path != work.path and not planned().done()
    assert "1 runs below" in capsys.readouterr().err
    assert planned(any_code=True).done()


def test_a_killed_run_goes_on(tmp_path):
    work = job(tmp_path)
    options = training.RunOptions(tmp_path, work.path.name, quiet=True)
    training.train(dataclasses.replace(work.config, trials=2), options)
    before = (work.path / "trials.csv").read_text()
    settings_file = work.path / "config.json"
    settings_file.write_text(settings_file.read_text().replace('"trials": 2', '"trials": 3'))
    assert done(work) == 0
    after = (work.path / "trials.csv").read_text()
    assert after.startswith(before) and after.count("\n") == 4


def test_the_last_trial_is_played_again_to_the_bit(tmp_path):
    work = job(tmp_path)
    training.train(work.config, training.RunOptions(tmp_path, "run", quiet=True))
    record, path = running.last_trial(work.path)
    assert record.steps == read_column(work.path / "trials.csv", "steps")[-1]
    assert record.measures["pose_error"] == read_column(work.path / "trials.csv", "pose_error")[-1]
    assert len(path.true) == record.decisions + 1


ABORTS = """
import os
def work(path, *_):
    path.mkdir()
    if path.name == "b":
        os.abort()
    (path / "evaluation.json").write_text('{"diverged": "numbers"}')
"""


def test_a_crash_is_reported_and_the_others_finish(tmp_path, monkeypatch, capsys):
    (tmp_path / "aborts.py").write_text(ABORTS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(running, "WORK", "aborts:work")
    jobs = [job(tmp_path, name) for name in "abc"]
    assert running.execute(jobs, workers=1) == 1
    assert [work.done() for work in jobs] == [True, False, True]
    assert f"failed: {tmp_path / 'b'}" in capsys.readouterr().err


def test_what_cannot_be_done_is_one_line(tmp_path, capsys):
    work = job(tmp_path)
    work.path.mkdir()
    (work.path / "config.json").write_text("{}")
    assert done(work) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_a_divergence_is_a_result(tmp_path, monkeypatch):
    def diverges(config, options, after):
        (options.runs / options.name).mkdir()
        raise Divergence("trial 1 diverged")

    monkeypatch.setattr(training, "train", diverges)
    work = job(tmp_path, conditions=True)
    assert done(work) == 0 and work.done()
    row = collecting._row(work.path, work.config, OPTIMUM)
    assert row["status"] == "diverged" and math.isnan(row["trials_to_learn"])
    assert (row["greedy_success"], row["greedy_steps"]) == (0, 40)


@pytest.mark.parametrize(
    ("steps", "learned"),
    [
        ([700] * 10, 10),
        ([700] * 9, math.nan),
        ([900] + [700] * 9 + [702] + [701] * 10, 21),  # 702 = 1.5 x 468 is not under it
        ([700] * 9 + [20_000] + [700] * 12, 20),
    ],
)
def test_trials_to_learn(steps, learned):
    arrived = [n < 20_000 for n in steps]
    assert collecting.trials_to_learn(steps, arrived, OPTIMUM) == pytest.approx(
        learned, nan_ok=True
    )


def test_short_trials_that_fail_are_not_learning():
    assert math.isnan(collecting.trials_to_learn([40] * 20, [False] * 20, OPTIMUM))


def test_other_conditions(tmp_path, monkeypatch):
    conditions = {"noise": {0: {"motor_noise": 0.0}}, "scatter": {1: {"start": 1.0}}}
    monkeypatch.setattr(robustness, "CONDITIONS", conditions)
    work = job(tmp_path, conditions=True)
    assert done(work) == 0
    rows = json.loads((work.path / "conditions.json").read_text())
    assert [(row["group"], row["policy"]) for row in rows] == [
        (group, policy) for group in conditions for policy in ("greedy", "sampled")
    ]
    assert {row["steps"] for row in rows} == {40}


def test_the_scattered_start_is_near_the_start_and_seeded():
    config = settings({"agent": "sga"})
    starts = []
    for seed in (1, 1, 2):
        env = robustness.changed_maze(config, {"start": 0.5}, seed)
        infos = [env.reset(seed=0)[1] for _ in range(20)]
        starts.append(np.array([info["true_pose"] for info in infos]))
        for info in infos:
            assert info["estimated_pose"] == pytest.approx(info["true_pose"], abs=1e-9)
        env.close()
    offset = (starts[0] - env.unwrapped.plan.start) / robustness.START_SPREAD
    assert (np.abs(offset) <= 0.5 + 1e-9).all()
    assert (offset.max(0) > 0.3).all() and (offset.min(0) < -0.3).all()  # to either side
    assert (starts[0] == starts[1]).all() and (starts[0] != starts[2]).any()
    noisy = robustness.changed_maze(config, {"motor_noise": 0.3}, 0)
    assert noisy.unwrapped.noise.magnitude == 0.3
    noisy.close()


# ------------------------------------------------------------------- statistics and the report


@pytest.mark.parametrize(
    ("measured", "text"),
    [
        (fixed_interval(1234.5, 1000, 2000.5), "1,235 (1,000 to 2,001)"),
        (fixed_interval(151, 80, 151), "> 150 (80 to > 150)"),
        (fixed_interval(151), "> 150"),
        (fixed_interval(math.nan), "-"),
        (statistics.median(np.array([120.0, 151.0, 7.5])), "120; > 150; 8"),
        (statistics.median(np.array([120.0])), "120"),
    ],
)
def test_cells(measured, text):
    limit = math.inf if "1,235" in text else 150
    assert results.cell(measured, limit=limit) == text


def test_a_path_passes_a_point_between_two_poses():
    poses = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 2], [1, 1, 2]])
    assert claims._distances(poses, (0.4, 0.1))[0] == pytest.approx(0.1)
    assert claims._distances(poses, (1.3, 0.4)) == pytest.approx([0.5, 0.5, 0.3])


LEVEL = {"sga-sofnn": 500, "q-sofnn": 520, "sga-fixed": 560, "q-fixed": 20_000}  # steps at the end


def fake(out, name, trials=30, seeds=12):
    """Data of a study as `collect` writes them, of learners that end at LEVEL."""
    rng, tables = np.random.default_rng(5), {"": [], "curves": [], "paths": [], "conditions": []}
    plan = drawing.Physics().plan
    for arm in STUDIES[name].arms:
        level = LEVEL[arm.rsplit("-", 1)[0]]
        for seed in range(seeds):
            key = {"arm": arm, "seed": seed}
            curve = level + 10_000 * 0.8 ** np.arange(trials) * rng.uniform(0.5, 1, trials)
            steps = np.minimum(curve.round(), 20_000)
            row = {"status": "done", "trials": trials}
            row["trials_to_learn"] = collecting.trials_to_learn(steps, steps < 20_000, OPTIMUM)
            for policy in ("greedy", "sampled"):
                row[f"{policy}_success"] = float(level < 20_000)
                row[f"{policy}_steps"] = level + rng.normal(0, 10) * (level < 20_000)
                row[f"{policy}_collisions"] = 0.5
            row |= {"rules": (800, 1152)["fixed" in arm] + ("sofnn-e" in arm) * seed}
            tables[""].append(
                key | row | {"total_steps": 1e5, "wall_seconds": 60, "cpu_seconds": 50}
            )
            for quantity, values in (("steps", steps), ("rules", np.full(trials, row["rules"]))):
                text = " ".join(f"{value:.0f}" for value in values)
                tables["curves"].append(key | {"quantity": quantity, "values": text})
            if level < 20_000:
                tables["paths"] += fake_path(key, plan, rng)
            for group, values in robustness.CONDITIONS.items():
                for value in values:
                    common = {"group": group, "value": value, "success": 1 - abs(value) / 200}
                    common |= {"steps": level * (1 + abs(value) / 100), "collisions": 1}
                    tables["conditions"] += [
                        key | common | {"policy": policy} for policy in ("greedy", "sampled")
                    ]
    wanted = {"": True, "curves": True}
    wanted |= {"paths": STUDIES[name].figures, "conditions": STUDIES[name].conditions}
    for part, rows in tables.items():
        if wanted[part]:
            results.write_table(out / f"{name}{'-' * bool(part)}{part}.csv", rows)
    arms = {
        arm: {
            "changes": changed(entries),
            "seeds": [*range(seeds)],
            "config": dataclasses.asdict(settings(entries)),
        }
        for arm, entries in STUDIES[name].arms.items()
    }
    summary = {"study": name, "title": STUDIES[name].title, "about": STUDIES[name].about}
    summary |= {"made_with": ["the command"], "quick": False, "optimum": OPTIMUM, "episodes": 10}
    summary |= {"in_a_row": 10, "within": 1.5, "runs": 3, "wall_seconds": 1, "cpu_seconds": 1}
    summary |= {"commits": ["abc"], "versions": [{"torch": "2"}], "arms": arms}
    (out / f"{name}.json").write_text(json.dumps(summary))


def fake_path(key, plan, rng):
    """Points through the sub-goals, with an error that grows until each of them."""
    corners = np.array([plan.start[:2], *plan.subgoals, plan.goal])
    points = np.concatenate([np.linspace(a, b, 15)[:-1] for a, b in itertools.pairwise(corners)])
    error = np.zeros(2)
    for decision, point in enumerate(points):
        near = any(np.hypot(*(point - goal)) < plan.subgoal_radius for goal in plan.subgoals)
        error = np.zeros(2) if near else error + rng.normal(0, 0.002, 2)
        values = [*point, 0.0, *(point + error), 0.0]
        names = ["x", "y", "heading"]
        names += [f"{name}_estimated" for name in names]
        yield key | {"decision": decision} | dict(zip(names, np.round(values, 5), strict=True))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A directory of results from fake data."""
    out = tmp_path_factory.mktemp("results")
    for name in ("section5", "robustness"):
        fake(out, name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "maze", lambda layout: None)  # rendered by the test of captions
        assert report.write(out) == 0
    return out


def test_claims_and_goals_follow_the_data(written):
    data = results.read(written, "section5")
    verdicts = {claim: verdict for claim, _, _, verdict in claims.claims(data)}
    expected = {
        "SGA: the proposed": claims.HOLDS,
        "SGA: the conventional": claims.FAILS,
        "Q-learning: the proposed": claims.HOLDS,
        "Q-learning: the conventional": claims.HOLDS,
        "Q-learning grows many more": claims.FAILS,
        "Fig. 10, SGA": claims.HOLDS,
        "Fig. 11, Q-learning": claims.HOLDS,
        "same performance": claims.HOLDS,
    }
    for part, verdict in expected.items():
        assert [v for claim, v in verdicts.items() if part in claim] == [verdict], part
    reached = {(who, goal): yes for who, goal, _, yes in claims.goals(data)}
    assert reached["SGA", "steps at most 516"] == "yes"
    assert reached["Q-learning", "steps within 1.10 of the optimum"] == "no"  # 520 / 468
    text = (written / "section5.md").read_text()
    assert r"| Q-learning with FSFNN: rules | 9,216 \* | 1,152 |" in text
    assert "| > 30 |" in text and " nan" not in text and "diverged" not in text


def test_every_figure_is_there_and_shown(written):
    text = (written / "section5.md").read_text() + (written / "robustness.md").read_text()
    names = [f"section5-fig{n}" for n in (7, 8, 9, 10, 11)] + ["robustness-conditions"]
    for name in names:
        picture = Image.open(io.BytesIO((written / f"figures/{name}.png").read_bytes()))
        assert np.ptp(np.asarray(picture.convert("L"))) > 200
        assert (written / f"figures/{name}.svg").read_text().startswith("<?xml")
        assert f"](figures/{name}.png)" in text


def test_tables_and_captions_say_which_seeds_diverged(written, tmp_path, monkeypatch):
    monkeypatch.setattr(drawing, "save", lambda _, path: path.with_suffix(".png").touch())
    for file in [*written.glob("section5*.csv"), written / "section5.json"]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    half, none = "q-sofnn-estimated", "sga-fixed-estimated"
    rows = results.read_table(written / "section5.csv")
    for row in rows:
        if row["arm"] == none or (row["arm"] == half and row["seed"] < 6):
            row["status"] = "diverged"
    results.write_table(tmp_path / "section5.csv", rows)
    curves = results.read_table(written / "section5-curves.csv")  # none: diverged in trial 1
    results.write_table(
        tmp_path / "section5-curves.csv", [row for row in curves if row["arm"] != none]
    )
    assert report.write(tmp_path) == 0
    text = (tmp_path / "section5.md").read_text()
    assert f"| {none} |  | 12 | 0; 12 of 12 seeds diverged |{' - |' * 8}\n" in text
    assert f"| {half} |  | 12 | 6; 6 of 12 seeds diverged | 2" in text
    assert "0 of 12 seeds (0 to 26 %); 12 of 12 seeds diverged" in text
    assert text.count("SOFNN: the median ends where a seed diverged.") == 2  # Figs 8 and 9
    assert "A seed *diverged* if" in text


def test_a_report_can_be_written_again(written, tmp_path, monkeypatch):
    for file in [*written.glob("robustness*.csv"), written / "robustness.json"]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.setattr(sys, "argv", ["studies", "--report-only", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 0
    for name in ("robustness.md", "figures/robustness-conditions.svg"):
        assert (tmp_path / name).read_bytes() == (written / name).read_bytes()
    assert "robustness.md" in (tmp_path / "README.md").read_text()


def test_data_of_runs_become_a_page(tmp_path, monkeypatch):
    runs, out = tmp_path / "runs", tmp_path / "out"
    monkeypatch.setattr(command, "mean_optimum", lambda plan: OPTIMUM)
    options = {"study": ("growth",), "arms": "sga-rule", "seeds": "0-1", "trials": 2}
    options |= {"max_steps": 30, "runs": runs, "out": out}
    for work in running.plan(
        runs, ["growth"], "sga-rule", [0, 1], {"trials": 2, "maze.max_steps": 30}
    ):
        assert done(work) == 0
    (runs / "growth-sga-rule-s1" / running.PLAYED).write_text('[{"instructions": "AVX7"}]')
    assert command.run(command.Options(**options)) == 0
    data = results.read(out, "growth")
    trained, played = data.info["versions"]
    assert trained["instructions"] != played["instructions"] == "AVX7"
    assert data.column("sga-rule", "seed").tolist() == [0, 1]
    assert data.column("sga-rule", "total_steps").tolist() == [60, 60]
    assert [curve.tolist() for curve in data.curves("sga-rule", "steps").values()] == [[30, 30]] * 2
    assert data.info["arms"]["sga-rule"]["config"]["maze"]["max_steps"] == 30
    (made,) = data.info["made_with"]
    assert made.endswith("--study growth --arms sga-rule --seeds 0-1 --trials 2 --max-steps 30")
    assert command.run(command.Options(**options | {"seeds": "0"})) == 0  # has nothing left to do
    assert command.run(command.Options(**options)) == 0
    both = results.read(out, "growth").info["made_with"]
    assert both == [made, made.replace("0-1", "0")]
    page = (out / "growth.md").read_text()
    assert "| sga-rule |" in page and "Runs of 2 trials." in page
    assert "growth.md" in (out / "README.md").read_text()


@pytest.mark.parametrize(
    ("words", "begin"),
    [
        ("--study nothing", "--study must be one of 'section5', "),
        ("--workers 0", "--workers must be at least 1, got 0"),
        ("--seeds x", "--seeds must be a list"),
        ("--arms nonesuch", "--arms nonesuch"),
        ("--report-only --out empty", ""),
    ],
)
def test_bad_options_are_one_line(words, begin, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["studies", *words.split()])
    with pytest.raises(SystemExit) as stop:
        command.main()
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: {begin}") and message.count("\n") == 1
    assert not list(tmp_path.iterdir())
