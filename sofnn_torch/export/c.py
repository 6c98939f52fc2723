"""C headers of a policy: float with math.h, or 16-bit whole numbers without any library."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.export import fixed, templates
from sofnn_torch.export.runtime import Policy
from sofnn_torch.runs.guard import LARGEST
from sofnn_torch.runs.rule_files import shortest

HEAD = re.compile(r"/\* sofnn-torch policy (\{.*\}) \*/")
CENTRES = re.compile(r"_centres\[[^\]]+\]\[[^\]]+\](?: \w+)? = \{(.*?)\n\};", re.DOTALL)
TABLE = re.compile(r"_rules\[[^\]]+\]\[[^\]]+\](?: \w+)? = \{(.*?)\n\};", re.DOTALL)
GAINS = re.compile(r"_gains\[[^\]]+\]\[[^\]]+\](?: \w+)? = \{(.*?)\n\};", re.DOTALL)
NUMBER = re.compile(r"-?\d[\d.]*(?:e[+-]?\d+)?")
MOST_BYTES = 2**28
OWN = ("scales", "bits", "shift", "ends")  # of a policy in whole numbers
SCALED = {  # by the bits of a gain
    8: """\
                own = NAME_BYTE(g++);
                r = NAME_product((uint16_t)(d << 1), (uint8_t)(32u + (own >> 3)));
                r >>= (uint8_t)(@SHIFT@ + (own & 7u));""",
    16: """\
                r = NAME_product((uint16_t)(d << 1), NAME_READ(g++)) >> @SHIFT@;""",
}


def to_header(data: dict[str, Any], path: Path, precision: str) -> bytes:
    """The header of a policy; its functions and names begin with that of the file.

    Args:
        data: the neutral policy, or what `from_header` read.
        path: where it will stand.
        precision: ``float`` or ``int16``.

    Raises:
        ValueError: 16 bits cannot hold the policy.
    """
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    name = f"_{name}" if name[:1].isdigit() else name
    if data["discrete"] and len(data["actions"]) == 1:
        raise ValueError("there is but one action: nothing is left to decide")
    if "fixed" in data or precision == "int16":
        text = _fixed(name, data["fixed"] if "fixed" in data else fixed.make(data))
    else:
        text = _float(name, data)
    return text.encode()


def from_header(path: Path) -> dict[str, Any]:
    """The policy in a header that `to_header` wrote.

    That of one in whole numbers has the entry ``fixed``, a `FixedPolicy`, in place of rules.

    Raises:
        ValueError: one line on what is wrong with it.
    """
    try:
        with open(path, "rb") as file:
            text = file.read(MOST_BYTES).decode()
        head, table = HEAD.search(text), TABLE.search(text)
        if not head or not table or "#endif" not in text[table.end() :]:
            raise ValueError("not a header of this program, or not all of it")
        data = json.loads(head[1])
        rows = _numbers(table[1])
        if "scales" in data:
            others = (table.search(text) for table in (CENTRES, GAINS))
            centres, gains = (_numbers(found[1] if found else "") for found in others)
            return _fixed_from(data, *map(np.array, (centres, gains, rows)))
        data["rules"] = _rules(data, rows)
        return Policy(data).data
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None


def _numbers(table: str) -> list[list[float]]:
    """Rows of a table in C."""
    lines = re.findall(r"\{(.*?)\}", table)
    rows = [[float(number) for number in NUMBER.findall(line)] for line in lines]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("rules of different lengths, or none")
    return rows


def _rules(data: dict[str, Any], rows: list[list[float]]) -> list[dict[str, list[float]]]:
    n = len(data["axes"]) + bool(data["decision"].get("action_input"))
    if len(rows[0]) != 2 * n + len(data["outputs"]) or max(map(max, rows)) > LARGEST:
        raise ValueError("its rules are not those of its inputs and outputs")
    table = shortest(np.array(rows, data["precision"])).tolist()
    parts = ((row[:n], row[n : 2 * n], row[2 * n :]) for row in table)
    return [{"centre": u, "width": v, "consequents": c} for u, v, c in parts]


def _fixed_from(data: dict[str, Any], centres: Any, gains: Any, concluded: Any) -> dict[str, Any]:
    """A policy in whole numbers from its head, and tables as in `FixedPolicy`."""
    own = {name: data.pop(name) for name in OWN}
    n = len(own["scales"])
    wanted = {"normal": data["decision"].get("numbers")}
    wanted["values"] = len(data["decision"].get("codes", []))
    columns = [table.shape[1] for table in (centres, gains, concluded)]
    if columns != [n, n, wanted[data["decision"]["kind"]]] or len(centres) != len(concluded):
        raise ValueError("its rules are not those of its inputs and outputs")
    if len(gains) not in (1, len(centres)):
        raise ValueError(f"{len(centres)} rules have {len(gains)} rows of gains")
    for table, bits in ((centres, own["bits"]), (gains, own["bits"]), (concluded, 8)):
        if table.min() < 0 or table.max() >= 2**bits:
            raise ValueError(f"numbers of its rules need more than {bits} bits")
    tables = [table.astype(np.uint32) for table in (centres, gains, concluded)]
    return {**data, "fixed": fixed.FixedPolicy(data, *own.values(), *tables)}


def _comment(data: dict[str, Any]) -> str:
    """The head of a policy in a comment that no text in it can end."""
    text = json.dumps(data).replace("/", "\\u002f").replace("?", "\\u003f")
    return f"/* sofnn-torch policy {text} */"


def _plain(text: str) -> str:
    """Text for a comment."""
    return re.sub(r"[^\w .,+-]", "_", text, flags=re.ASCII)


def _rows(table: Any, form: Callable[[Any], str] = str) -> str:
    lines = (", ".join(map(form, row)) for row in table.tolist())
    return ",\n".join(f"    {{{line}}}" for line in lines)


def _action_names(data: dict[str, Any]) -> list[str]:
    if data["discrete"]:
        names = [f"{j} {_plain(name)}" for j, name in enumerate(data["actions"])]
        return ["the number of an action: " + ", ".join(names)]
    return [f"action[{j}], {_plain(name)}" for j, name in enumerate(data["actions"])]


def _float(name: str, data: dict[str, Any]) -> str:
    policy = Policy(data)
    axes = data["axes"]
    about = []
    for i, axis in enumerate(axes):
        wraps = f", wraps after {axis['period']:.9g}" if axis["period"] else ""
        about.append(f"x[{i}]: {_plain(axis['name'])} {_plain(axis['unit'])}".rstrip() + wraps)
    about += (
        _action_names(data)
        if data["discrete"]
        else [f"{line}, from -1 to 1" for line in _action_names(data)]
    )
    table = np.hstack([policy.centres, policy.widths, policy.consequents]).astype(np.float32)
    decision = data["decision"]
    kind = "values" if decision["kind"] == "values" else "normal"
    action = "discrete" if data["discrete"] else "continuous"
    limits = [
        (i, low, high)
        for i, (low, high) in enumerate(zip(policy.low, policy.high, strict=True))
        if np.isfinite([low, high]).any()
    ]
    clip = [
        line
        for i, low, high in limits
        for line in (
            f"    if (x[{i}] < {_c(low)}) state[{i}] = {_c(low)};" * bool(np.isfinite(low)),
            f"    if (x[{i}] > {_c(high)}) state[{i}] = {_c(high)};" * bool(np.isfinite(high)),
        )
        if line
    ]
    periods = [(i, p) for i, p in enumerate(policy.periods.tolist()) if p]
    wrap = [
        f"            if (i == {i}) d -= {_c(p)} * floorf(d / {_c(p)} + 0.5f);" for i, p in periods
    ]
    values = {
        "NAME": name,
        "GUARD": f"{name.upper()}_H",
        "HEAD": _comment({k: v for k, v in data.items() if k != "rules"}),
        "ABOUT": "\n".join(f" *     {line}" for line in about),
        "STATE": str(len(axes)),
        "INPUTS": str(len(policy.periods)),
        "RULES": str(len(table)),
        "OUTPUTS": str(len(data["outputs"])),
        "NUMBERS": str(decision.get("numbers", 1)),
        "CHOICES": str(len(policy.codes)),
        "CODE": str(policy.codes.shape[-1]),
        "CLIP": "\n".join(clip),
        "WRAP": "\n".join(wrap),
        "TABLE": _rows(table, _c),
        "CODES": _rows(policy.codes, _c) if kind == "values" else "",
        "EDGES": ", ".join(_c(e) for e in decision["edges"] or []) if kind == "normal" else "",
        "EDGE_COUNT": str(len(decision["edges"] or [])),
        "POINTS": ", ".join(map(_c, decision.get("representatives", []))),
    }
    acting = kind == "values" and policy.acting
    body = templates.FLOAT_ACTING if acting else templates.FLOAT_VALUES
    parts = [templates.FLOAT, body if kind == "values" else "", templates.FLOAT_ACTS[kind, action]]
    return _fill("".join(parts) + templates.END, values)


def _c(number: float) -> str:
    """A number as a float of C."""
    text = f"{number:.9g}"
    return text + ("f" if re.search(r"[.e]", text) else ".0f")


def _fixed(name: str, policy: fixed.FixedPolicy) -> str:
    data, n = policy.head, policy.n
    about, clamp = [], []
    for i, (axis, (origin, step)) in enumerate(zip(data["axes"], policy.scales, strict=False)):
        what, unit = _plain(axis["name"]), _plain(axis["unit"])
        most = "65535, wraps by itself" if axis["period"] else "32767"
        scale = f"({what} - ({origin:.9g} {unit})) / ({step:.9g} {unit}), 0 to {most}"
        about.append(f"x[{i}]: {scale}")
    about += _action_names(data)
    if not data["discrete"] and data["decision"]["kind"] == "normal":
        low, high = policy.ends
        if low:  # otherwise nothing is beyond
            clamp = [f"        if (action[j] < {low}u) action[j] = {low}u;"]
            clamp += [f"        if (action[j] > {high}u) action[j] = {high}u;"]
        about.append(f"where {low} is -1 and {high} is 1")
    own = {name: getattr(policy, name) for name in OWN}
    kind = "acting" if policy.acting else data["decision"]["kind"]
    action = "discrete" if data["discrete"] else "continuous"
    a, b, c = fixed.CUBIC
    values = {
        "NAME": name,
        "GUARD": f"{name.upper()}_H",
        "HEAD": _comment({**data, **own}),
        "ABOUT": "\n".join(f" *     {line}" for line in about),
        "STATE": str(len(data["axes"])),
        "INPUTS": str(n),
        "RULES": str(len(policy.centres)),
        "SUMS": "1" if policy.acting else str(policy.conclusions),
        "CONCLUSIONS": str(policy.conclusions),
        "CENTRES": _rows(policy.centres),
        "TABLE": _rows(policy.concluded),
        "GAINS": _rows(policy.gains),
        "GAIN_ROWS": str(len(policy.gains)),
        "BITS": str(policy.bits),
        "CENTRE": "(uint16_t)((uint16_t)NAME_BYTE(p++) << 8)"
        if policy.bits == 8
        else "NAME_READ(p++)",
        "SAME_GAINS": f"            g -= {n};" * (len(policy.gains) == 1),
        "OWN": "                uint8_t own;" * (policy.bits == 8),
        "FIRST": " + first" * policy.acting,
        "ARGUMENT": ", uint16_t first" * policy.acting,
        "SHIFT": str(policy.shift),
        "MOST": f"{policy.most}u",
        "A": f"{a}u",
        "B": f"{b}u",
        "C": f"{c}u",
        "ENDS": ", ".join(f"{e}u" for e in policy.ends),
        "ENDS_COUNT": str(len(policy.ends)),
        "CLAMP": "\n".join(clamp),
        "INDEX": "uint8_t" if policy.conclusions < 256 else "uint16_t",
        "CODES": ", ".join(f"{code}u" for code in policy.codes) if policy.acting else "",
        "POINTS": ", ".join(map(_c, data["decision"].get("representatives", []))),
    }
    text = templates.FIXED.replace("@SCALED@", SCALED[policy.bits])
    return _fill(text + templates.FIXED_ACTS[kind, action] + templates.END, values)


def _fill(text: str, values: dict[str, str]) -> str:
    """A template with its @PLACES@ filled, and NAME for the prefix of all names."""
    text = re.sub(r"@([A-Z_]+)@\n?", lambda m: _inserted(m, values), text)
    return re.sub(r"NAME_(?=[A-Z]+\b)", f"{values['NAME'].upper()}_", text).replace(
        "NAME_", f"{values['NAME']}_"
    )


def _inserted(match: re.Match[str], values: dict[str, str]) -> str:
    found = values[match[1]]
    return found + "\n" * (match[0].endswith("\n") and bool(found))
