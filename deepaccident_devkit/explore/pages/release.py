"""A release: what it holds, which files are missing, its statistics, findings, maps of towns, and conventions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages import findings, maps, statistics
from deepaccident_devkit.explore.pages.answers import explorer_of, with_slash
from deepaccident_devkit.explore.pages.release_tabs import pages_of, part_of, release_page
from deepaccident_devkit.explore.scenarios import UNKNOWN
from deepaccident_devkit.overview import Overview, overview
from deepaccident_devkit.taxonomy import AGENTS, SPLITS
from deepaccident_devkit.validation import Completeness, FileCount, LackingScenario, release_completeness
from deepaccident_devkit.validation.completeness_report import summed

_NONE: Final = "none"
"""How an overview calls an unknown value."""


def routes() -> list[Route]:
    """The addresses."""
    return [
        Route("/release", with_slash),
        Route("/release/", _contents),
        Route("/release/files", _files),
        Route("/release/conventions", _conventions),
        *statistics.routes(),
        *findings.routes(),
        *maps.routes(),
    ]


def _conventions(request: Request) -> Response:
    return release_page(request, "conventions", None, lambda _: {})


# what it holds


def _contents(request: Request) -> Response:
    """Counted in the background, since the folders of all sensors are listed."""
    explorer = explorer_of(request)
    job = explorer.jobs.ask("overview", "what the release holds", lambda: overview(explorer.dataset))
    return release_page(request, "", job, _overview_context)


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


# which files are missing


def _files(request: Request) -> Response:
    """Asks for the size of every file, so that it is done only for readers who open this page."""
    explorer = explorer_of(request)

    def work() -> Completeness:
        return release_completeness(explorer.dataset.dataroot, explorer.dataset.version, workers=explorer.workers)

    job = explorer.jobs.ask("files", "which files are missing", work)
    return release_page(request, "files", job, lambda told: _files_context(request, explorer, told))


def _files_context(request: Request, explorer: Explorer, told: Completeness) -> dict[str, Any]:
    counts = [count for split in told.splits.values() for count in split.files]
    return {
        "told": told,
        "splits": {name: summed(split.files, name) for name, split in told.splits.items()},
        "kinds": {kind: _by_agent(counts, kind) for kind in dict.fromkeys(count.channel for count in counts)},
        "agents": AGENTS,
        "lacking": part_of(request, [(each, _lacks(each)) for each in told.lacking]),
        "known": pages_of(explorer),
    }


def _by_agent(counts: Sequence[FileCount], kind: str) -> list[FileCount | None]:
    """The files of a kind of each agent, then of all; None where the kind is no agent's."""
    of_kind = [count for count in counts if count.channel == kind]
    cells: list[FileCount | None] = []
    for agent in AGENTS:
        own = [count for count in of_kind if count.agent == agent]
        cells.append(summed(own, kind, agent) if own else None)
    return [*cells, summed(of_kind, kind)]


def _lacks(scenario: LackingScenario) -> str:
    """What a scenario lacks of the agents that are not absent, by kind of file."""
    kinds = dict.fromkeys(count.channel for count in scenario.files)
    sums = [summed((count for count in scenario.files if count.channel == kind), kind) for kind in kinds]
    return ", ".join(f"{each.channel} ({each.missing:,})" for each in sums)
