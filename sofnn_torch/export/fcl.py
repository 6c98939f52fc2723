"""A policy as a function block of the Fuzzy Control Language (IEC 61131-7), and rules from one.

The standard has products and weighted averages of singletons (``COGS``), but draws its sets with
straight lines. Gaussian sets and linear conclusions are written as fuzzylite writes them (``TERM m1
:= Gaussian 0.5 0.1;``, ``Linear``), and read with jFuzzyLogic's ``gauss`` too.
"""

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

COMMENT = re.compile(r"\(\*.*?\*\)|//[^\n]*|^\s*#[^\n]*", re.DOTALL | re.MULTILINE)
BLOCK = re.compile(
    r"\b(VAR_INPUT|VAR_OUTPUT|FUZZIFY|DEFUZZIFY|RULEBLOCK)\b[ \t]*(\w*)(.*?)\bEND_(\w+)",
    re.DOTALL | re.IGNORECASE,
)
# Statements end with a semicolon or before the next one.
BEGIN = r"TERM|RULE|RANGE|METHOD|DEFAULT|AND|OR|ACT|ACCU|\w+\s*:"
END = re.compile(rf";|\n(?=\s*(?:{BEGIN})\b)", re.IGNORECASE)
RULE = re.compile(r"RULE (\w+) ?: ?IF (.+) THEN (.+?)(?: WITH ([\d.]+))?", re.IGNORECASE)
CLAUSE = re.compile(r"(\w+) IS (\w+)", re.IGNORECASE)
TERM = re.compile(r"TERM (\w+) ?:= ?(?:([A-Za-z]\w*) )?(.+)", re.IGNORECASE)
RANGE = re.compile(r"RANGE ?:= ?\( ?(\S+?) ?\.\. ?(\S+?) ?\)", re.IGNORECASE)


def to_fcl(data: dict[str, Any], *_options: Any) -> bytes:
    """The FCL file of a policy."""
    base = system(data)
    sets, terms, rules = vocabulary(base)
    n = len(base.inputs)
    names = base.names
    lines = ["FUNCTION_BLOCK policy", "", "VAR_INPUT", *(f"  {name}: REAL;" for name in names[:n])]
    lines += ["END_VAR", "", "VAR_OUTPUT", *(f"  {name}: REAL;" for name in names[n:]), "END_VAR"]
    for name, (_, low, high), found in zip(names, base.inputs, sets, strict=False):
        lines += ["", f"FUZZIFY {name}", f"  RANGE := ({low!r} .. {high!r});"]
        pairs = enumerate(found.tolist(), 1)
        lines += [f"  TERM m{k} := Gaussian {centre!r} {width!r};" for k, (width, centre) in pairs]
        lines.append("END_FUZZIFY")
    for name, found in zip(names[n:], terms, strict=True):
        low, high = span(found)
        lines += ["", f"DEFUZZIFY {name}", f"  RANGE := ({low!r} .. {high!r});"]
        linear = bool(found[:, :-1].any())
        for k, row in enumerate(found.tolist(), 1):
            shown = "Linear " + " ".join(map(repr, row)) if linear else repr(row[-1])
            lines.append(f"  TERM m{k} := {shown};")
        lines += ["  METHOD : COGS;", "  DEFAULT := 0.0;", "END_DEFUZZIFY"]
    lines += ["", "RULEBLOCK rules", "  AND : PROD;"]
    for number, row in enumerate(rules, 1):
        clauses = [f"{name} is m{k}" for name, k in zip(names, row, strict=True)]
        given, said = (" and ".join(part) for part in (clauses[:n], clauses[n:]))
        lines.append(f"  RULE {number} : if {given} then {said};")
    return "\n".join([*lines, "END_RULEBLOCK", "", "END_FUNCTION_BLOCK", ""]).encode()


def read(path: Path) -> Sugeno:
    """The rules of an FCL file of any tool, in the order in which it declares its variables.

    Raises:
        ValueError: one line on what is wrong, or cannot be held by Gaussian rules.
    """
    return read_with(_system, path)


def _system(text: str) -> Sugeno:
    text = COMMENT.sub(" ", text)
    if not re.search(r"\bEND_FUNCTION_BLOCK\s*$", text, re.IGNORECASE):
        raise ValueError("not an FCL file, or not all of it: END_FUNCTION_BLOCK is missing")
    found: dict[tuple[str, str], list[str]] = {}
    for match in BLOCK.finditer(text):
        kind = match[1].upper()
        name = match[2] if kind.endswith("FUZZIFY") else ""
        if kind.split("_")[0] != match[4].upper() or (kind, name) in found:
            raise ValueError(f"{kind} {match[2]}".rstrip() + " has no end, or stands there twice")
        lines = [" ".join(line.split()) for line in END.split(match[3])]
        found[kind, name] = [line for line in lines if line]
    inputs, outputs = (_declared(found["VAR_" + way, ""]) for way in ("INPUT", "OUTPUT"))
    ends, sets = zip(*(_input(name, found["FUZZIFY", name]) for name in inputs), strict=True)
    blocks = [found["DEFUZZIFY", name] for name in outputs]
    for kind, name in found:
        if name and name not in (inputs if kind == "FUZZIFY" else outputs):
            raise ValueError(f"{kind} {name} is of no variable that is declared")
    pairs = zip(outputs, blocks, strict=True)
    terms = [_output(name, lines, len(inputs)) for name, lines in pairs]
    rules = _rules(found["RULEBLOCK", ""], [*inputs, *outputs], len(inputs))
    for j, lines in enumerate(blocks):
        said = [conclusions[j] for _, conclusions in rules]
        if len(said) > len(set(said)) and any(line.upper().startswith("ACCU") for line in lines):
            raise ValueError(f"{outputs[j]}: ACCU joins rules of one conclusion, which add up here")
    return assembled(list(ends), outputs, list(sets), terms, rules)


def _declared(lines: list[str]) -> list[str]:
    matches = [re.fullmatch(r"(\w+) ?: ?REAL", line, re.IGNORECASE) for line in lines]
    if not all(matches):
        raise ValueError(f"{lines[matches.index(None)][:40]!r} declares no REAL")
    return [match[1] for match in matches if match]


def _input(name: str, lines: list[str]) -> tuple[tuple[str, float, float], dict[str, list[float]]]:
    sets: dict[str, list[float]] = {}
    low, high = None, None
    for line in lines:
        if match := RANGE.fullmatch(line):
            low, high = numbers([match[1], match[2]], 2, f"RANGE of {name}")
        elif (match := TERM.fullmatch(line)) and (match[2] or "").lower() in ("gaussian", "gauss"):
            centre, width = numbers(match[3].split(), 2, f"TERM {match[1]} of {name}")
            sets[match[1]] = [width, centre]
        else:
            raise ValueError(f"{name}: {line[:40]!r} is no Gaussian set: TERM a := Gaussian 0 1")
    if low is None or high is None:  # a range is an addition to the standard
        places = [c + side * 4 * v for v, c in sets.values() for side in (-1, 1)] or [0.0, 1.0]
        low, high = min(places), max(places)
    return (name, low, high), sets


def _output(name: str, lines: list[str], n: int) -> dict[str, list[float]]:
    terms: dict[str, list[float]] = {}
    method = ""
    for line in lines:
        match = TERM.fullmatch(line)
        kind = (match[2] or "constant").lower() if match else ""
        if match and kind in ("constant", "linear"):
            count = 1 if kind == "constant" else n + 1
            values = numbers(match[3].split(), count, f"TERM {match[1]} of {name}")
            terms[match[1]] = [0.0] * (n + 1 - count) + values
        elif match:
            raise ValueError(f"{name}: {line[:40]!r} is neither a number nor Linear")
        elif word := re.fullmatch(r"METHOD ?: ?(\w+)", line, re.IGNORECASE):
            method = word[1].upper()
        elif not re.match(r"(RANGE|DEFAULT|ACCU)\b", line, re.IGNORECASE):
            raise ValueError(f"{name}: {line[:40]!r} cannot be read")
    if method != "COGS":
        raise ValueError(f"{name}: METHOD must be COGS, as the network computes, not {method}")
    return terms


def _rules(lines: list[str], names: list[str], n: int) -> list[tuple[list[Any], list[Any]]]:
    rules, joined = [], "MIN"
    for line in lines:
        if word := re.fullmatch(r"AND ?: ?(\w+)", line, re.IGNORECASE):
            joined = word[1].upper()
            continue
        if re.fullmatch(r"(OR|ACT|ACCU) ?: ?\w+", line, re.IGNORECASE):
            continue
        parts = RULE.fullmatch(line)
        if not parts or float(parts[4] or 1) != 1:
            raise ValueError(
                f"{line[:60]!r} is no rule of weight 1: RULE 1 : IF x IS a THEN y IS b"
            )
        row: list[Any] = [None] * len(names)
        given, said = (
            re.split(r" and | ?, ?", part, flags=re.IGNORECASE) for part in parts.group(2, 3)
        )
        for i, clause in enumerate([*given, *said]):
            match = CLAUSE.fullmatch(clause.strip(" ()"))
            place = names.index(match[1]) if match and match[1] in names else -1
            if not match or place < 0 or (place < n) != (i < len(given)) or row[place] is not None:
                raise ValueError(f"rule {parts[1]}: {clause[:40]!r} is no set of a variable there")
            row[place] = match[2]
        if None in row[n:]:
            raise ValueError(f"rule {parts[1]}: it needs a conclusion for every output")
        rules.append((row[:n], row[n:]))
    if joined != "PROD" and any(n - row.count(None) > 1 for row, _ in rules):
        raise ValueError(f"AND must be PROD, as the network computes, not {joined}")
    return rules
