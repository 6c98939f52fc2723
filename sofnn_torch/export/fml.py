"""A policy as a TSK system in the markup of IEEE 1855 (FML), and rules from such a file.

The standard knows Gaussian shapes (``param1`` the centre, ``param2`` the width), products, weighted
averages, and conclusions that are constant (order 0) or linear (order 1, the constant first).
"""

import xml.etree.ElementTree as xml
from pathlib import Path
from typing import Any

import numpy as np

from sofnn_torch.export.sugeno import (
    Sugeno,
    assembled,
    numbers,
    read_with,
    system,
    vocabulary,
)

SPACE = "http://www.ieee1855.org"


def to_fml(data: dict[str, Any], *_options: Any) -> bytes:
    """The FML file of a policy. Names in it are unique, as the standard asks."""
    base = system(data)
    sets, terms, rules = vocabulary(base)
    n = len(base.inputs)
    names = base.names
    root = xml.Element("fuzzySystem", xmlns=SPACE, name="sofnn.policy")
    knowledge = xml.SubElement(root, "knowledgeBase")
    for name, (_, low, high), found in zip(names, base.inputs, sets, strict=False):
        variable = xml.SubElement(knowledge, "fuzzyVariable", name=name, type="input")
        variable.attrib |= {"domainleft": repr(low), "domainright": repr(high)}
        for k, (width, centre) in enumerate(found.tolist(), 1):
            term = xml.SubElement(variable, "fuzzyTerm", name=f"{name}.{k}")
            xml.SubElement(term, "gaussianShape", param1=repr(centre), param2=repr(width))
    for name, found in zip(names[n:], terms, strict=True):
        variable = xml.SubElement(knowledge, "tskVariable", name=name, type="output")
        variable.set("combination", "WA")
        order = int(found[:, :-1].any())
        for k, row in enumerate(found.tolist(), 1):
            term = xml.SubElement(variable, "tskTerm", name=f"{name}.{k}", order=str(order))
            for value in (row[-1], *row[:-1]) if order else row[-1:]:
                xml.SubElement(term, "tskValue").text = repr(value)
    block = xml.SubElement(root, "tskRuleBase", name="sofnn.rules", andMethod="PROD")
    block.set("activationMethod", "PROD")
    for number, row in enumerate(rules, 1):
        rule = xml.SubElement(block, "tskRule", name=f"rule.{number}", connector="and")
        rule.set("andMethod", "PROD")
        given = xml.SubElement(rule, "antecedent")
        said = xml.SubElement(xml.SubElement(rule, "tskConsequent"), "tskThen")
        for i, (name, k) in enumerate(zip(names, row, strict=True)):
            clause = xml.SubElement(*((given, "clause") if i < n else (said, "tskClause")))
            xml.SubElement(clause, "variable").text = name
            xml.SubElement(clause, "term").text = f"{name}.{k}"
    xml.indent(root, " ")
    return xml.tostring(root, "UTF-8", xml_declaration=True) + b"\n"


def read(path: Path) -> Sugeno:
    """The rules of an FML file of any tool, in the order in which it declares its variables.

    Raises:
        ValueError: one line on what is wrong, or cannot be held by Gaussian rules.
    """
    return read_with(_system, path)


def _system(text: str) -> Sugeno:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("an FML file has no document type and no entities of its own")
    try:
        root = xml.fromstring(text.encode())
    except xml.ParseError as error:
        raise ValueError(f"not XML, or not all of it ({error})") from None
    for element in root.iter():
        element.tag = element.tag.removeprefix(f"{{{SPACE}}}")
    kinds = [child.tag for child in root]
    if root.tag != "fuzzySystem" or sorted(kinds) != ["knowledgeBase", "tskRuleBase"]:
        raise ValueError(
            "needs a fuzzySystem of one knowledgeBase and one tskRuleBase: Mamdani, Tsukamoto and "
            "AnYa rules conclude sets, the network numbers"
        )
    variables = list(_of(root, "knowledgeBase"))
    inputs = [variable for variable in variables if variable.get("type") != "output"]
    outputs = [variable for variable in variables if variable.get("type") == "output"]
    ends, sets = zip(*map(_input, inputs), strict=True) if inputs else ((), ())
    terms = [_output(variable, len(inputs)) for variable in outputs]
    names = [variable.attrib["name"] for variable in (*inputs, *outputs)]
    block = _of(root, "tskRuleBase")
    rules = [_rule(rule, block, names, len(inputs)) for rule in block]
    return assembled(list(ends), names[len(inputs) :], list(sets), terms, rules)


def _of(parent: Any, tag: str) -> Any:
    """The first child of a kind."""
    found = parent.find(tag)
    if found is None:
        raise KeyError(tag)
    return found


def _input(variable: Any) -> tuple[tuple[str, float, float], dict[str, list[float]]]:
    name, sets = variable.attrib["name"], {}
    low, high = numbers(
        [variable.attrib["domainleft"], variable.attrib["domainright"]], 2, f"the domain of {name}"
    )
    for term in variable:
        shape = next(iter(term), None)
        if shape is None or shape.tag != "gaussianShape" or term.get("complement") == "true":
            kind = "complement" if shape is not None and term.get("complement") else ""
            kind = kind or (shape.tag if shape is not None else "nothing")
            raise ValueError(f"{name}: {kind} is no Gaussian: draw its sets with gaussianShape")
        given = [shape.attrib["param2"], shape.attrib["param1"]]
        sets[term.attrib["name"]] = numbers(given, 2, "gaussianShape")
    return (name, low, high), sets


def _output(variable: Any, n: int) -> dict[str, list[float]]:
    name, terms = variable.attrib["name"], {}
    if variable.tag != "tskVariable" or variable.get("combination", "WA") != "WA":
        raise ValueError(f"{name}: an output must be a tskVariable with the combination WA")
    for term in variable:
        order = term.get("order")
        if order not in ("0", "1"):
            raise ValueError(f"{name}: order must be 0 (constant) or 1 (linear), not {order}")
        words = [value.text or "" for value in term]
        constant, *slopes = numbers(words, 1 + n * int(order), f"a tskTerm of {name}")
        terms[term.attrib["name"]] = (slopes or [0.0] * n) + [constant]
    return terms


def _rule(rule: Any, block: Any, names: list[str], n: int) -> tuple[list[Any], list[Any]]:
    said, what = _of(rule, "tskConsequent"), rule.get("name")
    parts: list[Any] = [None] * len(names)
    given = list(_of(rule, "antecedent"))
    for clause in [*given, *_of(said, "tskThen")]:
        name = (clause.findtext("variable") or "").strip()
        place = names.index(name) if name in names else -1
        outside = (place < n) != (clause.tag == "clause")
        if place < 0 or outside or parts[place] is not None or clause.get("modifier"):
            raise ValueError(f"{what}: {name!r} is no variable there, twice there or modified")
        parts[place] = (clause.findtext("term") or "").strip()
    joined = rule.get("andMethod") or block.get("andMethod") or "MIN"
    if len(given) > 1 and (rule.get("connector", "and").lower(), joined) != ("and", "PROD"):
        raise ValueError(f"{what}: its clauses must be joined by and, with andMethod PROD")
    if not np.isclose(float(rule.get("weight", 1)), 1) or said.find("tskElse") is not None:
        raise ValueError(f"{what}: only weight 1 and no tskElse are known")
    if not given or None in parts[n:]:
        raise ValueError(f"{what}: it needs a clause, and a conclusion for every output")
    return parts[:n], parts[n:]
