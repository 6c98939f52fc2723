"""A policy as a Sugeno system in a .fis file of MATLAB and Octave, and rules from such a file."""

import re
from pathlib import Path
from typing import Any

from sofnn_torch.export.sugeno import (
    Sugeno,
    assembled,
    numbers,
    read_with,
    span,
    system,
    vocabulary,
)

SECTION = re.compile(r"\[(system|input|output|rules)(\d*)\]", re.IGNORECASE)
MEMBERSHIP = re.compile(r"""['"](.*?)['"]\s*:\s*['"](\w+)['"]\s*,\s*\[(.*?)\]""")
WANTED = {"type": "sugeno", "andmethod": "prod", "defuzzmethod": "wtaver"}


def to_fis(data: dict[str, Any], *_options: Any) -> bytes:
    """The .fis file of a policy."""
    base = system(data)
    sets, terms, rules = vocabulary(base)
    lines = ["[System]", "Name='policy'", "Type='sugeno'", "Version=2.0"]
    lines += [f"NumInputs={len(base.inputs)}", f"NumOutputs={len(base.outputs)}"]
    lines += [f"NumRules={len(rules)}", "AndMethod='prod'", "OrMethod='probor'"]
    lines += ["ImpMethod='prod'", "AggMethod='sum'", "DefuzzMethod='wtaver'"]
    names = base.names
    n = len(base.inputs)
    for i, (_, low, high) in enumerate(base.inputs):
        lines += _variable(f"Input{i + 1}", names[i], low, high, "gaussmf", sets[i])
    for j, found in enumerate(terms):
        constant = not found[:, :-1].any()
        shown = found[:, -1:] if constant else found
        kind = "constant" if constant else "linear"
        lines += _variable(f"Output{j + 1}", names[n + j], *span(found), kind, shown)
    lines += ["", "[Rules]"]
    for row in rules:
        given, said = (" ".join(map(str, part)) for part in (row[:n], row[n:]))
        lines.append(f"{given}, {said} (1) : 1")
    return "\n".join([*lines, ""]).encode()


def _variable(section: str, name: str, low: float, high: float, kind: str, sets: Any) -> list[str]:
    head = ["", f"[{section}]", f"Name='{name}'", f"Range=[{float(low)!r} {float(high)!r}]"]
    rows = (" ".join(map(repr, row)) for row in sets.tolist())
    terms = [f"MF{i}='m{i}':'{kind}',[{row}]" for i, row in enumerate(rows, 1)]
    return [*head, f"NumMFs={len(sets)}", *terms]


def read(path: Path) -> Sugeno:
    """The rules of a .fis file of any tool.

    Raises:
        ValueError: one line on what is wrong, or cannot be held by Gaussian rules.
    """
    return read_with(lambda text: _system(_sections(text)), path)


def _sections(text: str) -> dict[str, Any]:
    """Entries by section, as in ``input1``, with names in small letters; of the rules the lines."""
    found: dict[str, Any] = {"rules": []}
    here: Any = {}
    for line in text.splitlines():
        line = line.strip()
        if head := SECTION.fullmatch(line):
            name = (head[1] + head[2]).lower()
            here = found["rules"] if name == "rules" else found.setdefault(name, {})
        elif not line or line[0] in "#%":
            continue
        elif isinstance(here, list):
            here.append(line)
        else:
            name, _, value = line.partition("=")
            here[name.strip().lower()] = value.strip()
    return found


def _system(found: dict[str, Any]) -> Sugeno:
    head = {name: value.strip("'\"").lower() for name, value in found["system"].items()}
    for name, wanted in WANTED.items():
        if head[name] != wanted:
            raise ValueError(f"{name} must be {wanted}, as the network computes, not {head[name]}")
    n, m = int(head["numinputs"]), int(head["numoutputs"])
    if int(head["numrules"]) != len(found["rules"]):
        raise ValueError(f"NumRules is {head['numrules']}, but {len(found['rules'])} rules follow")
    inputs, sets = zip(*(_input(found[f"input{i + 1}"]) for i in range(n)), strict=True)
    names, terms = zip(*(_output(found[f"output{j + 1}"], n) for j in range(m)), strict=True)
    rules: list[tuple[list[Any], list[Any]]] = []
    for number, line in enumerate(found["rules"], 1):
        parts = re.fullmatch(r"([\d\s-]+),([\d\s-]+)\(\s*([\d.]+)\s*\)\s*:\s*([12])", line)
        given = [int(word) for word in parts[1].split()] if parts else []
        said = [int(word) for word in parts[2].split()] if parts else []
        if not parts or (len(given), len(said)) != (n, m) or min(given) < 0 or min(said) < 1:
            raise ValueError(f"rule {number}: {line[:40]!r} is none of Gaussian sets joined by and")
        if float(parts[3]) != 1 or (parts[4] != "1" and sum(map(bool, given)) > 1):
            raise ValueError(f"rule {number}: only weight 1 and the connection 1 (and) are known")
        rules.append(([k or None for k in given], said))  # 0: a rule does not ask for the input
    return assembled(list(inputs), list(names), list(sets), list(terms), rules)


def _input(entries: dict[str, str]) -> tuple[tuple[str, float, float], dict[int, Any]]:
    low, high = numbers(_words(entries["range"].strip("[]")), 2, "Range")
    sets = {}
    for number, kind, text in _memberships(entries):
        if kind != "gaussmf":
            raise ValueError(f"{kind} is no Gaussian: draw its rules again with gaussmf")
        sets[number] = numbers(_words(text), 2, kind)
    return (entries["name"].strip("'\""), low, high), sets


def _output(entries: dict[str, str], n: int) -> tuple[str, dict[int, Any]]:
    terms = {}
    for number, kind, text in _memberships(entries):
        if kind not in ("constant", "linear"):
            raise ValueError(f"an output must be constant or linear, not {kind}")
        found = numbers(_words(text), 1 if kind == "constant" else n + 1, kind)
        terms[number] = [0.0] * (n + 1 - len(found)) + found
    return entries["name"].strip("'\""), terms


def _memberships(entries: dict[str, str]) -> list[tuple[int, str, str]]:
    count = int(entries["nummfs"])
    found = []
    for number in range(1, count + 1):
        parts = MEMBERSHIP.fullmatch(entries[f"mf{number}"])
        if not parts:
            raise ValueError(f"MF{number} cannot be read: {entries[f'mf{number}'][:40]!r}")
        found.append((number, parts[2], parts[3]))
    return found


def _words(text: str) -> list[str]:
    return text.replace(",", " ").split()
