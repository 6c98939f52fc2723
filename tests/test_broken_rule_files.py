"""Rule files that editors, slips and chance have broken: refused with one clear line."""

import copy
import csv
import io
import json
import math

import numpy as np
import pytest
from conftest import SLOW, contents, parameters, written
from hypothesis import given
from hypothesis import settings as trials_of
from hypothesis import strategies as st

from sofnn_torch.evaluate import Loaded
from sofnn_torch.rules import editing
from sofnn_torch.runs import rule_files

STATE = np.float32([0.5, 0.5, 0.0])

BAD_JSON = {
    "json": ("{", "not JSON"),
    "list": ("[]", 'not a rule file: "format" must be "sofnn-torch rules"'),
    "format": ({"format": "rules"}, "not a rule file"),
    "newer": ({"version": 2}, "version 2, this program reads version 1"),
    "version": ({"version": True}, "version true"),
    "agent": ({"agent": "q"}, 'agent must be "sga" for this run'),
    "inputs": ({"inputs": ["x", "y"]}, "inputs must be"),
    "outputs": ({"outputs": ["mu"]}, 'outputs must be ["mu", "sigma", "value"]'),
    "rules": ({"rules": 3}, "rules must be a list, got 3"),
    "none": ({"rules": []}, "0 rules, must be 1 to 60"),
    "many": (lambda r: r.extend(r[:1] * 60), "more than 60 rules, must be 1 to 60"),
    "rule": (lambda r: r.insert(1, None), "rule 2: must be an object, got null"),
    "missing": (
        lambda r: r[1].pop("width"),
        "rule 2, width: must be a list of 3 numbers, got null",
    ),
    "short": (lambda r: r[1]["centre"].pop(), "rule 2, centre: must be a list of 3 numbers, got 2"),
    "text": (lambda r: put(r, "centre", "1"), 'rule 3, centre_y_m: must be a number, got "1"'),
    "true": (lambda r: put(r, "centre", True), "rule 3, centre_y_m: must be a number, got true"),
    "nan": (lambda r: put(r, "consequents", math.nan), "rule 3, sigma: must lie between 0.1 and 1"),
    "inf": (lambda r: put(r, "centre", math.inf), "centre_y_m: must lie between -100 and 100, got"),
    "huge": (lambda r: put(r, "centre", 10**400), "rule 3, centre_y_m: must lie between"),
    "width": (lambda r: put(r, "width", 0.0), "rule 3, width_y_m: must lie between 0.001 and 3"),
    "wide": (lambda r: put(r, "width", 3.1), "rule 3, width_y_m: must lie between 0.001 and 3"),
    "degrees": (lambda r: put(r, "centre", 90, 2), "rule 3, centre_heading_rad: must lie between"),
    "mu": (lambda r: put(r, "consequents", 1.01, 0), "rule 3, mu: must lie between -1 and 1"),
    "sigma": (lambda r: put(r, "consequents", 0.05), "rule 3, sigma: must lie between 0.1 and 1"),
    "value": (lambda r: put(r, "consequents", 1e10, 2), "rule 3, value: must lie between -1e+09"),
    "deep": ("[" * 3_000, "nested too deeply"),
    "open": ("[" * 100_000, "more than"),
    "twice": ('{"format": "sofnn-torch rules", "version": 1, "version": 1', "not JSON"),
    "large": (" " * 3_000_000, "larger than"),
    "bytes": (b"\xff\xfe{", "not a text file (damaged UTF-16)"),
    "surrogate": (b"\xff\xfe\x00\xd8{\x00", "not a text file (damaged UTF-16)"),
    "no mark": ("{}".encode("utf-16-le"), "not a text file (it has a character U+0000)"),
    "comma": ('{"format": "sofnn-torch rules",}', "not JSON"),
    "comment": ('{"version": 1 /* newest */}', "not JSON"),
    "plus": ('{"version": +1}', "not JSON"),
    "hex": ('{"version": 0x1}', "not JSON"),
    "digits": ('{"version": \u0661}', "not JSON"),
    "underscore": ('{"version": 1_0}', "not JSON"),
    "lone": ({"agent": "\ud800"}, 'agent must be "sga" for this run'),
    "lone cell": (lambda r: put(r, "centre", "\ud800"), 'must be a number, got "\\ud800"'),
    "-inf": (lambda r: put(r, "centre", -math.inf), "centre_y_m: must lie between -100 and 100"),
}
BAD_CSV = {
    "empty": ("", "column centre_x_m is missing"),
    "binary": (b"\x89PNG\r\n\x1a\n", "not a text file (it has a character U+001A)"),
    "workbook": (b"PK\x03\x04", "not a text file (it has a character U+0003)"),
    "bars": (lambda text: text.replace(",", "|"), 'missing; the first line is "rule|centre_x_m'),
    "points": (
        lambda text: text.replace(",", ";").replace("0.06", "0,06", 1),
        'rule 1, width_x_m: must be a number, got "0,06" (a decimal comma or a thousands',
    ),
    "column": (lambda text: text.replace("width_y_m", "width"), "column width_y_m is missing"),
    "twice": (lambda text: text.replace("rule", "mu", 1), "column mu is there twice"),
    "no rules": (lambda text: text.splitlines()[0], "0 rules, must be 1 to 60"),
    "cells": (lambda text: text + "1,2\n", "2 cells, the first line has"),
    "unquoted comma": (
        lambda text: text.replace("0.06", "0,06", 1),
        "rule 1: 12 cells, the first line has 11",
    ),
    "word": (
        lambda text: text.replace("0.06", "wide", 1),
        "rule 1, width_x_m: must be a number, got",
    ),
    "nan": (
        lambda text: text.replace("0.06", "nan", 1),
        'rule 1, width_x_m: must be a number, got "nan"',
    ),
    "quote": (lambda text: text + '1,"2', "not CSV"),
}


def put(listed, field, value, place=1):
    listed[2][field][place] = value


@pytest.mark.parametrize(
    ("suffix", "name"),
    [*((".json", name) for name in BAD_JSON), *((".csv", name) for name in BAD_CSV)],
)
def test_a_bad_rule_file_gives_one_line_and_nothing_is_written(few, tmp_path, call, suffix, name):
    path, agent, *_ = few
    change, message = (BAD_JSON if suffix == ".json" else BAD_CSV)[name]
    file = written(agent, tmp_path / f"rules{suffix}")
    text = file.read_text()
    if isinstance(change, dict):
        change = json.dumps(json.loads(text) | change)
    elif callable(change) and suffix == ".json":
        data = json.loads(text)
        change(data["rules"])
        change = json.dumps(data)
    elif callable(change):
        change = change(text)
    file.write_bytes(change if isinstance(change, bytes) else change.encode())
    before = contents(path.parent)
    code, printed, error = call(path, "--load", file)
    assert code == 2 and not printed
    (line,) = error.splitlines()
    assert line.startswith(f"error: {file}: ") and message in line and len(line) < 300
    assert contents(path.parent) == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("number", ["1e999", "-1e999", "Infinity", "NaN", "9" * 5000])
def test_numbers_beyond_all_doubles_are_refused(few, tmp_path, number):
    file = written(few[1], tmp_path / "rules.json")
    file.write_text(file.read_text().replace("0.06", number, 1))
    with pytest.raises(ValueError, match=r"rule 1, width_x_m: must lie between 0.001 and 3, got"):
        rule_files.read(file, rule_files.schema(few[1]))


def test_names_that_an_object_has_twice_are_refused(few, tmp_path):
    _, agent, *_ = few
    file = written(agent, tmp_path / "rules.json")
    text, kind = file.read_text(), rule_files.schema(agent)
    file.write_text(text.replace('"usage"', '"width": [1, 1, 1], "usage"', 1))
    with pytest.raises(ValueError, match=r'rules.json: rule 1: "width" is there twice'):
        rule_files.read(file, kind)
    file.write_text(text.replace('"version"', '"agent": "sga", "version"', 1))
    with pytest.raises(ValueError, match=r'rules.json: "agent" is there twice'):
        rule_files.read(file, kind)


# ------------------------------------------------------------------------------------------ fuzz


class Accepted(Exception):
    """A rule file passed every check."""


JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.text(max_size=8)
    | st.sampled_from([10**400, -(10**60), 1e39, 3.5e38, 1e-50, -0.0, "NaN", "0.1", "sga"]),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)
SNIPPETS = st.sampled_from(
    [b"NaN", b"-Infinity", b"1e999", b"9" * 5000, b"-", b"\xff\xfe", b"\x00", b'"', b"\\", b"\n"]
    + [b",", b",,", b";", b"{", b"}", b"[", b"]", b"[" * 60_000, b'{"a":' * 20_000, b"\r", b"1_0"]
    + ["\u2028".encode(), "\ufeff".encode(), b'"rules": [],', b'"version": 1,', b"true", b"\\ud800"]
) | st.binary(max_size=6)


def places(data, path=()):
    """Paths to everything inside a JSON document."""
    inside = (
        data.items()
        if isinstance(data, dict)
        else enumerate(data)
        if isinstance(data, list)
        else ()
    )
    for key, value in inside:
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def broken_json(draw, text):
    data = json.loads(text)
    for _ in range(draw(st.integers(0, 3))):
        *parents, last = draw(st.sampled_from(list(places(data))))
        at = data
        for key in parents:
            at = at[key]
        what = draw(st.sampled_from(["replace", "replace", "drop", "number", "copy"]))
        if what == "drop":
            del at[last]
        elif what == "copy" and isinstance(at, list):
            at.insert(last, at[last])
        else:
            at[last] = draw(st.floats(-1.2, 1.2) if what == "number" else JUNK)
        if not data:
            break
    return json.dumps(data).encode()


@st.composite
def broken_csv(draw, text):
    lines = list(csv.reader(io.StringIO(text)))
    for _ in range(draw(st.integers(0, 3))):
        line = draw(st.sampled_from(lines))
        place = draw(st.integers(0, max(len(line) - 1, 0)))
        what = draw(st.sampled_from(["replace", "number", "drop", "insert", "line"]))
        if what == "line":
            lines.insert(draw(st.integers(0, len(lines))), list(line))
        elif what == "drop":
            del line[place : place + 1]
        else:
            cell = str(draw(st.floats(-1.2, 1.2) if what == "number" else JUNK))
            line[place : place + (what != "insert")] = [cell]
    made = io.StringIO()
    csv.writer(made).writerows(lines)
    return made.getvalue().encode(errors="surrogatepass")


@st.composite
def broken(draw, kind, text):
    """A rule file with changes to what it says, and to its bytes."""
    data = draw((broken_json if kind == ".json" else broken_csv)(text))
    for _ in range(draw(st.sampled_from([0, 0, 0, 1, 2]))):
        at = draw(st.integers(0, len(data)))
        what = draw(st.sampled_from(["cut", "insert", "overwrite", "repeat"]))
        if what == "cut":
            data = data[:at]
        elif what == "repeat":
            data = data[:at] + data[draw(st.integers(0, at)) :]
        else:
            piece = draw(SNIPPETS)
            data = data[:at] + piece + data[at + len(piece) * (what == "overwrite") :]
    return data


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_broken_files_load_whole_or_not_at_all(few, tmp_path, monkeypatch, suffix):
    path, agent, file, state, config = few
    rule_file = tmp_path / f"rules{suffix}"
    text = written(agent, rule_file, parameters(agent)[:3]).read_text()
    before, outcomes = contents(path.parent), {"accepted": 0, "refused": 0}
    agent, kind = copy.deepcopy(agent), rule_files.schema(agent)

    def create(*_):
        raise Accepted

    monkeypatch.setattr(editing.Run, "create", create)

    @trials_of(max_examples=150, deadline=None, database=None, suppress_health_check=SLOW)
    @given(broken(suffix, text))
    def attempt(data):
        rule_file.write_bytes(data)
        try:
            editing.edited(path, Loaded(config, agent, file, state), rule_file)
        except Accepted:
            outcomes["accepted"] += 1
            table = parameters(agent)
            assert ((kind.low <= table) & (table <= kind.high)).all()
            assert 1 <= agent.net.n_rules <= 60
            assert agent.act(STATE) in (0, 1, 2)
        except ValueError as error:
            outcomes["refused"] += 1
            assert str(error).startswith(f"{rule_file}: ")
            assert len(str(error).splitlines()) == 1 and len(str(error)) < 400

    attempt()
    assert outcomes["accepted"] and outcomes["refused"] > 30, outcomes
    assert contents(path.parent) == before
    assert [p.name for p in tmp_path.iterdir()] == [rule_file.name]
