"""What a reader chose of the scenarios, and the scenarios that match.

Choices are read from an address, and written as filters and as code.
"""

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
# Column → its name for readers; `score:MODEL` is another column.
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
# Largest number of characters of a query.
_MAX_QUERY_LENGTH: Final = 2000
# Largest number of filters of a query, and of values in total that no facet has.
_MAX_FREE_VALUES: Final = 100
# Largest number of characters of a value, or of another word of an address, since it stands in many
# links of a page.
MAX_WORD_LENGTH: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """What a reader chose.

    Attributes:
        facets: Field → texts of its values; a scenario must match one of them.
        query: More filters, one for each line or separated by semicolons.
        sort: One of `SORTS`, or `score:MODEL`.
        order: Order of the sorting: `up` is from low to high.
        view: `grid` of pictures, or `table`.
        page: Page number, from 1.
    """

    facets: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    query: str = ""
    sort: str = "name"
    order: _SortDirection = "up"
    view: _ListView = "grid"
    page: int = 1

    @classmethod
    def of(
        cls, parameters: Sequence[tuple[str, str]], scenarios: Scenarios | None = None
    ) -> Choices:
        """Return the choices of the parameters of an address.

        Parameters that make no sense are left out, so that no address fails. An address may come
        from anyone, so it cannot ask for more than a page has. All values that the scenarios have
        count, others only if they are few.
        """
        known_values: dict[str, frozenset[str]] = {}
        if scenarios is not None:
            known_values = {facet.name: frozenset(facet.values) for facet in scenarios.facets()}
        settings = {name: value for name, value in parameters if name not in FIELDS}
        facets: dict[str, tuple[str, ...]] = {}
        num_unknown = 0
        for name, value in dict.fromkeys(parameters):
            if name not in FIELDS or len(value) > MAX_WORD_LENGTH:
                continue
            is_known = value in known_values.get(name, ())
            num_unknown += not is_known
            if is_known or num_unknown <= _MAX_FREE_VALUES:
                facets[name] = (*facets.get(name, ()), value)
        page = settings.get("page", "")
        return cls(
            facets=facets,
            query=settings.get("q", "").strip()[:_MAX_QUERY_LENGTH],
            sort=settings.get("sort", "name")[:MAX_WORD_LENGTH],
            order="down" if settings.get("order") == "down" else "up",
            view="table" if settings.get("view") == "table" else "grid",
            page=int(page) if re.fullmatch(r"[1-9]\d{0,5}", page) else 1,
        )

    def address(self, **changes: Any) -> str:
        """Return the parameters of the address with these choices: `?town=Town03&sort=lead`.

        Keyword arguments change some of the choices.
        """
        choices = replace(self, **changes)
        pairs = [(name, value) for name, values in choices.facets.items() for value in values]
        fields = ("q", "sort", "order", "view")
        values = (choices.query, choices.sort, choices.order, choices.view)
        defaults = ("", "name", "up", get_args(_ListView)[0])
        for name, value, default in zip(fields, values, defaults, strict=True):
            if value != default:
                pairs.append((name, value))
        if choices.page > 1:
            pairs.append(("page", str(choices.page)))
        return f"?{urlencode(pairs)}"

    @property
    def filters(self) -> list[str]:
        """Filters of all choices, as texts for `da.find` and `--where`."""
        facets = (f"{name}={','.join(values)}" for name, values in self.facets.items())
        return [*facets, *self.lines]

    @property
    def lines(self) -> list[str]:
        """Filters of the query."""
        lines = (line.strip() for line in re.split(r"[;\n]", self.query))
        return [line for line in dict.fromkeys(lines) if line][:_MAX_FREE_VALUES]

    def python(self) -> str:
        """Return the call that finds the same scenarios."""
        return find_call(self.filters)

    def command(self, dataroot: str) -> str:
        """Return the command that writes the same scenarios into a split file."""
        options = [*where_words(self.filters), "--out", "selection.txt"]
        return shlex.join(["deepaccident", "split", dataroot, *options])


def find_call(filters: Iterable[str]) -> str:
    """Return filters as the Python call that finds the same scenarios."""
    return f"da.find({', '.join(map(repr, filters))})"


def where_words(filters: Iterable[str]) -> list[str]:
    """Return filters as words of a command line."""
    return [word for condition in filters for word in ("--where", condition)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Matches:
    """The scenarios that match some choices.

    Attributes:
        rows: Rows of the scenarios, sorted.
        counts: Field → its values, each with its `value`, the `count` of scenarios that match all
            but the other values of this field, and whether it is `chosen`.
        faults: Sentences on errors in the query.
        waiting: Sentences on columns that are not computed yet.
    """

    rows: IntArray
    counts: Mapping[str, tuple[dict[str, Any], ...]]
    faults: tuple[str, ...]
    waiting: tuple[str, ...]


def match_scenarios(scenarios: Scenarios, choices: Choices, scores: Mapping[str, Model]) -> Matches:
    """Return the scenarios that match all choices; models' scores may still be computed.

    Args:
        scenarios: Columns of the scenarios.
        choices: What the reader chose.
        scores: Column `score:MODEL` → model.
    """
    facets = scenarios.facets()
    selected = {
        facet.name: choices.facets[facet.name] for facet in facets if facet.name in choices.facets
    }
    masks = {
        facet.name: _mask(facet, selected[facet.name]) for facet in facets if facet.name in selected
    }
    other_fields = [name for name in choices.facets if name not in selected]
    mask, faults, waiting = _match_query(scenarios, choices, other_fields)
    misses = np.zeros(len(scenarios), dtype=np.int64)
    for facet_mask in masks.values():
        misses = misses + ~facet_mask
    counts = {}
    for facet in facets:
        # Count the rows that no other facet excludes.
        own_misses = ~masks.get(facet.name, np.True_)
        rows = mask & (misses == own_misses)
        counts[facet.name] = _counts(facet, rows, selected.get(facet.name, ()))
    matches = np.flatnonzero(mask & (misses == 0))
    sorted_rows, sorts_waiting = _sorted_rows(scenarios, choices, matches, scores)
    return Matches(
        rows=sorted_rows,
        counts=counts,
        faults=tuple(faults),
        waiting=(*waiting, *sorts_waiting),
    )


def _mask(facet: Facet, values: Sequence[str]) -> BoolArray:
    codes = [code for code, value in enumerate(facet.values) if value in values]
    return np.isin(facet.codes, codes)


def _counts(facet: Facet, rows: BoolArray, selected: Sequence[str]) -> tuple[dict[str, Any], ...]:
    counts = np.bincount(facet.codes[rows], minlength=len(facet.values)).tolist()
    return tuple(
        {"value": value, "count": count, "chosen": value in selected}
        for value, count in zip(facet.values, counts, strict=True)
    )


def _match_query(
    scenarios: Scenarios, choices: Choices, fields: Sequence[str]
) -> tuple[BoolArray, list[str], list[str]]:
    """Match the query, and the choices of fields that are no facets (yet).

    Returns:
        Whether each scenario matches, shape (N,); faults; and conditions that wait for a column.
    """
    mask = np.ones(len(scenarios), dtype=bool)
    faults, waiting = [], []
    field_filters = [f"{name}={','.join(choices.facets[name])}" for name in fields]
    for line in [*field_filters, *choices.lines]:
        try:
            clause = parse_where(line)
            column = field_of(clause.name)
            job = scenarios.late(column.name)
            if job is not None:
                waiting.append(_waiting_text(line, job))
                continue
            values = scenarios.values(column.name) or []
            words = _words(values) if column.kind == "word" else ()
            condition = condition_of(clause, column, words)
            mask &= np.array([condition.holds(value) for value in values], dtype=bool)
        except DeepAccidentError as error:
            faults.append(str(error))
    return mask, faults, waiting


def _words(values: Sequence[Any]) -> set[Any]:
    """Return the different values; a tuple counts as several."""
    words: set[Any] = set()
    for value in values:
        words.update(value if isinstance(value, tuple) else (value,))
    return words


def _waiting_text(subject: str, job: Job) -> str:
    if job.state == "failed":
        return f"{subject}: cannot be computed ({job.error})"
    return f"{subject}: is being computed ({job.title}); it counts as soon as it is there"


def _sorted_rows(
    scenarios: Scenarios, choices: Choices, rows: IntArray, scores: Mapping[str, Model]
) -> tuple[IntArray, list[str]]:
    """Return rows by the chosen column, unknown values last, and what they wait for."""
    column = choices.sort
    if column == "name" or (column not in SORTS and column not in scores):
        return rows if choices.order == "up" else rows[::-1], []
    model = scores.get(column)
    if model is None:
        job, numbers = scenarios.late(column), scenarios.numbers(column)
    else:
        job, numbers = model.job if model.scores is None else None, model.numbers(scenarios)
    if job is not None:
        return rows, [_waiting_text(f"sorted by {column}", job)]
    if numbers is None:
        return rows, []
    keys = numbers[rows]
    if choices.order == "down":
        keys = -keys
    return rows[np.argsort(keys, kind="stable")], []  # NaN is last in both orders
