"""Human names of metrics, attributes, agents and other identifiers, for all that people read.

The names are in human_names.json, from which docs/glossary.md is made. JSON and CSV files, options
and arguments keep the identifiers.
"""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from deepaccident_devkit.support.values import NamedValues

NameKind = Literal[
    "metrics",
    "headlines",
    "qualifiers",
    "values",
    "agents",
    "attributes",
    "columns",
    "tasks",
    "protocols",
    "sensors",
    "headings",
]
# Tables that are searched for identifiers of an unknown kind.
_COMMON_KINDS: Sequence[NameKind] = ("qualifiers", "values", "agents", "attributes")
# Words of `Row.unit` that a table writes in another way; "" for numbers without a unit.
_UNIT_NAMES = {"share": "", "count": "", "1 - overlap": "1 − overlap", "1/min": "per minute"}


@cache
def name_tables() -> dict[str, NamedValues]:
    """Return the content of human_names.json: kind → identifier → name.

    A metric has a list of its name and its meaning.
    """
    tables: dict[str, NamedValues] = json.loads(Path(__file__).with_suffix(".json").read_bytes())
    return tables


def human_name(identifier: str | None, kind: NameKind | None = None) -> str:
    """Return the name of an identifier for people, such as `vehicle behind ego`.

    Args:
        identifier: Name of an attribute, a value, an agent, a protocol or another thing; None for
            an unknown value.
        kind: Kind of the identifier; None for a qualifier, a value, an agent or an attribute,
            whichever has the name. Metrics have `metric_name`.

    Returns:
        The name. An identifier without one keeps its letters, with spaces instead of underscores.
    """
    if identifier is None:
        return "unknown"
    names = _names(kind) if kind else _names(*_COMMON_KINDS)
    if identifier in names:
        return names[identifier]
    if ", " in identifier:  # such as `bystander, lead 3 s`
        return ", ".join(human_name(part, kind) for part in identifier.split(", "))
    return _phrase_name(identifier)


def _phrase_name(identifier: str) -> str:
    """Return the name of an identifier that is not in the tables, but may have words that are."""
    qualifier, _, group = identifier.partition(" ")
    if qualifier == "lead" and group:  # a table of plans, such as `lead 3 s to contact`
        seconds, to_contact, _ = group.partition(" to contact")
        moment = "contact" if to_contact else "accident"
        return f"{seconds} before the {moment}"
    names = _names("qualifiers", "agents")
    if qualifier in names and group in names:  # such as `ustring ego_involved`
        return f"{names[qualifier]}, {names[group]}"
    if any(map(str.isdigit, identifier)):  # such as Town10HD
        return identifier
    return identifier.replace("_", " ")


def column_name(path: str) -> str:
    """Return the name of a count or of a part of a result, such as `groups/bystander`."""
    names = _names("columns", "metrics")
    if path in names:
        return names[path]
    parts = [names.get(part, human_name(part)) for part in path.split("/")]
    return ", ".join(filter(None, parts))


def metric_name(identifier: str) -> str:
    """Return the name of a metric for people.

    >>> metric_name("vpq 100x100"), metric_name("accuracy@10"), metric_name("min_fde 3 s, K = 6")
    ('VPQ, 100 m × 100 m', 'accuracy within 10 m', 'minFDE at 3 s, K = 6')

    Args:
        identifier: Name of a headline, or of a number in the JSON files; it may be followed by a
            range, a group, a class, a horizon or a distance.
    """
    names = _names("headlines", "metrics")
    if identifier in names:
        return names[identifier]
    metric, _, qualifier = identifier.partition(" ")
    base, _, distance = metric.partition("@")
    name = names.get(metric) or names.get(base) or base.replace("_", " ")
    if distance and metric not in names:
        name += f" within {distance} m"
    if not qualifier:
        return name
    if qualifier[0].isdigit() and " s" in qualifier:
        return f"{name} at {qualifier}"
    return f"{name}, {human_name(qualifier)}"


def heading_name(path: str) -> str:
    """Return the short name of a number of a result, as the heading of a column."""
    return _names("headings").get(path) or metric_name(path)


@cache
def _names(*kinds: NameKind) -> dict[str, str]:
    """Return identifier → name; an identifier of several kinds has its name of the first kind."""
    names = {}
    for kind in reversed(kinds):
        for identifier, name in name_tables()[kind].items():
            names[identifier] = name[0] if kind == "metrics" else name
    return names


def rules_name(task: str, protocol: str) -> str:
    """Return the names of a task and its protocol: `accident prediction, protocol: paper`."""
    return f"{human_name(task, 'tasks')}, protocol: {human_name(protocol, 'protocols')}"


def with_unit(name: str, unit: str | None) -> str:
    """Return a metric's name with its unit, such as `L2 error (m)`; a share has no unit."""
    unit_text = _UNIT_NAMES.get(unit or "", unit)
    return f"{name} ({unit_text})" if unit_text else name
