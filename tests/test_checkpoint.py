"""Checkpoint files: whole or not there, and every damage is noticed."""

import copy
import io
import multiprocessing
import os
import random
import resource
import shutil
import stat
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from conftest import equal, quick_options, settings
from hypothesis import given
from hypothesis import settings as trials_of
from hypothesis import strategies as st

from sofnn_torch import training
from sofnn_torch.cli import main
from sofnn_torch.runs import checkpoint
from sofnn_torch.runs.checkpoint import CheckpointError
from sofnn_torch.runs.directory import Run
from sofnn_torch.runs.factory import make_agent, make_env


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run with checkpoints 0, 2 and 4."""
    return training.train(settings(), quick_options(tmp_path_factory.mktemp("runs")))


@pytest.fixture
def copied(run, tmp_path):
    """A copy of the run that may be harmed."""
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.fixture(scope="module")
def state(run):
    return checkpoint.find_latest(run)[1]


def contents(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def rewrite(path, state, version=checkpoint.VERSION):
    """A file with a right checksum around any content."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    head = b"sofnn-torch checkpoint %d %s\n" % (version, checkpoint._digest(version, payload))
    path.write_bytes(head + payload)


def refused(path):
    """The one line with which a file is refused."""
    with pytest.raises(CheckpointError) as caught:
        state = checkpoint.load(path)
        config = settings()
        checkpoint.restore(path, state, make_agent(config), make_env(config))
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and len(message) < 500
    return message


def test_a_state_comes_back_to_the_last_bit(state, tmp_path):
    checkpoint.save(tmp_path / "copy.pt", state)
    assert equal(checkpoint.load(tmp_path / "copy.pt"), state)


def test_a_restored_agent_and_maze_go_on_alike(state, run):
    config = settings()
    ends = []
    for _ in range(2):
        agent, env = make_agent(config), make_env(config)
        checkpoint.restore(run, state, agent, env)
        record, path = training.play(env, agent)
        ends.append((record, path.true.tolist(), checkpoint.snapshot(agent, env)))
    assert equal(ends[0], ends[1])
    assert not equal(ends[0][2]["agent"], state["agent"])


@pytest.mark.parametrize("name", ["sga", "q"])
def test_a_snapshot_does_not_change_with_the_agent(name):
    agent, env = make_agent(settings(name)), make_env(settings(name))
    env.reset(seed=0)
    training.play(env, agent)
    taken, buffer = checkpoint.snapshot(agent, env), io.BytesIO()
    torch.save(taken, buffer)
    buffer.seek(0)
    before = torch.load(buffer)
    training.play(env, agent)
    assert equal(taken, before)
    assert not equal(taken, checkpoint.snapshot(agent, env))


def test_the_schema_of_the_document_is_that_of_the_file(state):
    document = (Path(__file__).parents[1] / "docs" / "checkpoints.md").read_text()
    described = {line.split("`")[1] for line in document.splitlines() if line.startswith("| `")}
    assert set(state) <= described
    assert set(state["network"]) <= described


def test_the_newest_are_kept(run):
    assert [path.name for path in checkpoint.checkpoints(run)] == [
        f"checkpoint-{trial}.pt" for trial in (4, 2, 0)
    ]


# ------------------------------------------------------------------------------------- damage


def test_every_bit_of_the_header_counts(run, tmp_path):
    data = (run / "checkpoint-4.pt").read_bytes()
    broken = tmp_path / "broken.pt"
    for bit in range(8 * (data.index(b"\n") + 1)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        broken.write_bytes(changed)
        with pytest.raises(CheckpointError):
            checkpoint.load(broken)


def damage(data, kind, dice):
    """The data, damaged at a random place."""
    at, length = dice.randrange(len(data)), dice.randint(1, 300)
    return {
        "flipped": data[:at] + bytes([data[at] ^ 1 << dice.randrange(8)]) + data[at + 1 :],
        "cut off": data[:at],
        "a part lost": data[:at] + data[at + length :],
        "inserted": data[:at] + dice.randbytes(length) + data[at:],
        "lengthened": data + dice.randbytes(length),
    }[kind]


@pytest.mark.parametrize("kind", ["flipped", "cut off", "a part lost", "inserted", "lengthened"])
def test_hundreds_of_damages_are_refused_and_nothing_touched(kind, copied, options):
    newest, dice = copied / "checkpoint-4.pt", random.Random(kind)
    data = newest.read_bytes()
    for count in range(500 if kind == "flipped" else 200):
        newest.write_bytes(damaged := damage(data, kind, dice))
        assert damaged != data
        with pytest.raises(CheckpointError, match=r"^\S+checkpoint-4.pt: (damaged|not a ch).*$"):
            checkpoint.load(newest)
        if count % 40 == 0:  # what a run makes of it
            before = contents(copied)
            with pytest.raises(CheckpointError, match=r"^\S+: .* --resume \S+checkpoint-2.pt$"):
                training.resume(copied, options, trials=6)
            assert contents(copied) == before


@pytest.mark.parametrize(
    "data",
    [b"", b"\x80\x04N.", b"PK\x03\x04" + bytes(100), b"sofnn-torch checkpoint\n", os.urandom(9999)],
    ids=["empty", "pickle", "zip", "header without numbers", "noise"],
)
def test_foreign_files_are_refused(data, tmp_path):
    (tmp_path / "foreign.pt").write_bytes(data)
    assert "not a checkpoint of sofnn-torch" in refused(tmp_path / "foreign.pt")


def test_a_file_of_torch_is_refused(tmp_path):
    torch.save({"model": torch.zeros(3)}, tmp_path / "model.pt")
    assert "not a checkpoint of sofnn-torch" in refused(tmp_path / "model.pt")


def test_a_newer_format_is_refused(state, tmp_path):
    rewrite(tmp_path / "new.pt", state, version=checkpoint.VERSION + 1)
    assert "update sofnn-torch" in refused(tmp_path / "new.pt")


def test_a_missing_file_and_a_directory_are_refused(tmp_path):
    assert "cannot be read" in refused(tmp_path / "none.pt")
    assert "cannot be read" in refused(tmp_path)


class Exploit:
    """A pickle that would run code when loaded."""

    def __reduce__(self):
        return os.system, ("touch exploited",)


def test_loading_cannot_run_code(tmp_path, monkeypatch, state):
    monkeypatch.chdir(tmp_path)
    rewrite(tmp_path / "evil.pt", state | {"trial": Exploit()})
    assert "not a checkpoint" in refused(tmp_path / "evil.pt")
    assert not (tmp_path / "exploited").exists()


@pytest.mark.parametrize("key", checkpoint.KINDS)
def test_a_state_without_a_part_is_refused(key, state, tmp_path):
    rewrite(tmp_path / "part.pt", {name: part for name, part in state.items() if name != key})
    assert key in refused(tmp_path / "part.pt")


def edits(state):
    """States with one leaf of agent, environment or network missing or replaced by nonsense."""

    def walk(tree, place=()):
        for key, part in tree.items():
            if isinstance(part, dict):
                yield from walk(part, (*place, key))
            yield (*place, key)

    places = [p for p in walk(state) if p[0] in ("agent", "env", "network") and len(p) > 1]
    return [(place, value) for place in places for value in ("missing", None, [1, 2], {"a": "b"})]


def edited(tree, place, value):
    changed = copy.copy(tree)  # of the same type
    if len(place) > 1:
        changed[place[0]] = edited(tree[place[0]], place[1:], value)
    elif value == "missing":
        del changed[place[0]]
    else:
        changed[place[0]] = value
    return changed


def test_wrong_parts_inside_a_state_are_refused(state, tmp_path):
    accepted = []
    for place, value in edits(state):
        rewrite(tmp_path / "edited.pt", edited(state, place, value))
        try:
            refused(tmp_path / "edited.pt")
        except pytest.fail.Exception:
            accepted.append((place, value))
    assert not accepted


@pytest.mark.parametrize("rows,columns", [(-1, 0), (1, 0), (0, -1), (0, 1)])
def test_wrong_shapes_are_refused(rows, columns, state, tmp_path):
    net = copy.copy(state["agent"]["net"])
    for name in ("blocks.centres.0", "traces", "labels"):
        a, b = net[name].shape
        net[name] = torch.zeros(a + rows, b + columns)
        rewrite(tmp_path / "shape.pt", edited(state, ("agent", "net"), net))
        assert "does not fit its settings" in refused(tmp_path / "shape.pt")


@pytest.mark.parametrize("entry,value", [("theta", 0.9), ("max_rules", 7), ("rules", 1)])
def test_a_state_of_another_network_is_refused(entry, value, state, tmp_path):
    rewrite(tmp_path / "other.pt", edited(state, ("network", entry), value))
    assert "does not fit its settings ({'n_inputs': 3" in refused(tmp_path / "other.pt")


@pytest.mark.parametrize("place", [("net", "traces"), ("memory", "rows")])
def test_numbers_of_another_precision_are_refused(place, state, tmp_path):
    double = state["agent"][place[0]][place[1]].double()
    rewrite(tmp_path / "double.pt", edited(state, ("agent", *place), double))
    message = f"{place[1]} holds torch.float64, not torch.float32"
    assert message in refused(tmp_path / "double.pt")


@pytest.mark.parametrize("rules", [0, 10**4])
def test_an_impossible_rule_count_is_refused(rules, state, tmp_path):
    net = copy.copy(state["agent"]["net"])
    for name in ("traces", "usage", "labels"):
        net[name] = net[name].new_zeros(*net[name].shape[:-1], rules)
    rewrite(tmp_path / "rules.pt", edited(state, ("agent", "net"), net))
    assert "does not fit its settings" in refused(tmp_path / "rules.pt")


# ------------------------------------------------------------------- what a run makes of damage


def break_file(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_the_last_good_checkpoint_is_offered_and_nothing_touched(copied, options):
    break_file(copied / "checkpoint-4.pt")
    before = contents(copied)
    with pytest.raises(CheckpointError, match=r"damaged.*--resume \S*checkpoint-2\.pt"):
        training.resume(copied, options, trials=6)
    assert contents(copied) == before


def test_the_offer_can_be_taken_and_leads_to_the_same_end(copied, run, options, same_run):
    break_file(copied / "checkpoint-4.pt")
    damaged = (copied / "checkpoint-4.pt").read_bytes()
    training.resume(copied / "checkpoint-2.pt", options)
    same_run(copied, run)
    assert (copied / "checkpoint-4.pt.unused").read_bytes() == damaged
    assert (copied / "trials.csv.unused").exists()


def test_without_a_good_checkpoint_nothing_is_touched(copied, options):
    for path in checkpoint.checkpoints(copied):
        break_file(path)
    before = contents(copied)
    with pytest.raises(
        CheckpointError, match=r"no checkpoint to go on from \(.*damaged.*differs\)\)$"
    ):
        training.resume(copied, options, trials=6)
    assert contents(copied) == before


@pytest.fixture(scope="module")
def unusable(run, state, tmp_path_factory):
    """Files that are no checkpoint for the run, and what the refusal says."""
    place = tmp_path_factory.mktemp("unusable")
    data = (run / "checkpoint-4.pt").read_bytes()
    (place / "truncated").write_bytes(data[:-1])
    (place / "empty").write_bytes(b"")
    torch.save({"model": torch.zeros(3)}, place / "foreign")
    rewrite(place / "future", state, version=checkpoint.VERSION + 1)
    rewrite(
        place / "other shapes",
        edited(state, ("agent", "net", "blocks.centres.0"), torch.zeros(2, 2)),
    )
    other = training.train(settings(net={"theta": 0.5}), quick_options(place / "other"))
    shutil.copy(other / "checkpoint-4.pt", place / "other settings")
    return place


@pytest.mark.parametrize(
    "kind,message",
    [
        ("truncated", "damaged or cut off"),
        ("empty", "not a checkpoint of sofnn-torch"),
        ("foreign", "not a checkpoint of sofnn-torch"),
        ("future", "update sofnn-torch"),
        ("other shapes", "does not fit its settings"),
        ("other settings", "other settings (net.theta 0.5, here 0.4)"),
    ],
)
def test_an_unusable_file_gets_one_line_that_offers_the_last_good_one(
    kind, message, unusable, copied, capsys
):
    shutil.copy(unusable / kind, copied / "checkpoint-6.pt")
    before = contents(copied)
    assert main(["--resume", str(copied), "--trials", "9", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and message in line
    assert f"--resume {copied / 'checkpoint-4.pt'}" in line
    assert contents(copied) == before


def test_a_lone_checkpoint_goes_on_in_a_new_run(run, options, tmp_path):
    lone = tmp_path / "lone.pt"
    shutil.copy(run / "checkpoint-2.pt", lone)
    goes_on = training.resume(lone, options)
    ours, theirs = (checkpoint.find_latest(path)[1] for path in (goes_on, run))
    assert equal(ours, theirs)


# --------------------------------------------------------------------------- writing and reading


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file(failing, state, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint-1.pt"
    checkpoint.save(path, state)
    before = contents(tmp_path)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, failing, fail)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(path, state | {"trial": 99})
    assert contents(tmp_path) == before


def test_a_file_is_on_the_disk_before_it_takes_its_name(state, tmp_path, monkeypatch):
    path, calls = tmp_path / "checkpoint-1.pt", []
    real = {name: getattr(os, name) for name in ("fsync", "replace")}

    def fsync(descriptor):
        calls.append(("fsync", os.path.samestat(os.fstat(descriptor), os.stat(tmp_path))))
        real["fsync"](descriptor)

    def replace(source, target):
        assert not path.exists() and checkpoint.load(source)
        calls.append(("replace", target == path))
        real["replace"](source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    checkpoint.save(path, state)
    assert calls == [("fsync", False), ("replace", True), ("fsync", True)]  # True: the directory


def rewound(directory, state, data):
    """The lines of a trial table that are left after going back to a state."""
    with Run.create([directory / "run"], settings(), keep=3) as run:
        (run.path / "trials.csv").write_bytes(data)
        run.rewind(state)
    run.close()
    return run.rows


@pytest.mark.parametrize(
    "data,left",
    [
        (b"trial,x\n1,a\n2,b\n3,c\n4,d\n5,e\n6,f\n", "trial,x 1,a 2,b 3,c 4,d"),
        (b"trial,x\n1,a\n2,b\n3,c\n4,d\n5,e", "trial,x 1,a 2,b 3,c 4,d"),
        (b"trial,x\n1,a\n2,b\n3,c\n4,d", "trial,x 1,a 2,b 3,c"),
        (b"trial,x\n0,z\n-1,y\n1,a\nx,1\n\n10,k\n3,c\n", "trial,x 1,a 3,c"),
        (b"trial,x\n1,\xff\n", "trial,x 1,\ufffd"),
        (b"trial,x", ""),
        (b"", ""),
    ],
    ids=["newer", "torn", "last torn", "foreign", "not text", "torn header", "empty"],
)
def test_the_whole_lines_of_the_trials_of_a_state_are_left(data, left, state, tmp_path, capsys):
    rows = rewound(tmp_path, state, data)
    assert rows == [f"{row}\n" for row in left.split()]
    assert ("lacks trials" in capsys.readouterr().err) == (
        rows[1:] != ["1,a\n", "2,b\n", "3,c\n", "4,d\n"]
    )
    table = tmp_path / "run" / "trials.csv"
    assert table.read_text() == "".join(rows) if rows else table.read_bytes() == data


@trials_of(max_examples=50, deadline=None)
@given(st.binary(max_size=400))
def test_of_any_trial_table_only_whole_lines_of_known_trials_are_left(state, data):
    import tempfile

    with tempfile.TemporaryDirectory() as place:
        rows = rewound(Path(place), state, data)
    whole = iter(data.decode(errors="replace").splitlines(keepends=True))
    assert all(row in whole and row.endswith("\n") for row in rows)  # in their order
    assert all(int(row.partition(",")[0]) in (1, 2, 3, 4) for row in rows[1:])


# ------------------------------------------------------------------- links, modes and small bombs


def test_a_symbolic_link_stays_one(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "link"
    link.symlink_to("disk/file")  # which is not there yet
    for data in (b"old", b"new"):
        checkpoint.write_atomically(link, data)
        assert link.is_symlink() and (tmp_path / "disk" / "file").read_bytes() == data
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["disk", "file", "link"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_a_file_that_is_rewritten_keeps_its_mode(mode, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    path.chmod(mode)
    checkpoint.write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and stat.S_IMODE(path.stat().st_mode) == mode


def test_a_new_file_has_the_usual_mode(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    checkpoint.write_atomically(tmp_path / "new", b"")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("usual", "new")]
    assert modes[0] == modes[1]


def test_a_device_is_written_to(tmp_path):
    (tmp_path / "nothing").symlink_to(os.devnull)
    checkpoint.write_atomically(tmp_path / "nothing", b"data")
    assert (tmp_path / "nothing").is_char_device()


def test_a_name_of_the_greatest_length_can_be_written(tmp_path):
    checkpoint.write_atomically(tmp_path / ("x" * 255), b"data")
    assert [len(path.name) for path in tmp_path.iterdir()] == [255]


def enclosed(payload):
    """A file with a right checksum around a payload."""
    digest = checkpoint._digest(checkpoint.VERSION, payload)
    return b"sofnn-torch checkpoint %d %s\n" % (checkpoint.VERSION, digest) + payload


def saved(content):
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def zipped(payload, **style):
    """The same archive, packed otherwise."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(payload)) as old, zipfile.ZipFile(buffer, "w", **style) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    return buffer.getvalue()


def nested():
    """A list of a thousand lists, each of a thousand ..., that is written once at each level."""
    part = [0] * 1000
    for _ in range(8):
        part = [part] * 1000
    return part


class Reserved:
    """Bytes that reading makes, not writing."""

    def __reduce__(self):
        return bytearray, (2**29,)


def sparse(size):
    return torch.sparse_coo_tensor([[0]], [1.0], (size,), check_invariants=True)


MIB = 2**20
BOMBS = {
    "stride 0": lambda state: saved(state | {"agent": {"x": torch.zeros(1).expand(500 * MIB)}}),
    "overlapping": lambda state: saved(
        state | {"agent": {"x": torch.zeros(20_000).as_strided((10_000, 10_000), (1, 1))}}
    ),
    "packed": lambda state: zipped(
        saved(state | {"agent": {"x": torch.zeros(20 * MIB)}}), compression=zipfile.ZIP_DEFLATED
    ),
    "nested": lambda state: saved(state | {"agent": {"x": nested()}}),
    "bytes": lambda state: saved(state | {"agent": {"x": Reserved()}}),
    "sparse": lambda state: saved(state | {"agent": {"x": sparse(500 * MIB)}}),
    "elsewhere": lambda state: saved(
        state | {"agent": {"x": torch.empty(500 * MIB, device="meta")}}
    ),
    "one part for many": lambda state: saved(
        state
        | {"recent": [torch.zeros(10_000)] + [None], "agent": {}}
        | {"best": [part for part in [torch.zeros(10_000)] for _ in range(20_000)]}
    ),
}


def peak_of_loading(path, answer):
    """In a process of its own: what is said about a file, and the memory that it took."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        state = checkpoint.load(path)
        config = settings()
        checkpoint.restore(path, state, make_agent(config), make_env(config))
        said = "loaded"
    except CheckpointError as error:
        said = str(error)
    unit = 1 if sys.platform == "darwin" else 1024
    answer.put((said, unit * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)))


@pytest.mark.parametrize("kind", [*BOMBS, "enormous"])
def test_a_small_hostile_file_takes_no_memory(kind, state, tmp_path):
    path = tmp_path / "bomb.pt"
    if kind == "enormous":  # on the disk it is small
        path.write_bytes(enclosed(b""))
        os.truncate(path, 2**40)
    else:
        path.write_bytes(enclosed(BOMBS[kind](state)))
        assert path.stat().st_size < 2 * MIB
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sofnn_torch.training"])
    answer = context.SimpleQueue()
    child = context.Process(target=peak_of_loading, args=(path, answer))
    child.start()
    said, peak = answer.get()
    child.join()
    assert said.startswith(f"{path}: ") and "\n" not in said
    assert peak < 60 * MIB
