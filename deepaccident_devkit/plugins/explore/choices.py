"""The reader's choices among the scenarios, and the scenarios that match them.

Choices are read from an address, and written as filters and as code.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal
from urllib.parse import urlencode

import numpy as np

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.plugins.explore.scenarios import Facet, Scenarios
from deepaccident_devkit.selection import parse_where
from deepaccident_devkit.selection.conditions import check_condition
from deepaccident_devkit.selection.fields import FIELDS, find_field
from deepaccident_devkit.support.arrays import BoolArray, IntArray
from deepaccident_devkit.support.human_names import human_name

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.background import Job
    from deepaccident_devkit.plugins.explore.models import Model

_ListView = Literal["grid", "table"]
_SortDirection = Literal["up", "down"]
# Columns to sort by; `score:MODEL` is another such column.
SORTS: Final = ("name", "num_frames", "accident_visibility", "lead", "lead_all", "min_ttc")
SCORE_PREFIX: Final = "score:"
SCENARIOS_PER_PAGE: Final = 48
# Largest number of characters of a query.
_MAX_QUERY_LENGTH = 2000
# Largest number of filters in a query, and of values that no facet has.
_MAX_FREE_VALUES = 100
# Largest number of characters of a value or another word of an address, since it is repeated in
# many links of a page.
MAX_WORD_LENGTH: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """A reader's choices among the scenarios.

    Attributes:
        facets: Texts of the chosen values, by field; a scenario must match one of each field's.
        query: More filters, one on each line or separated by semicolons.
        sort: Column to sort by, one of `SORTS` or `score:MODEL`.
        order: Order of the sorting; `up` is from low to high.
        view: Kind of the list, `grid` of pictures or `table`.
        page: Number of the page, from 1.
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
        """Return the choices in the parameters of an address.

        Parameters that make no sense are ignored, so that no address fails. An address may come
        from anyone, so it may not make a page arbitrarily long: values that scenarios have are
        always accepted, but only a small number of other values is.
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
        """Return these choices as the parameters of an address, such as `?town=Town03&sort=lead`.

        Keyword arguments change some of the choices.
        """
        choices = replace(self, **changes)
        pairs = []
        for name, values in choices.facets.items():
            pairs += [(name, value) for value in values]
        if choices.query:
            pairs.append(("q", choices.query))
        if choices.sort != "name":
            pairs.append(("sort", choices.sort))
        if choices.order != "up":
            pairs.append(("order", choices.order))
        if choices.view != "grid":
            pairs.append(("view", choices.view))
        if choices.page > 1:
            pairs.append(("page", str(choices.page)))
        return f"?{urlencode(pairs)}"

    @property
    def filters(self) -> list[str]:
        """All choices as filter texts for `da.find` and `--where`."""
        facets = []
        for name, values in self.facets.items():
            words = ",".join(values)
            facets.append(f"{name}={words}")
        return [*facets, *self.lines]

    @property
    def lines(self) -> list[str]:
        """The filters of the query, each once."""
        lines = [line.strip() for line in re.split(r"[;\n]", self.query)]
        unique_lines = dict.fromkeys(filter(None, lines))
        return list(unique_lines)[:_MAX_FREE_VALUES]

    def python(self) -> str:
        """Return the call that finds the same scenarios."""
        return format_find_call(self.filters)

    def command(self, dataroot: str) -> str:
        """Return the command that writes the same scenarios into a split file."""
        options = [*format_where_options(self.filters), "--out", "selection.txt"]
        return shlex.join(["deepaccident", "split", dataroot, *options])


def format_find_call(filters: Iterable[str]) -> str:
    """Return the Python call that finds the scenarios matching these filters."""
    return f"da.find({', '.join(map(repr, filters))})"


def format_where_options(filters: Iterable[str]) -> list[str]:
    """Return filters as `--where` options of a command line."""
    words = []
    for condition in filters:
        words += ["--where", condition]
    return words


@dataclass(frozen=True, slots=True, kw_only=True)
class Matches:
    """The scenarios that match some choices.

    Attributes:
        rows: Rows of the scenarios, sorted.
        counts: Values of each facet, by field. Each has its `value`, the `count` of scenarios with
            it that match all choices except this field's, and whether it is `chosen`.
        faults: Filter that is wrong, and therefore not applied → sentence about its error.
        waiting: Sentences about columns that are not computed yet.
    """

    rows: IntArray
    counts: Mapping[str, tuple[dict[str, Any], ...]]
    faults: Mapping[str, str]
    waiting: tuple[str, ...]


def match_scenarios(scenarios: Scenarios, choices: Choices, scores: Mapping[str, Model]) -> Matches:
    """Return the scenarios that match all choices; models' scores may not be computed yet.

    Args:
        scenarios: Columns of the scenarios.
        choices: Choices of the reader.
        scores: Models with scores, by column (`score:MODEL`).
    """
    facets = scenarios.facets()
    masks = {}
    for facet in facets:
        if facet.name in choices.facets:
            chosen_values = choices.facets[facet.name]
            codes = [code for code, value in enumerate(facet.values) if value in chosen_values]
            masks[facet.name] = np.isin(facet.codes, codes)
    other_fields = [name for name in choices.facets if name not in masks]
    mask, faults, waiting = _match_query(scenarios, choices, other_fields)
    misses = np.zeros(len(scenarios), dtype=np.int64)
    for facet_mask in masks.values():
        misses = misses + ~facet_mask
    counts = {}
    for facet in facets:
        # Count the rows that no other facet excludes.
        own_misses = ~masks.get(facet.name, np.True_)
        rows = mask & (misses == own_misses)
        chosen_values = choices.facets.get(facet.name, ())
        counts[facet.name] = _count_values(facet, rows, chosen_values)
    matches = np.flatnonzero(mask & (misses == 0))
    sorted_rows, sorts_waiting = _sort_rows(scenarios, choices, matches, scores)
    return Matches(
        rows=sorted_rows,
        counts=counts,
        faults=faults,
        waiting=(*waiting, *sorts_waiting),
    )


def _count_values(
    facet: Facet, rows: BoolArray, chosen_values: Sequence[str]
) -> tuple[dict[str, Any], ...]:
    counts = np.bincount(facet.codes[rows], minlength=len(facet.values))
    values = []
    for value, count in zip(facet.values, counts.tolist(), strict=True):
        values.append({"value": value, "count": count, "chosen": value in chosen_values})
    return tuple(values)


def _match_query(
    scenarios: Scenarios, choices: Choices, fields: Sequence[str]
) -> tuple[BoolArray, dict[str, str], list[str]]:
    """Apply the query's conditions and the chosen values of `fields`, which have no facet (yet).

    Returns:
        Whether each scenario matches, shape (N,); condition → error message, for conditions that
        are wrong; and messages about conditions on columns that are still being computed.
    """
    mask = np.ones(len(scenarios), dtype=bool)
    faults = {}
    waiting = []
    field_filters = [f"{name}={','.join(choices.facets[name])}" for name in fields]
    for line in [*field_filters, *choices.lines]:
        try:
            clause = parse_where(line)
            column = find_field(clause.name)
            job = scenarios.late(column.name)
            if job is not None:
                waiting.append(_explain_waiting(line, job))
                continue
            values = scenarios.values(column.name) or []
            words = _collect_words(values) if column.kind == "word" else ()
            condition = check_condition(clause, column, words)
            mask &= np.array([condition.holds(value) for value in values], dtype=bool)
        except DeepAccidentError as error:
            faults[line] = f"{line} is not applied: {error}"
    return mask, faults, waiting


def _collect_words(values: Sequence[Any]) -> set[Any]:
    """Return the distinct values of scenarios; a tuple counts as several values."""
    words: set[Any] = set()
    for value in values:
        words.update(value if isinstance(value, tuple) else (value,))
    return words


def sort_title(column: str) -> str:
    """Return the name for readers of a column to sort by."""
    if column.startswith(SCORE_PREFIX):
        return f"score of {column.removeprefix(SCORE_PREFIX)}"
    return human_name(column, "attributes")


def _explain_waiting(subject: str, job: Job) -> str:
    if job.state == "failed":
        return f"{subject} cannot be computed ({job.error})"
    return f"{subject} is not applied yet, since it is being computed ({job.title})"


def _sort_rows(
    scenarios: Scenarios, choices: Choices, rows: IntArray, scores: Mapping[str, Model]
) -> tuple[IntArray, list[str]]:
    """Sort rows by the chosen column, unknown values last; also return what is still computed."""
    column = choices.sort
    if column == "name" or (column not in SORTS and column not in scores):
        return rows if choices.order == "up" else rows[::-1], []
    model = scores.get(column)
    if model is None:
        job = scenarios.late(column)
        numbers = scenarios.numbers(column)
    else:
        job = model.job if model.scores is None else None
        numbers = model.numbers(scenarios)
    if job is not None:
        return rows, [_explain_waiting(f"the order by {sort_title(column)}", job)]
    if numbers is None:
        return rows, []
    keys = numbers[rows]
    if choices.order == "down":
        keys = -keys
    order = np.argsort(keys, kind="stable")  # NaN is last in both orders.
    return rows[order], []
