"""The frame of the pages about a release: tabs, work that is waited for, and long lists in pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response

from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.pages.answers import explorer_of, page

Item = TypeVar("Item")
TABS: Final[Mapping[str, str]] = {
    "": "Contents",
    "files": "Missing files",
    "statistics": "Statistics",
    "findings": "Findings",
    "maps": "Town maps",
    "conventions": "Conventions",
}
"""Last part of the address → its name for readers."""
LISTED: Final = 100
"""Entries of a long list on one page."""
_LAST_PAGE: Final = 1_000_000


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A page of a long list.

    Attributes:
        entries: of this page.
        count: of all pages.
        here: number of this page, from 1.
        pages: number of the last page.
        before: parameters of the address of the page before; empty if this is the first one.
        after: of the page after.
    """

    entries: Sequence[Any]
    count: int
    here: int
    pages: int
    before: str
    after: str


def part_of(request: Request, items: Sequence[Item], size: int = LISTED) -> Part:
    """The page of a list that the address names by `page`, with so many entries."""
    given = request.query_params.get("page", "")
    pages = max(1, -(-len(items) // size))
    asked = int(given) if given.isascii() and given.isdigit() and len(given) < len(str(_LAST_PAGE)) else 1
    here = min(max(asked, 1), pages)

    def address(number: int) -> str:
        others = [(name, value) for name, value in request.query_params.multi_items() if name != "page"]
        return f"?{urlencode([*others, ('page', str(number))])}" if 1 <= number <= pages else ""

    return Part(
        entries=items[(here - 1) * size : here * size],
        count=len(items),
        here=here,
        pages=pages,
        before=address(here - 1),
        after=address(here + 1),
    )
