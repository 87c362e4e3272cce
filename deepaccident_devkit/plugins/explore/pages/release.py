"""Pages of a release: its scenarios with filters, its contents, town maps, and conventions.

A selection of scenarios can be saved as a file.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
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
    SORTS,
    Choices,
    Matches,
    match_scenarios,
    sort_title,
)
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.models import Model
from deepaccident_devkit.plugins.explore.pages.responses import (
    Variables,
    add_slash,
    get_explorer,
    render_page,
    send_picture,
)
from deepaccident_devkit.plugins.explore.scenarios import UNKNOWN_VALUE, VISIBILITY_RANKS
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.figures import detached_figure
from deepaccident_devkit.render.town_map import draw_whole_map
from deepaccident_devkit.selection.fields import FIELDS
from deepaccident_devkit.selection.splits import save_selection
from deepaccident_devkit.statistics.overview import Overview, overview
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.text import number_text, with_minus
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

# Columns of the table that may not be ready yet.
SLOW: Final = ("accident_visibility", "lead", "lead_all", "min_ttc")
# Number of facets that are expanded at first.
_NUM_OPEN_FACETS = 4
# Name for readers of each last part of the address.
TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "maps": "Town maps",
    "conventions": "Conventions",
}
# Width and height of a map.
_MAP_SIZE_IN = (8.0, 8.0)
# Text of an unknown value in an overview.
_OVERVIEW_UNKNOWN = "none"


def routes() -> list[Route]:
    """Return the routes of the pages."""
    return [
        Route("/", _show_list),
        Route("/selection.txt", _save_selection),
        Route("/waiting.json", _list_waiting),
        Route("/release", add_slash),
        Route("/release/", _show_contents),
        Route("/release/conventions", _show_conventions),
        Route("/release/maps", _show_maps),
        Route("/release/map/{town}.png", _show_map),
    ]


def read_choices(request: Request) -> Choices:
    """Read the reader's choices among the scenarios from a request's address."""
    parameters = request.query_params.multi_items()
    return Choices.of(parameters, get_explorer(request).scenarios)


def _show_list(request: Request) -> Response:
    explorer = get_explorer(request)
    choices = read_choices(request)
    matches = match_scenarios(explorer.scenarios, choices, explorer.scores)
    return render_page(request, "scenarios.html", **make_list_context(explorer, choices, matches))


def make_list_context(explorer: Explorer, choices: Choices, matches: Matches) -> Variables:
    """Return the variables for the template of the list."""
    num_pages = max(1, math.ceil(len(matches.rows) / SCENARIOS_PER_PAGE))
    number = min(choices.page, num_pages)
    first = (number - 1) * SCENARIOS_PER_PAGE
    rows = matches.rows[first : first + SCENARIOS_PER_PAGE].tolist()
    columns = (*SORTS, *explorer.scores)
    return {
        "choices": choices,
        "found": matches,
        "total": len(explorer.scenarios),
        "entries": make_entries(explorer, rows, choices.sort),
        "facets": list(_list_facets(choices, matches)),
        "chosen": _make_filter_links(choices, matches.faults),
        "sorts": [(name, sort_title(name), _is_column_late(explorer, name)) for name in columns],
        "slow": SLOW,
        "here": number,
        "pages": num_pages,
        "python": choices.python(),
        "command": choices.command(str(explorer.dataset.dataroot)),
        "fields": sorted(FIELDS),
        "waits": [job.title for job in explorer.jobs.all() if not job.is_done],
        "broken": [problem.scenario for problem in explorer.dataset.problems],
    }


def _list_facets(choices: Choices, matches: Matches) -> Iterator[Variables]:
    """Yield the facets, without values that would match nothing."""
    for index, (name, counts) in enumerate(matches.counts.items()):
        values = [value for value in counts if value["count"] or value["chosen"]]
        if values:
            is_open = index < _NUM_OPEN_FACETS or name in choices.facets
            yield {"name": name, "counts": values, "open": is_open}


def make_entries(explorer: Explorer, rows: Sequence[int], sort: str) -> list[Variables]:
    """Return what the grid and the table show about each scenario."""
    scenarios = explorer.scenarios
    models = explorer.scores
    columns = {name: scenarios.values(name) for name in SLOW}
    result = []
    for row in rows:
        record = scenarios.records[row]
        measures = {
            name: WAITING if values is None else make_table_cell(values[row])
            for name, values in columns.items()
        }
        scores = {name: make_score_cell(model, record["token"]) for name, model in models.items()}
        result.append(make_entry(record, measures, scores, sort))
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


def make_entry(
    record: ScenarioRecord,
    measures: Mapping[str, _TableCell],
    scores: Mapping[str, _TableCell],
    sort: str = "",
) -> Variables:
    """Return what the grid and the table show about a scenario.

    Below the picture, the grid shows the value of the column by which it is sorted.

    Args:
        record: Record of the scenario.
        measures: Cells of the columns in `SLOW`, by column.
        scores: Cells of the models' scores, by column.
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


def make_table_cell(value: float | str | None) -> _TableCell:
    """Make the table cell for a measure or a visibility."""
    if isinstance(value, str):
        return _TableCell(human_name(value), format_sort_key(VISIBILITY_RANKS.get(value)))
    return _TableCell(number_text(value), format_sort_key(value))


def format_sort_key(value: float | None) -> str:
    """Format a number for a script; an unknown number becomes an empty text."""
    if value is None or math.isnan(value):
        return ""
    return repr(value).replace("inf", "Infinity")


def make_score_cell(model: Model, token: str) -> _TableCell:
    """Make the table cell for a model's score in a scenario."""
    missing = _TableCell("–", "")
    if model.scores is None:
        if model.job.is_done:
            return missing
        return WAITING
    score = model.scores.scenarios.get(token)
    if score is None:
        return missing
    return _TableCell(with_minus(score.text), format_sort_key(score.value))


def _is_column_late(explorer: Explorer, name: str) -> bool:
    """Return whether a column is not ready yet."""
    if name in explorer.scores:
        return explorer.scores[name].scores is None
    return name in SLOW and explorer.scenarios.values(name) is None


def _make_filter_links(choices: Choices, faults: Collection[str]) -> list[tuple[str, str]]:
    """Return each filter that is applied, with the address of the page without that filter.

    `faults` are the conditions that are wrong, and therefore not applied.
    """
    links = []
    for name, values in choices.facets.items():
        for value in values:
            words = f"{human_name(name, 'attributes')}: {human_name(value)}"
            facets = dict(choices.facets)
            facets[name] = tuple(other for other in values if other != value)
            if not facets[name]:
                del facets[name]
            links.append((words, choices.address(facets=facets, page=1)))
    for line in choices.lines:
        if line in faults:
            continue
        query = "; ".join(other for other in choices.lines if other != line)
        links.append((line, choices.address(query=query, page=1)))
    return links


def _save_selection(request: Request) -> Response:
    """Return the matching scenarios as a split file, in the order of the list."""
    explorer = get_explorer(request)
    matches = match_scenarios(explorer.scenarios, read_choices(request), explorer.scores)
    if matches.faults or matches.waiting:
        words = " ".join([*matches.faults.values(), *matches.waiting])
        return render_page(request, "error.html", status=409, title="Not saved", words=words)
    with tempfile.TemporaryDirectory() as folder:
        tokens = [explorer.scenarios.tokens[row] for row in matches.rows.tolist()]
        path = save_selection(tokens, Path(folder, "selection.txt"))
        content = path.read_bytes()
    headers = {"Content-Disposition": 'attachment; filename="selection.txt"'}
    return Response(content, media_type="text/plain", headers=headers)


async def _list_waiting(request: Request) -> Response:
    """Return the titles of unfinished jobs, for a script that reloads the page when one ends."""
    jobs = get_explorer(request).jobs.all()
    return JSONResponse([job.title for job in jobs if not job.is_done])


def _show_page(
    request: Request, tab: str, *, job: Job | None = None, state: State = "ready", **context: Any
) -> Response:
    """Return a page about the release, which reloads itself until its job is done."""
    template = f"release_{tab or 'contents'}.html"
    return render_page(request, template, tab=tab, tabs=TABS, job=job, state=state, **context)


def _show_contents(request: Request) -> Response:
    """Return the page about the contents of a release.

    They are counted in the background, since this lists the folders of all sensors.
    """
    explorer = get_explorer(request)
    work = partial(overview, explorer.dataset)
    job = explorer.jobs.ask("overview", "what the release holds", work)
    state = job.state  # It is read once, since it can change at any moment.
    context = {}
    if state == "ready":
        context = _make_overview_context(job.result)
    return _show_page(request, "", job=job, state=state, **context)


def _make_overview_context(counts: Overview) -> Variables:
    """Return the variables for the template of the contents.

    Unknown values of attributes have the same name as in the filters of the list.
    """
    has_splits = set(counts.expected) == set(SPLITS)
    splits = [(name, count, counts.expected.get(name)) for name, count in counts.splits.items()]
    attributes = {}
    for field, counts_by_value in counts.attributes.items():
        rows = []
        for value, count in counts_by_value.items():
            rows.append((UNKNOWN_VALUE if value == _OVERVIEW_UNKNOWN else value, count))
        attributes[field] = rows
    return {
        "told": counts,
        "splits": splits,
        "whole": None if has_splits else sum(counts.expected.values()),
        "attributes": attributes,
    }


def _show_maps(request: Request) -> Response:
    """Return the page with the town maps that are stored next to the index."""
    dataset = get_explorer(request).dataset
    towns = {town: kept_town_map(dataset, town) for town in towns_of(dataset)}
    return _show_page(request, "maps", towns=towns)


def _show_map(request: Request) -> Response:
    explorer = get_explorer(request)
    town = request.path_params["town"]
    town_map = kept_town_map(explorer.dataset, town)
    if town_map is None:
        raise NotAvailableError(f"{town}: its map has not been made yet")

    def draw() -> Any:
        figure = detached_figure(_MAP_SIZE_IN)
        draw_whole_map(town_map, figure.subplots())
        return figure

    key = ("map", town, town_map.looks, town_map.missing, town_map.damaged)
    return send_picture(explorer.drawn(key, draw), "png")


def _show_conventions(request: Request) -> Response:
    return _show_page(request, "conventions")
