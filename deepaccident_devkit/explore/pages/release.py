"""A release: what it holds, the maps of its towns, and conventions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore.background import Job, State
from deepaccident_devkit.explore.pages.answers import explorer_of, page, picture, with_slash
from deepaccident_devkit.explore.scenarios import UNKNOWN
from deepaccident_devkit.maps import kept_town_map, towns_of
from deepaccident_devkit.maps.pictures import draw_whole_map
from deepaccident_devkit.overview import Overview, overview
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.taxonomy import SPLITS

TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "maps": "Town maps",
    "conventions": "Conventions",
}
"""Last part of the address → its name for readers."""
_SIZE: Final = (8.0, 8.0)
_NONE: Final = "none"
"""How an overview calls an unknown value."""


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/release", with_slash),
        Route("/release/", _contents),
        Route("/release/conventions", _conventions),
        Route("/release/maps", _maps),
        Route("/release/map/{town}.png", _map),
    ]


def _page(request: Request, tab: str, *, job: Job | None = None, state: State = "ready", **context: Any) -> Response:
    """A page about the release; as long as a job's state says that it is not done, the page loads itself again."""
    return page(request, f"release_{tab or 'contents'}.html", tab=tab, tabs=TABS, job=job, state=state, **context)


def _contents(request: Request) -> Response:
    """Counted in the background, since the folders of all sensors are listed."""
    explorer = explorer_of(request)
    job = explorer.jobs.ask("overview", "what the release holds", lambda: overview(explorer.dataset))
    state = job.state  # looked at once: it changes at any moment
    return _page(request, "", job=job, state=state, **(_overview_context(job.result) if state == "ready" else {}))


def _overview_context(told: Overview) -> dict[str, Any]:
    """What the overview's template shows: counts, those of attributes with the values that the list knows them by."""
    of_splits = set(told.expected) == set(SPLITS)
    return {
        "told": told,
        "splits": [(name, count, told.expected.get(name)) for name, count in told.splits.items()],
        "whole": None if of_splits else sum(told.expected.values()),
        "attributes": {
            field: [(UNKNOWN if value == _NONE else value, count) for value, count in counts.items()]
            for field, counts in told.attributes.items()
        },
    }


def _maps(request: Request) -> Response:
    """The maps that are kept beside the index."""
    dataset = explorer_of(request).dataset
    return _page(request, "maps", towns={town: kept_town_map(dataset, town) for town in towns_of(dataset)})


def _map(request: Request) -> Response:
    explorer, town = explorer_of(request), request.path_params["town"]
    found = kept_town_map(explorer.dataset, town)
    if found is None:
        raise NotAvailableError(f"{town}: its map is not made yet")

    def draw() -> Any:
        figure = detached_figure(_SIZE)
        draw_whole_map(found, figure.subplots())
        return figure

    return picture(explorer.drawn(("map", town, found.looks, found.missing, found.damaged), draw), "png")


def _conventions(request: Request) -> Response:
    return _page(request, "conventions")
