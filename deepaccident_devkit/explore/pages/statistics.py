"""The paper's statistics of the release, or of the scenarios that a reader chose in the list."""

from __future__ import annotations

import hashlib
from typing import Any, Final

import numpy as np
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.choices import Choices, Found, found_by
from deepaccident_devkit.explore.explorer import DPI, Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of, picture
from deepaccident_devkit.explore.pages.release import release_page
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.statistics import STATISTICS_FIGURES, render_statistics
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics

_HEADINGS: Final = {
    "scenarios": "Scenarios by weather, time of day, type, town and road",
    "ends": "How scenarios end, and how long they are",
    "ego": "The ego's speeds and size",
    "actors": "Actors by category",
    "boxes": "Sizes of boxes",
    "motion": "Distances and speeds",
    "collisions": "Collisions",
}
"""Figure → its heading."""


def routes() -> list[Route]:
    """The addresses; both take the parameters of the list."""
    return [
        Route("/release/statistics", _statistics),
        Route("/release/statistics/{figure}.png", _figure),
    ]


def _statistics(request: Request) -> Response:
    explorer, choices = explorer_of(request), _choices(request)
    found = _found(explorer, choices)
    nothing = found is not None and (_is_unclear(found) or not len(found.rows))
    job = None if nothing else _job(explorer, choices, found)
    return release_page(
        request,
        "statistics",
        job,
        lambda told: {} if told is None else _context(told),
        found=found,
        filters=choices.filters,
        list_address=choices.address(page=1),
        address=choices.address(page=1) if choices.filters else "",
        pending=[each.title for each in explorer.jobs.all() if not each.is_done],
    )


def _choices(request: Request) -> Choices:
    """What was chosen, without how the list showed it."""
    given = Choices.of(request.query_params.multi_items())
    return Choices(facets=given.facets, query=given.query)


def _found(explorer: Explorer, choices: Choices) -> Found | None:
    """The scenarios that were chosen; None for all."""
    return found_by(explorer.scenarios, choices, explorer.scores) if choices.filters else None


def _is_unclear(found: Found) -> bool:
    """Whether what was chosen is wrong, or not computed yet."""
    return bool(found.faults or found.waiting)


def _job(explorer: Explorer, choices: Choices, found: Found | None) -> Job:
    """The work that counts the scenarios, once for the same ones."""
    if found is None:
        return explorer.jobs.ask(
            _name(found), "statistics", lambda: dataset_statistics(explorer.dataset, workers=explorer.workers)
        )
    chosen = [explorer.scenarios.tokens[row] for row in found.rows.tolist()]
    title = f"statistics of {'; '.join(choices.filters)}"
    return explorer.jobs.ask(
        _name(found), title, lambda: dataset_statistics(explorer.dataset, chosen, workers=explorer.workers)
    )


def _name(found: Found | None) -> str:
    """What the work is known by: the same for the same scenarios, however they were chosen."""
    if found is None:
        return "statistics"
    return f"statistics {hashlib.blake2b(np.sort(found.rows).tobytes(), digest_size=8).hexdigest()}"


def _context(told: DatasetStatistics) -> dict[str, Any]:
    sizes = {name: [round(length * DPI) for length in size] for name, size in STATISTICS_FIGURES.items()}
    return {"told": told, "figures": [(name, _HEADINGS.get(name, name), *size) for name, size in sizes.items()]}


def _figure(request: Request) -> Response:
    explorer, name, choices = explorer_of(request), request.path_params["figure"], _choices(request)
    found = _found(explorer, choices)
    job = None if found is not None and _is_unclear(found) else explorer.jobs.get(_name(found))
    if name not in STATISTICS_FIGURES or job is None or job.state != "ready":
        raise HTTPException(404)

    def draw() -> Any:
        return render_statistics(job.result, name, fig=detached_figure(STATISTICS_FIGURES[name]))

    return picture(explorer.drawn((job.name, name), draw), "png")
