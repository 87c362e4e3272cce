"""Pages of a release: scenarios with filters, contents, town maps, and conventions.

A selection of scenarios can be saved as a file.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
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
    Matches,
    match_scenarios,
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

# Columns of the table that may not be ready yet → their headings.
SLOW: Final[Mapping[str, str]] = {
    "accident_visibility": "visibility",
    "lead": "lead, ego (s)",
    "lead_all": "lead, all (s)",
    "min_ttc": "least TTC (s)",
}
# Number of facets expanded initially.
_NUM_OPEN_FACETS: Final = 4
# Last part of the address → its name for readers.
TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "maps": "Town maps",
    "conventions": "Conventions",
}
# Width and height in inches.
_MAP_SIZE: Final = (8.0, 8.0)
# Text of an unknown value in an overview.
_OVERVIEW_UNKNOWN: Final = "none"


def routes() -> list[Route]:
    """Return the routes of the pages."""
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
    """Return the choices that an address makes among the scenarios."""
    return Choices.of(request.query_params.multi_items(), explorer_of(request).scenarios)


def _list(request: Request) -> Response:
    explorer, choices = explorer_of(request), choices_of(request)
    matches = match_scenarios(explorer.scenarios, choices, explorer.scores)
    return page(request, "scenarios.html", **list_context(explorer, choices, matches))


def list_context(explorer: Explorer, choices: Choices, matches: Matches) -> dict[str, Any]:
    """Return the variables of the list's template."""
    pages = max(1, -(-len(matches.rows) // SCENARIOS_PER_PAGE))
    number = min(choices.page, pages)
    begin = (number - 1) * SCENARIOS_PER_PAGE
    rows = matches.rows[begin : begin + SCENARIOS_PER_PAGE].tolist()
    titles = dict(SORTS)
    for name in explorer.scores:
        titles[name] = f"score of {name.removeprefix(SCORE_PREFIX)}"
    return {
        "choices": choices,
        "found": matches,
        "total": len(explorer.scenarios),
        "entries": entries(explorer, rows, choices.sort),
        "facets": list(_facets(choices, matches)),
        "chosen": _filter_links(choices),
        "sorts": [(name, title, _sort_waits(explorer, name)) for name, title in titles.items()],
        "slow": SLOW,
        "here": number,
        "pages": pages,
        "python": choices.python(),
        "command": choices.command(str(explorer.dataset.dataroot)),
        "fields": sorted(FIELDS),
        "waits": [job.title for job in explorer.jobs.all() if not job.is_done],
        "broken": [problem.scenario for problem in explorer.dataset.problems],
    }


def _facets(choices: Choices, matches: Matches) -> Iterator[dict[str, Any]]:
    """Yield the facets without the values that would match nothing."""
    for index, (name, counts) in enumerate(matches.counts.items()):
        values = [value for value in counts if value["count"] or value["chosen"]]
        if values:
            is_open = index < _NUM_OPEN_FACETS or name in choices.facets
            yield {"name": name, "counts": values, "open": is_open}


def entries(explorer: Explorer, rows: Sequence[int], sort: str) -> list[dict[str, Any]]:
    """Return what the grid and the table show of scenarios."""
    scenarios, models = explorer.scenarios, explorer.scores
    columns = {name: scenarios.values(name) for name in SLOW}
    result = []
    for row in rows:
        record = scenarios.records[row]
        measures = {
            name: WAITING if values is None else cell(values[row])
            for name, values in columns.items()
        }
        scores = {name: score_cell(model, record["token"]) for name, model in models.items()}
        result.append(entry(record, measures, scores, sort))
    return result


class _TableCell(NamedTuple):
    """A value in a table.

    Attributes:
        text: Text for readers.
        key: Number by which a script sorts; empty for an unknown value, None to sort by the text.
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
    """Return what the grid and the table show of a scenario.

    The value of the column by which the grid is sorted stands below the picture.

    Args:
        record: Record of the scenario.
        measures: Its values of `SLOW`.
        scores: Models' scores, by their columns.
        sort: Column by which the grid is sorted.
    """
    num_frames = _TableCell(f"{record['num_frames']} frames", "")
    cells = {**measures, **scores, "num_frames": num_frames}
    return {
        "token": record["token"],
        "name": scenario_words(record),
        "record": record,
        "cells": [*measures.values(), *scores.values()],
        "scores": scores,
        "sorted": cells[sort].text if sort in cells else "",
    }


def cell(value: float | str | None) -> _TableCell:
    """Return the cell of a measure, or of a visibility."""
    if isinstance(value, str):
        return _TableCell(value, sort_key(VISIBILITY_RANKS.get(value)))
    return _TableCell(number_text(value), sort_key(value))


def sort_key(value: float | None) -> str:
    """Return a number as a script reads it; empty for an unknown one."""
    if value is None or math.isnan(value):
        return ""
    return repr(value).replace("inf", "Infinity")


def score_cell(model: Model, token: str) -> _TableCell:
    """Return the cell of a model's score of a scenario."""
    missing = _TableCell("–", "")
    if model.scores is None:
        if model.job.is_done:
            return missing
        return WAITING
    score = model.scores.scenarios.get(token)
    if score is None:
        return missing
    return _TableCell(score.text, sort_key(score.value))


def _sort_waits(explorer: Explorer, name: str) -> bool:
    """Return whether a column is not ready yet."""
    if name in explorer.scores:
        return explorer.scores[name].scores is None
    return name in SLOW and explorer.scenarios.values(name) is None


def _filter_links(choices: Choices) -> list[tuple[str, str]]:
    """Return each chosen filter with the address that drops it."""
    links = []
    for name, values in choices.facets.items():
        for value in values:
            facets = dict(choices.facets)
            facets[name] = tuple(other for other in values if other != value)
            if not facets[name]:
                del facets[name]
            links.append((f"{name}={value}", choices.address(facets=facets, page=1)))
    for line in choices.lines:
        query = "; ".join(other for other in choices.lines if other != line)
        links.append((line, choices.address(query=query, page=1)))
    return links


def _selection(request: Request) -> Response:
    """Return the matching scenarios as a split file, in the order of the list."""
    explorer = explorer_of(request)
    matches = match_scenarios(explorer.scenarios, choices_of(request), explorer.scores)
    if matches.faults or matches.waiting:
        words = " ".join([*matches.faults, *matches.waiting])
        return page(request, "error.html", status=409, title="Not saved", words=words)
    with tempfile.TemporaryDirectory() as folder:
        tokens = [explorer.scenarios.tokens[row] for row in matches.rows.tolist()]
        content = save_selection(tokens, Path(folder, "selection.txt")).read_bytes()
    headers = {"Content-Disposition": 'attachment; filename="selection.txt"'}
    return Response(content, media_type="text/plain", headers=headers)


async def _waiting(request: Request) -> Response:
    """Return titles of unfinished jobs; a script reloads the page when one of them is done."""
    return JSONResponse([job.title for job in explorer_of(request).jobs.all() if not job.is_done])


def _page(
    request: Request, tab: str, *, job: Job | None = None, state: State = "ready", **context: Any
) -> Response:
    """Return a page about the release; it reloads itself until the job's state is done."""
    template = f"release_{tab or 'contents'}.html"
    return page(request, template, tab=tab, tabs=TABS, job=job, state=state, **context)


def _contents(request: Request) -> Response:
    """Return the contents of a release.

    They are counted in the background, since the folders of all sensors are listed.
    """
    explorer = explorer_of(request)
    job = explorer.jobs.ask(
        "overview", "what the release holds", lambda: overview(explorer.dataset)
    )
    state = job.state  # read once, since it can change at any moment
    context = _overview_context(job.result) if state == "ready" else {}
    return _page(request, "", job=job, state=state, **context)


def _overview_context(counts: Overview) -> dict[str, Any]:
    """Return the variables of the overview's template.

    Values of attributes are named as in the filters of the list.
    """
    has_splits = set(counts.expected) == set(SPLITS)
    splits = [(name, count, counts.expected.get(name)) for name, count in counts.splits.items()]
    attributes = {}
    for field, by_value in counts.attributes.items():
        attributes[field] = [
            (UNKNOWN_VALUE if value == _OVERVIEW_UNKNOWN else value, count)
            for value, count in by_value.items()
        ]
    return {
        "told": counts,
        "splits": splits,
        "whole": None if has_splits else sum(counts.expected.values()),
        "attributes": attributes,
    }


def _maps(request: Request) -> Response:
    """Return the maps that are stored beside the index."""
    dataset = explorer_of(request).dataset
    towns = {town: kept_town_map(dataset, town) for town in towns_of(dataset)}
    return _page(request, "maps", towns=towns)


def _map(request: Request) -> Response:
    explorer, town = explorer_of(request), request.path_params["town"]
    town_map = kept_town_map(explorer.dataset, town)
    if town_map is None:
        raise NotAvailableError(f"{town}: its map is not made yet")

    def draw() -> Any:
        figure = detached_figure(_MAP_SIZE)
        draw_whole_map(town_map, figure.subplots())
        return figure

    key = ("map", town, town_map.looks, town_map.missing, town_map.damaged)
    return picture(explorer.drawn(key, draw), "png")


def _conventions(request: Request) -> Response:
    return _page(request, "conventions")
