"""A release: its scenarios, with filters and a selection as a file; what it holds, its towns' maps, and conventions."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.maps import kept_town_map, towns_of
from deepaccident_devkit.plugins.explore.background import Job, State
from deepaccident_devkit.plugins.explore.choices import (
    SCENARIOS_PER_PAGE,
    SCORE_PREFIX,
    SORTS,
    Choices,
    Found,
    found_by,
)
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import Model
from deepaccident_devkit.plugins.explore.pages.responses import (
    explorer_of,
    page,
    picture,
    with_slash,
)
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE, VISIBILITY_RANKS
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.figures import detached_figure
from deepaccident_devkit.render.town_map import draw_whole_map
from deepaccident_devkit.selection.fields import FIELDS
from deepaccident_devkit.selection.splits import save_selection
from deepaccident_devkit.statistics.overview import Overview, overview
from deepaccident_devkit.support.text import number_text
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

# Columns of the table that may not be there yet → their headings.
SLOW: Final[Mapping[str, str]] = {
    "accident_visibility": "visibility",
    "lead": "lead, ego (s)",
    "lead_all": "lead, all (s)",
    "min_ttc": "least TTC (s)",
}
# So many facets are open at first.
_OPEN: Final = 4
# Last part of the address → its name for readers.
TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "maps": "Town maps",
    "conventions": "Conventions",
}
_SIZE: Final = (8.0, 8.0)
# How an overview calls an unknown value.
_NONE: Final = "none"


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/", _list),
        Route("/selection.txt", _selection),
        Route("/waiting.json", _waiting),
        Route("/release", with_slash),
        Route("/release/", _contents),
        Route("/release/conventions", _conventions),
        Route("/release/maps", _maps),
        Route("/release/map/{town}.png", _map),
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
    pages = max(1, -(-len(found.rows) // SCENARIOS_PER_PAGE))
    here = min(choices.page, pages)
    shown = found.rows[(here - 1) * SCENARIOS_PER_PAGE : here * SCENARIOS_PER_PAGE].tolist()
    sorts = [
        *SORTS.items(),
        *((name, f"score of {name.removeprefix(SCORE_PREFIX)}") for name in explorer.scores),
    ]
    return {
        "choices": choices,
        "found": found,
        "total": len(explorer.scenarios),
        "entries": entries(explorer, shown, choices.sort),
        "facets": [
            {"name": name, "counts": values, "open": place < _OPEN or name in choices.facets}
            for place, (name, counts) in enumerate(found.counts.items())
            if (
                values := [each for each in counts if each["count"] or each["chosen"]]
            )  # others would find nothing
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
        measures = {
            name: WAITING if values is None else cell(values[row]) for name, values in slow.items()
        }
        shown.append(
            entry(
                record,
                measures,
                {name: score_cell(each, record["token"]) for name, each in scores.items()},
                sort,
            )
        )
    return shown


class _TableCell(NamedTuple):
    """A value in a table.

    Attributes:
        text: for readers.
        key: a number by which a script sorts; empty for an unknown value, None to sort by the text.
    """

    text: str
    key: str | None


WAITING: Final = _TableCell("…", "")


def entry(
    record: ScenarioRecord,
    measures: Mapping[str, _TableCell],
    scores: Mapping[str, _TableCell],
    sort: str = "",
) -> dict[str, Any]:
    """What the grid and the table show of a scenario: its values of `SLOW`, and models' scores by their columns.

    The value of the column by which the grid is sorted stands below the picture.
    """
    named = {**measures, **scores, "num_frames": _TableCell(f"{record['num_frames']} frames", "")}
    return {
        "token": record["token"],
        "name": scenario_words(record),
        "record": record,
        "cells": [*measures.values(), *scores.values()],
        "scores": scores,
        "sorted": named[sort].text if sort in named else "",
    }


def cell(value: float | str | None) -> _TableCell:
    """A measure, or a visibility."""
    rank = VISIBILITY_RANKS.get(value) if isinstance(value, str) else value
    return _TableCell(value if isinstance(value, str) else number_text(value), sort_key(rank))


def sort_key(value: float | None) -> str:
    """A number as a script reads it; empty for an unknown one."""
    return "" if value is None or math.isnan(value) else repr(value).replace("inf", "Infinity")


def score_cell(model: Model, token: str) -> _TableCell:
    """A model's score of a scenario."""
    if model.scores is None:
        return _TableCell("–", "") if model.job.is_done else WAITING
    score = model.scores.scenarios.get(token)
    return _TableCell("–", "") if score is None else _TableCell(score.text, sort_key(score.value))


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
            facets = (
                {**choices.facets, name: left}
                if left
                else {k: v for k, v in choices.facets.items() if k != name}
            )
            chosen.append((f"{name}={value}", choices.address(facets=facets, page=1)))
    return chosen + [
        (
            line,
            choices.address(
                query="; ".join(each for each in choices.lines if each != line), page=1
            ),
        )
        for line in choices.lines
    ]


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


def _page(
    request: Request, tab: str, *, job: Job | None = None, state: State = "ready", **context: Any
) -> Response:
    """A page about the release; as long as a job's state says that it is not done, the page loads itself again."""
    return page(
        request,
        f"release_{tab or 'contents'}.html",
        tab=tab,
        tabs=TABS,
        job=job,
        state=state,
        **context,
    )


def _contents(request: Request) -> Response:
    """Counted in the background, since the folders of all sensors are listed."""
    explorer = explorer_of(request)
    job = explorer.jobs.ask(
        "overview", "what the release holds", lambda: overview(explorer.dataset)
    )
    state = job.state  # looked at once: it changes at any moment
    return _page(
        request,
        "",
        job=job,
        state=state,
        **(_overview_context(job.result) if state == "ready" else {}),
    )


def _overview_context(told: Overview) -> dict[str, Any]:
    """What the overview's template shows: counts, those of attributes with the values that the list knows them by."""
    of_splits = set(told.expected) == set(SPLITS)
    return {
        "told": told,
        "splits": [(name, count, told.expected.get(name)) for name, count in told.splits.items()],
        "whole": None if of_splits else sum(told.expected.values()),
        "attributes": {
            field: [
                (UNKNOWN_VALUE if value == _NONE else value, count)
                for value, count in counts.items()
            ]
            for field, counts in told.attributes.items()
        },
    }


def _maps(request: Request) -> Response:
    """The maps that are kept beside the index."""
    dataset = explorer_of(request).dataset
    return _page(
        request, "maps", towns={town: kept_town_map(dataset, town) for town in towns_of(dataset)}
    )


def _map(request: Request) -> Response:
    explorer, town = explorer_of(request), request.path_params["town"]
    found = kept_town_map(explorer.dataset, town)
    if found is None:
        raise NotAvailableError(f"{town}: its map is not made yet")

    def draw() -> Any:
        figure = detached_figure(_SIZE)
        draw_whole_map(found, figure.subplots())
        return figure

    return picture(
        explorer.drawn(("map", town, found.looks, found.missing, found.damaged), draw), "png"
    )


def _conventions(request: Request) -> Response:
    return _page(request, "conventions")
