"""The safety report's table, a row an accident; its numbers carry keys by which the page's script sorts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from deepaccident_devkit.render.markup import Markup, breakable, joined, tag
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.safety import AccidentRow
from deepaccident_devkit.safety.report import CRITICAL, DECELERATIONS
from deepaccident_devkit.safety.reports import number_text
from deepaccident_devkit.taxonomy import AGENTS

_GROUPS: Final[Mapping[str, Sequence[str]]] = {
    "": ("scenario", "what happens", "colliders"),
    "at the impact (m/s)": ("speeds", "delta-v", "closing"),
    "observed both before the impact (s)": (*map(short_name, AGENTS), "all"),
    "last moment to brake before the impact (s)": (
        "who brakes",
        *(f"{deceleration:g} m/s²" for deceleration in DECELERATIONS),
    ),
    "over the recording (s)": (f"TTC ≤ {CRITICAL:g}", "twin parts before"),
}
"""Heading of a group of columns → their headings."""
_WORDS: Final = ("what happens", "colliders", "who brakes")
_CAPTION: Final = (
    "The hardest first, by the larger delta-v; a click on a heading sorts. Two numbers are those of the colliders, in "
    "that column's order. never: not at one moment, or not by any braking; –: not known."
)


def accident_table(rows: Sequence[AccidentRow], pages: Mapping[str, str]) -> Markup:
    """The table in a box that scrolls.

    Args:
        rows: of the report.
        pages: scenario → address of its replay page.
    """
    groups = [
        tag("th", name, colspan=str(len(part)), scope="colgroup", **_class(begins=bool(name)))
        for name, part in _GROUPS.items()
    ]
    names = [
        tag("th", each, scope="col", **_class(begins=bool(name) and not place, words=each in _WORDS))
        for name, part in _GROUPS.items()
        for place, each in enumerate(part)
    ]
    body = (tag("tr", *_cells(row, pages.get(row.scenario))) for row in by_severity(rows))
    head = tag("thead", tag("tr", *groups), tag("tr", *names))
    whole = tag("table", head, tag("tbody", *body), class_="sortable")
    return joined([tag("p", _CAPTION), tag("div", whole, class_="wide accidents")])


def by_severity(rows: Sequence[AccidentRow]) -> list[AccidentRow]:
    """The accidents with the largest delta-v first."""
    return sorted(rows, key=lambda row: (-row.severity, row.scenario))


def actor_words(actor: Mapping[str, Any]) -> str:
    """An actor of a story's facts: `ego (car)`, or `cyclist 1234` for one that is no agent."""
    category = actor["category"] or "road user"
    return f"{short_name(actor['agent'])} ({category})" if actor["agent"] else f"{category} {actor['actor_id']}"


def _cells(row: AccidentRow, page: str | None) -> Iterator[Markup]:
    name = [breakable(row.scenario), *([tag("br"), tag("a", "replay", href=page)] if page else [])]
    yield tag("th", *name, scope="row")
    yield tag("td", row.story.text, class_="words story")
    yield tag("td", ", ".join(map(actor_words, row.colliders)), **_class(words=True))
    yield _two([each["speed"] for each in row.colliders], begins=True)
    yield _two([each["delta_v"] for each in row.colliders])
    yield _number(row.story.facts["accident"]["closing_speed"])
    for agent, lead in row.leads.items():
        yield _number(lead, zero="never", begins=agent == AGENTS[0])
    yield tag("td", _brakes(row), **_class(begins=True, words=True))
    moments = row.last_moments
    for deceleration in DECELERATIONS:
        yield _number(moments.get(deceleration), 2, unknown="never" if moments else "–")
    yield _number(None if row.measures is None else row.measures.time_exposed, begins=True)
    yield _number(row.parts, unknown="–" if row.twin is None else "never")


def _class(*, begins: bool = False, words: bool = False) -> dict[str, str]:
    """Of a cell: whether it is the first of a group, which has a line to its left, and whether it has words."""
    kinds = [name for name, holds in {"begins": begins, "words": words}.items() if holds]
    return {"class_": " ".join(kinds)} if kinds else {}


def _brakes(row: AccidentRow) -> str:
    if not row.last_moments:
        return "–"
    who = " and ".join("the other" if agent is None else short_name(agent) for agent in row.brakes)
    return f"{who}, head-on" if row.replayed is not None and row.replayed.head_on else who


def _number(
    value: float | None, digits: int = 1, *, zero: str = "", unknown: str = "–", begins: bool = False
) -> Markup:
    """A cell; `zero` and `unknown` are what it says instead of 0 and None; whether it is the first of a group."""
    words = unknown if value is None else zero if zero and not value else number_text(value, digits)
    return tag("td", words, data_key="" if value is None else f"{value:g}", **_class(begins=begins))


def _two(values: Sequence[float | None], *, begins: bool = False) -> Markup:
    known = [value for value in values if value is not None]
    words = " / ".join(number_text(value, 1) for value in values)
    return tag("td", words, data_key=f"{max(known):g}" if known else "", **_class(begins=begins))
