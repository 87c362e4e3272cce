"""The scenarios of a release: a grid of thumbnails or a table, filters with counts, and the selection as a file."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from deepaccident_devkit.explore.choices import PAGE, SCORE, SORTS, Choices, Found, found_by
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages.answers import explorer_of, page
from deepaccident_devkit.explore.scenarios import VISIBILITY_RANKS, ending
from deepaccident_devkit.selection.fields import FIELDS
from deepaccident_devkit.splits import save_selection
from deepaccident_devkit.support.text import number_text

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

SLOW: Final[Mapping[str, str]] = {
    "accident_visibility": "visibility",
    "lead": "lead, ego (s)",
    "lead_all": "lead, all (s)",
    "min_ttc": "least TTC (s)",
}
"""Columns of the table that may not be there yet → their headings."""
_OPEN: Final = 4
"""So many facets are open at first."""


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/", _list),
        Route("/selection.txt", _selection),
        Route("/waiting.json", _waiting),
    ]


def choices_of(request: Request) -> Choices:
    """What an address chose of the scenarios."""
    return Choices.of(request.query_params.multi_items(), explorer_of(request).scenarios)


def _list(request: Request) -> Response:
    explorer, choices = explorer_of(request), choices_of(request)
    found = found_by(explorer.scenarios, choices, explorer.scores)
    return page(request, "scenarios.html", **list_context(explorer, choices, found))


def list_context(explorer: Explorer, choices: Choices, found: Found) -> dict[str, Any]:
    """What the list's template shows."""
    pages = max(1, -(-len(found.rows) // PAGE))
    here = min(choices.page, pages)
    shown = found.rows[(here - 1) * PAGE : here * PAGE].tolist()
    sorts = [*SORTS.items(), *((name, f"score of {name.removeprefix(SCORE)}") for name in explorer.scores)]
    return {
        "choices": choices,
        "found": found,
        "total": len(explorer.scenarios),
        "entries": entries(explorer, shown, choices.sort),
        "facets": [
            {"name": name, "counts": counts, "open": place < _OPEN or name in choices.facets}
            for place, (name, counts) in enumerate(found.counts.items())
        ],
        "chosen": _chosen(choices),
        "sorts": [(name, title, _sort_waits(explorer, name)) for name, title in sorts],
        "slow": SLOW,
        "here": here,
        "pages": pages,
        "python": choices.python(),
        "command": choices.command(str(explorer.dataset.dataroot)),
        "fields": sorted(FIELDS),
        "waits": [job.title for job in explorer.jobs.all() if not job.is_done],
        "broken": [problem.scenario for problem in explorer.dataset.problems],
    }


def entries(explorer: Explorer, rows: Sequence[int], sort: str) -> list[dict[str, Any]]:
    """What the grid and the table show of scenarios."""
    scenarios, scores = explorer.scenarios, explorer.scores
    slow = {name: scenarios.values(name) for name in SLOW}
    shown = []
    for row in rows:
        record = scenarios.records[row]
        measures = {name: WAITING if values is None else cell(values[row]) for name, values in slow.items()}
        shown.append(
            entry(record, measures, {name: score_cell(each, record["token"]) for name, each in scores.items()}, sort)
        )
    return shown


class Cell(NamedTuple):
    """A value in a table.

    Attributes:
        text: for readers.
        key: a number by which a script sorts; empty for an unknown value, None to sort by the text.
    """

    text: str
    key: str | None


WAITING: Final = Cell("…", "")


def entry(
    record: ScenarioRecord, measures: Mapping[str, Cell], scores: Mapping[str, Cell], sort: str = ""
) -> dict[str, Any]:
    """What the grid and the table show of a scenario.

    Args:
        record: of the scenario.
        measures: its values of `SLOW`.
        scores: of models, by the names of their columns.
        sort: column by which the grid is sorted: its value stands below the picture.
    """
    named = {**measures, **scores, "num_frames": Cell(f"{record['num_frames']} frames", "")}
    return {
        "token": record["token"],
        "name": record["name"],
        "type": record["scenario_type"],
        "record": record,
        "ending": ending(record),
        "weather": ", ".join(filter(None, (record["weather"], record["time_of_day"]))),
        "cells": [*measures.values(), *scores.values()],
        "scores": scores,
        "sorted": named[sort].text if sort in named else "",
    }


def cell(value: float | str | None) -> Cell:
    """A measure, or a visibility."""
    rank = VISIBILITY_RANKS.get(value) if isinstance(value, str) else value
    return Cell(value if isinstance(value, str) else number_text(value), sort_key(rank))


def sort_key(value: float | None) -> str:
    """A number as a script reads it; empty for an unknown one."""
    return "" if value is None or math.isnan(value) else repr(value).replace("inf", "Infinity")


def score_cell(model: Model, token: str) -> Cell:
    """A model's score of a scenario."""
    if model.scores is None:
        return Cell("–", "") if model.job.is_done else WAITING
    score = model.scores.scenarios.get(token)
    return Cell("–", "") if score is None else Cell(score.text, sort_key(score.value))


def _sort_waits(explorer: Explorer, name: str) -> bool:
    """Whether a column is not there yet."""
    if name in explorer.scores:
        return explorer.scores[name].scores is None
    return name in SLOW and explorer.scenarios.values(name) is None


def _chosen(choices: Choices) -> list[tuple[str, str]]:
    """What was chosen, each with the address without it."""
    chosen = []
    for name, values in choices.facets.items():
        for value in values:
            left = tuple(each for each in values if each != value)
            facets = {**choices.facets, name: left} if left else {k: v for k, v in choices.facets.items() if k != name}
            chosen.append((f"{name}={value}", choices.address(facets=facets, page=1)))
    for line in choices.lines:
        query = "; ".join(each for each in choices.lines if each != line)
        chosen.append((line, choices.address(query=query, page=1)))
    return chosen


def _selection(request: Request) -> Response:
    """The scenarios that were chosen as a split file, in the order of the list."""
    explorer = explorer_of(request)
    found = found_by(explorer.scenarios, choices_of(request), explorer.scores)
    if found.faults or found.waiting:
        words = " ".join([*found.faults, *found.waiting])
        return page(request, "error.html", status=409, title="Not saved", words=words)
    with tempfile.TemporaryDirectory() as folder:
        tokens = [explorer.scenarios.tokens[row] for row in found.rows.tolist()]
        content = save_selection(tokens, Path(folder, "selection.txt")).read_bytes()
    how = {"Content-Disposition": 'attachment; filename="selection.txt"'}
    return Response(content, media_type="text/plain", headers=how)


async def _waiting(request: Request) -> Response:
    """Titles of the work that is not done, for the script that loads the page again when some of it is."""
    return JSONResponse([job.title for job in explorer_of(request).jobs.all() if not job.is_done])
