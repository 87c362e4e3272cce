"""The Markdown table of found and missed faults, made from the outcomes of a run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fault_injection.mutations import MUTATIONS, Mutation
from fault_injection.run import Outcome

_HEAD = """# What `deepaccident validate` finds

*Needs* is the option that `validate` needs.

"""
_SUMMARY = """Of {count} faults of {kinds} kinds, {found} are found, {harmless} are harmless, and
{missed} are missed. {beyond} further kinds need not be found.
"""
_COLUMNS = ("kind", "what is done", "needs", "applied", "found", "verdict", "found by, or why not")


@dataclass(frozen=True, slots=True)
class Row:
    """One kind of mutation and the outcomes of its applications."""

    mutation: Mutation
    outcomes: Sequence[Outcome]

    @property
    def found(self) -> int:
        """Number of applications that were found."""
        return sum(outcome.found for outcome in self.outcomes)

    @property
    def verdict(self) -> str:
        """`found`, `harmless`, `missed`, or `by chance` if only found sometimes."""
        if self.mutation.harmless is not None:
            return "harmless"
        if self.mutation.beyond is not None and self.found:
            return "by chance"
        return "found" if self.found == len(self.outcomes) else "missed"

    def cells(self) -> list[str]:
        """Return the cells of the row."""
        codes: set[str] = set()
        for outcome in self.outcomes:
            codes.update(outcome.errors, outcome.warnings)
        quoted_codes = ", ".join(f"`{code}`" for code in sorted(codes))
        reason = self.mutation.harmless or self.mutation.beyond
        return [
            f"`{self.mutation.name}`",
            self.mutation.title,
            "`--deep`" if self.mutation.deep else "",
            str(len(self.outcomes)),
            str(self.found),
            self.verdict,
            "; ".join(filter(None, (reason, quoted_codes))),
        ]


def make_rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """Make one row for each kind of mutation, in the order of the groups."""
    outcomes_by_name: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        outcomes_by_name.setdefault(outcome.job.name, []).append(outcome)
    return [
        Row(mutation, outcomes_by_name[name])
        for name, mutation in MUTATIONS.items()
        if name in outcomes_by_name
    ]


def to_markdown(outcomes: Sequence[Outcome]) -> str:
    """Return a page with all kinds of mutations and the findings for each."""
    parts = [_HEAD + summary(outcomes)]
    for group, rows in _group_rows(make_rows(outcomes)).items():
        title = f"## {group[0].upper()}{group[1:]}"
        lines = [_format_line(row.cells()) for row in rows]
        parts.append("\n".join([title, "", *_header(_COLUMNS), *lines, ""]))
    return "\n".join(parts)


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the part of docs/validation.md that describes a run."""
    rows = make_rows(outcomes)
    required_rows = [row for row in rows if row.mutation.beyond is None]
    num_found, num_harmless, num_missed = _count_applications(required_rows)
    return _SUMMARY.format(
        found=num_found,
        harmless=num_harmless,
        missed=num_missed,
        count=num_found + num_harmless + num_missed,
        kinds=len(required_rows),
        beyond=len(rows) - len(required_rows),
    )


def _count_applications(rows: Sequence[Row]) -> tuple[int, int, int]:
    """Return the numbers of applications that were found, are harmless and were missed."""
    total = sum(len(row.outcomes) for row in rows)
    num_harmless = sum(len(row.outcomes) for row in rows if row.verdict == "harmless")
    num_found = sum(row.found for row in rows if row.verdict != "harmless")
    return num_found, num_harmless, total - num_found - num_harmless


def _group_rows(rows: Iterable[Row]) -> dict[str, list[Row]]:
    rows_by_group: dict[str, list[Row]] = {}
    for row in rows:
        rows_by_group.setdefault(row.mutation.group, []).append(row)
    return rows_by_group


def _header(columns: Sequence[str]) -> list[str]:
    return [_format_line(columns), _format_line(["---"] * len(columns))]


def _format_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
