"""Maps of the release's towns: those that are kept, and others when a reader asks for them."""

from __future__ import annotations

from typing import Any, Final

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of, picture
from deepaccident_devkit.explore.pages.release_tabs import release_page
from deepaccident_devkit.maps import TownMap, TownMapConfig, kept_town_map, town_map, towns_of
from deepaccident_devkit.maps.counting import looks_of
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.town_map import draw_whole_map
from deepaccident_devkit.text import choice

_SIZE: Final = (8.0, 8.0)


def routes() -> list[Route]:
    """The addresses. `?make=TOWN` makes a map."""
    return [Route("/release/maps", _maps), Route("/release/map/{town}.png", _map)]


def _maps(request: Request) -> Response:
    explorer, asked = explorer_of(request), request.query_params.get("make")
    if asked is not None:
        _make(explorer, choice("make", asked, towns_of(explorer.dataset)))
        return RedirectResponse("maps", status_code=303)  # so that a reader who loads it again asks for nothing
    entries = [_entry(explorer, town) for town in towns_of(explorer.dataset)]
    waits = [each["job"].title for each in entries if each["job"] is not None and not each["job"].is_done]
    return release_page(request, "maps", None, lambda _: {"towns": entries, "waits": waits})


def _name(town: str) -> str:
    return f"map {town}"


def _make(explorer: Explorer, town: str) -> None:
    """Begin to make a map, which is kept beside the index; where that cannot be written, it stays in memory."""

    def work() -> TownMap | None:
        made = town_map(explorer.dataset, town, workers=explorer.workers)
        return None if kept_town_map(explorer.dataset, town) is not None else made

    explorer.jobs.ask(_name(town), f"the map of {town}", work)


def _found(explorer: Explorer, town: str) -> TownMap | None:
    """A town's map, as far as it was made; raises ChoiceError."""
    kept, job = kept_town_map(explorer.dataset, town), explorer.jobs.get(_name(town))
    return kept if kept is not None or job is None else job.result


def _entry(explorer: Explorer, town: str) -> dict[str, Any]:
    """What the page shows of a town."""
    found, job = _found(explorer, town), explorer.jobs.get(_name(town))
    return {
        "town": town,
        "map": found,
        "job": job,
        "scenarios": sum(record["town"] == town for record in explorer.scenarios.records),
        "pictures": 0 if found is not None else _pictures(explorer, town),
    }


def _pictures(explorer: Explorer, town: str) -> int:
    """How many pictures of BEV cameras a new map would be made from, if their files are all here."""
    rows = [row for row, record in enumerate(explorer.scenarios.records) if record["town"] == town]
    config = TownMapConfig()
    return sum(len(looks.sample_rows) for row in rows for looks in looks_of(explorer.dataset, row, config))


def _map(request: Request) -> Response:
    explorer, town = explorer_of(request), request.path_params["town"]
    found = _found(explorer, town)
    if found is None:
        raise NotAvailableError(f"{town}: its map is not made yet")

    def draw() -> Any:
        figure = detached_figure(_SIZE)
        draw_whole_map(found, figure.subplots())
        return figure

    return picture(explorer.drawn(("map", town, found.looks, found.missing, found.damaged), draw), "png")
