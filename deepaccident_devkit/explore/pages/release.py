"""A release: what it holds, which files are missing, its statistics, findings, maps of towns, and conventions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of, page, part_of, picture, with_slash
from deepaccident_devkit.explore.scenarios import UNKNOWN
from deepaccident_devkit.maps import TownMap, TownMapConfig, kept_town_map, town_map, towns_of
from deepaccident_devkit.maps.counting import looks_of
from deepaccident_devkit.overview import Overview, overview
from deepaccident_devkit.render.axes import detached_figure
from deepaccident_devkit.render.ground import draw_whole_map
from deepaccident_devkit.tables import SEVERITIES
from deepaccident_devkit.taxonomy import AGENTS, SPLITS
from deepaccident_devkit.text import choice
from deepaccident_devkit.validation import (
    CODES,
    Completeness,
    FileCount,
    Finding,
    ValidationReport,
    release_completeness,
    validate_release,
)
from deepaccident_devkit.validation.completeness import summed

TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "files": "Missing files",
    "statistics": "Statistics",
    "findings": "Findings",
    "maps": "Town maps",
    "conventions": "Conventions",
}
"""Last part of the address → its name for readers."""
_SIZE: Final = (8.0, 8.0)
ANY: Final = "any"
"""The severity that stands for all, notes too."""
_NONE: Final = "none"
"""How an overview calls an unknown value."""


def release_page(
    request: Request, tab: str, job: Job | None, tell: Callable[[Any], dict[str, Any]], **context: Any
) -> Response:
    """A page about the release; as long as the work is not done, it says so and loads itself again.

    Args:
        request: for the page.
        tab: of `TABS`.
        job: the work that it waits for; None for none.
        tell: from what the work gave to what the template `release_TAB.html` shows; of no work it gets None.
        **context: what the template shows also while it waits.
    """
    explorer = explorer_of(request)
    state = "ready" if job is None else job.state  # looked at once: it changes at any moment
    if state == "ready":
        context |= tell(None if job is None else job.result)
    return page(
        request,
        f"release_{tab or 'contents'}.html",
        tab=tab,
        tabs=TABS,
        job=job,
        state=state,
        before=[] if job is None else work_before(explorer, job),
        **context,
    )


def work_before(explorer: Explorer, job: Job) -> list[str]:
    """Titles of the work that is done before a job."""
    titles = []
    for each in explorer.jobs.all():
        if each is job:
            break
        titles += [each.title] * (not each.is_done)
    return titles


def pages_of(explorer: Explorer) -> frozenset[str]:
    """The scenarios that have a page: of the index, and broken ones."""
    return frozenset(explorer.scenarios.row_of) | {problem.scenario for problem in explorer.dataset.problems}


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


def _findings(request: Request) -> Response:
    """The files are read only for readers who open this page, since it takes minutes for a whole release."""
    explorer = explorer_of(request)

    def work() -> ValidationReport:
        return validate_release(explorer.dataset.dataroot, explorer.dataset.version, workers=explorer.workers)

    job = explorer.jobs.ask("findings", "what is wrong or missing in the files", work)
    return release_page(request, "findings", job, lambda report: _context(request, explorer, report))


def _context(request: Request, explorer: Explorer, report: ValidationReport) -> dict[str, Any]:
    severity, code = (request.query_params.get(name, "") for name in ("severity", "code"))
    shown = chosen_findings(report.findings, severity=severity, code=code)
    return {
        "report": report,
        "counts": {name: (count, _address(severity=name, code="")) for name, count in report.counts.items()},
        "kinds": [(kind, _address(severity="", code=kind["code"])) for kind in kinds_of(report.findings)],
        "severity": severity,
        "code": code,
        "hidden": 0 if severity or code else report.counts["note"],
        "with_notes": _address(severity=ANY, code=""),
        "without_severity": _address(severity="", code=code),
        "without_code": _address(severity=severity, code=""),
        "part": part_of(request, shown),
        "known": pages_of(explorer),
    }


def chosen_findings(findings: Sequence[Finding], *, severity: str, code: str) -> list[Finding]:
    """Findings of a severity (or `any`) and a code; empty for those that are not chosen by it. Notes must be asked for.

    Args:
        findings: in the order to show.
        severity: of `SEVERITIES`, or `any`; empty for all but notes, and with a code for all.
        code: such as `label-unreadable`.
    """
    wanted: Sequence[str] = (severity,)
    if severity == ANY or (code and not severity):
        wanted = SEVERITIES
    elif not severity:
        wanted = [each for each in SEVERITIES if each != "note"]
    return [each for each in findings if each.severity in wanted and code in ("", each.code)]


def kinds_of(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """How many there are of each kind; the worst first, within them the most frequent.

    A kind has its `code`, `severity`, `count`, how many of them the real release has too (`known`), and its `meaning`.
    """
    counts = Counter((each.severity, each.code) for each in findings)
    known = Counter((each.severity, each.code) for each in findings if each.known)
    rank: Mapping[str, int] = {severity: place for place, severity in enumerate(SEVERITIES)}
    ordered = sorted(counts.items(), key=lambda item: (rank[item[0][0]], -item[1], item[0][1]))
    return [
        {
            "code": code,
            "severity": severity,
            "known": known[severity, code],
            "count": count,
            "meaning": CODES[code].meaning if code in CODES else "",
        }
        for (severity, code), count in ordered
    ]


def _address(**chosen: str) -> str:
    """The parameters of the address with these choices."""
    return f"?{urlencode({name: value for name, value in chosen.items() if value})}"


def routes() -> list[Route]:
    """The addresses; `maps?make=TOWN` makes a map."""
    return [
        Route("/release", with_slash),
        Route("/release/", _contents),
        Route("/release/files", _files),
        Route("/release/conventions", _conventions),
        Route("/release/findings", _findings),
        Route("/release/maps", _maps),
        Route("/release/map/{town}.png", _map),
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
        "lacking": part_of(request, list(told.lacking.items())),
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
