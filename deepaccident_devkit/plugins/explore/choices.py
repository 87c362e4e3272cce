"""What a reader chose of the scenarios: in an address, as filters, as code; and the scenarios that it comes to."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args
from urllib.parse import urlencode

import numpy as np

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.plugins.explore.scenarios import Facet, Scenarios
from deepaccident_devkit.selection import parse_where
from deepaccident_devkit.selection.conditions import condition_of
from deepaccident_devkit.selection.fields import FIELDS, field_of
from deepaccident_devkit.support.arrays import BoolArray, IntArray

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.background import Job
    from deepaccident_devkit.plugins.explore.models import Model

_ListView = Literal["grid", "table"]
_SortDirection = Literal["up", "down"]
# Column → its name for readers; `score:MODEL` is another.
SORTS: Final[Mapping[str, str]] = {
    "name": "name",
    "num_frames": "length",
    "accident_visibility": "visibility",
    "lead": "lead time of the ego",
    "lead_all": "lead time of all agents",
    "min_ttc": "least TTC",
}
SCORE_PREFIX: Final = "score:"
SCENARIOS_PER_PAGE: Final = 48
# Characters.
_MOST_QUERY: Final = 2000
_MOST_FREE: Final = 100  # filters of a query; values, in sum, that no facet has
MOST_WORD: Final = 100  # characters of a value, or of another word of an address: it stands in many links of a page


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """What a reader chose.

    Attributes:
        facets: field → the values, one of which must match, as texts.
        query: more filters, one a line or between semicolons.
        sort: of `SORTS`, or `score:MODEL`.
        order: of the sorting: `up` is from low to high.
        view: `grid` of pictures, or `table`.
        page: from 1.
    """

    facets: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    query: str = ""
    sort: str = "name"
    order: _SortDirection = "up"
    view: _ListView = "grid"
    page: int = 1

    @classmethod
    def of(cls, given: Sequence[tuple[str, str]], scenarios: Scenarios | None = None) -> Choices:
        """Those of the parameters of an address; what makes no sense is left out, so that no address fails.

        An address may come from anyone, so it cannot ask for more than a page has. Values that the scenarios have all
        count, others only if they are few.
        """
        known = (
            {}
            if scenarios is None
            else {each.name: frozenset(each.values) for each in scenarios.facets()}
        )
        others = {name: value for name, value in given if name not in FIELDS}
        facets: dict[str, tuple[str, ...]] = {}
        unknown = 0
        for name, value in dict.fromkeys(
            pair for pair in given if pair[0] in FIELDS and len(pair[1]) <= MOST_WORD
        ):
            unknown += value not in known.get(name, ())
            if unknown <= _MOST_FREE or value in known.get(name, ()):
                facets[name] = (*facets.get(name, ()), value)
        page = others.get("page", "")
        return cls(
            facets=facets,
            query=others.get("q", "").strip()[:_MOST_QUERY],
            sort=others.get("sort", "name")[:MOST_WORD],
            order="down" if others.get("order") == "down" else "up",
            view="table" if others.get("view") == "table" else "grid",
            page=int(page) if re.fullmatch(r"[1-9]\d{0,5}", page) else 1,
        )

    def address(self, **changed: Any) -> str:
        """The parameters of the address that has these choices, with some changed: `?town=Town03&sort=lead`."""
        chosen = replace(self, **changed)
        pairs = [(name, value) for name, values in chosen.facets.items() for value in values]
        plain = {"q": chosen.query, "sort": chosen.sort, "order": chosen.order, "view": chosen.view}
        usual = {"q": "", "sort": "name", "order": "up", "view": get_args(_ListView)[0]}
        pairs += [(name, value) for name, value in plain.items() if value != usual[name]]
        pairs += [("page", str(chosen.page))] * (chosen.page > 1)
        return f"?{urlencode(pairs)}"

    @property
    def filters(self) -> list[str]:
        """The texts of `da.find` and `--where`."""
        return [
            *(f"{name}={','.join(values)}" for name, values in self.facets.items()),
            *self.lines,
        ]

    @property
    def lines(self) -> list[str]:
        """The filters of the query."""
        lines = (line.strip() for line in re.split(r"[;\n]", self.query))
        return [line for line in dict.fromkeys(lines) if line][:_MOST_FREE]

    def python(self) -> str:
        """The call that finds the same scenarios."""
        return find_call(self.filters)

    def command(self, dataroot: str) -> str:
        """The command that writes the same scenarios into a split file."""
        return shlex.join(
            [
                "deepaccident",
                "split",
                dataroot,
                *where_words(self.filters),
                "--out",
                "selection.txt",
            ]
        )


def find_call(filters: Iterable[str]) -> str:
    """Filters as the Python call that finds the same scenarios."""
    return f"da.find({', '.join(map(repr, filters))})"


def where_words(filters: Iterable[str]) -> list[str]:
    """Filters as words of a command line."""
    return [word for each in filters for word in ("--where", each)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The scenarios that choices come to.

    Attributes:
        rows: their rows, sorted.
        counts: field → its values: each `value`, the `count` of scenarios that match all but the other values of this
            field, and whether it is `chosen`.
        faults: sentences on what is wrong in the query.
        waiting: sentences on what is not computed yet.
    """

    rows: IntArray
    counts: Mapping[str, tuple[dict[str, Any], ...]]
    faults: tuple[str, ...]
    waiting: tuple[str, ...]


def found_by(scenarios: Scenarios, choices: Choices, scores: Mapping[str, Model]) -> Found:
    """The scenarios that match all that was chosen; models' scores (`score:MODEL`) may still be computed."""
    facets = scenarios.facets()
    chosen = {
        each.name: choices.facets[each.name] for each in facets if each.name in choices.facets
    }
    masks = {
        each.name: _matching(each, chosen[each.name]) for each in facets if each.name in chosen
    }
    rest, faults, waiting = _by_query(
        scenarios, choices, [name for name in choices.facets if name not in chosen]
    )
    missed = sum((~mask for mask in masks.values()), np.zeros(len(scenarios), dtype=np.int64))
    counts = {  # of the rows that no other facet misses
        each.name: _counts(
            each, rest & (missed == ~masks.get(each.name, np.True_)), chosen.get(each.name, ())
        )
        for each in facets
    }
    ranked, not_ready = _sorted(scenarios, choices, np.flatnonzero(rest & (missed == 0)), scores)
    return Found(rows=ranked, counts=counts, faults=tuple(faults), waiting=(*waiting, *not_ready))


def _matching(facet: Facet, values: Sequence[str]) -> BoolArray:
    return np.isin(
        facet.codes, [place for place, value in enumerate(facet.values) if value in values]
    )


def _counts(facet: Facet, rows: BoolArray, chosen: Sequence[str]) -> tuple[dict[str, Any], ...]:
    counted = np.bincount(facet.codes[rows], minlength=len(facet.values)).tolist()
    return tuple(
        {"value": value, "count": count, "chosen": value in chosen}
        for value, count in zip(facet.values, counted, strict=True)
    )


def _by_query(
    scenarios: Scenarios, choices: Choices, plain: Sequence[str]
) -> tuple[BoolArray, list[str], list[str]]:
    """Which scenarios match the query, chosen values of fields that are no facets (yet), faults, what is awaited."""
    matching = np.ones(len(scenarios), dtype=bool)
    faults, waiting = [], []
    for line in [*(f"{name}={','.join(choices.facets[name])}" for name in plain), *choices.lines]:
        try:
            wanted = parse_where(line)
            looked = field_of(wanted.name)
            late = scenarios.late(looked.name)
            if late is not None:
                waiting.append(_waiting_text(line, late))
                continue
            values = scenarios.values(looked.name) or []
            words = {
                word
                for value in values
                for word in (value if isinstance(value, tuple) else (value,))
            }
            condition = condition_of(wanted, looked, words if looked.kind == "word" else ())
            matching &= np.array([condition.holds(value) for value in values], dtype=bool)
        except DeepAccidentError as error:
            faults.append(str(error))
    return matching, faults, waiting


def _waiting_text(what: str, job: Job) -> str:
    if job.state == "failed":
        return f"{what}: cannot be computed ({job.error})"
    return f"{what}: is being computed ({job.title}); it counts as soon as it is there"


def _sorted(
    scenarios: Scenarios, choices: Choices, rows: IntArray, scores: Mapping[str, Model]
) -> tuple[IntArray, list[str]]:
    """Rows by the column of choice, unknown values last, and what is waited for."""
    if choices.sort == "name" or (choices.sort not in SORTS and choices.sort not in scores):
        return rows if choices.order == "up" else rows[::-1], []
    model = scores.get(choices.sort)
    if model is None:
        late, numbers = scenarios.late(choices.sort), scenarios.numbers(choices.sort)
    else:
        late, numbers = model.job if model.scores is None else None, model.numbers(scenarios)
    if late is not None or numbers is None:
        return rows, [] if late is None else [_waiting_text(f"sorted by {choices.sort}", late)]
    keys = numbers[rows]
    keys = keys if choices.order == "up" else -keys
    return rows[np.argsort(keys, kind="stable")], []  # NaN is last in both orders
