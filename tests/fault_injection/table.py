"""The table of found and missed faults, as Markdown: made from a run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fault_injection.mutations import MUTATIONS, Mutation
from fault_injection.run import Outcome

_HEAD = """# What `deepaccident validate` finds

*Needs* is the option that `validate` needs.

"""
_SUMMARY = """{count} faults of {kinds} kinds: {found} found, {harmless} harmless, {missed} missed. `validate` need not
find {beyond} more kinds; the table that the command prints says why.

"""  # noqa: E501
_COLUMNS = ("kind", "what is done", "needs", "applied", "found", "verdict", "found by, or why not")


@dataclass(frozen=True, slots=True)
class Row:
    """One kind of mutation and what became of it."""

    mutation: Mutation
    outcomes: Sequence[Outcome]

    @property
    def found(self) -> int:
        """How many applications were found."""
        return sum(outcome.found for outcome in self.outcomes)

    @property
    def verdict(self) -> str:
        """`found`, `harmless`, `missed`, or `by chance` for what is found only sometimes."""
        if self.mutation.harmless is not None:
            return "harmless"
        if self.mutation.beyond is not None and self.found:
            return "by chance"
        return "found" if self.found == len(self.outcomes) else "missed"

    def cells(self) -> list[str]:
        """The cells of its row of the table."""
        codes = sorted(
            {code for outcome in self.outcomes for code in (*outcome.errors, *outcome.warnings)}
        )
        told = ", ".join(f"`{code}`" for code in codes)
        why = self.mutation.harmless or self.mutation.beyond
        return [
            f"`{self.mutation.name}`",
            self.mutation.title,
            "`--deep`" if self.mutation.deep else "",
            str(len(self.outcomes)),
            str(self.found),
            self.verdict,
            "; ".join(part for part in (why, told) if part),
        ]


def rows_of(outcomes: Iterable[Outcome]) -> list[Row]:
    """One row for each kind, in the order of the groups."""
    by_name: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_name.setdefault(outcome.job.name, []).append(outcome)
    return [Row(mutation, by_name[name]) for name, mutation in MUTATIONS.items() if name in by_name]


def to_markdown(outcomes: Sequence[Outcome]) -> str:
    """All kinds, with the findings for each."""
    rows = rows_of(outcomes)
    parts = [_HEAD + summary(outcomes)]
    for group in dict.fromkeys(row.mutation.group for row in rows):
        lines = [_line(row.cells()) for row in rows if row.mutation.group == group]
        parts.append(
            "\n".join([f"## {group[0].upper()}{group[1:]}", "", *_header(_COLUMNS), *lines, ""])
        )
    return "\n".join(parts)


def summary(outcomes: Sequence[Outcome]) -> str:
    """What docs/validation.md says of a run."""
    rows = rows_of(outcomes)
    must = [row for row in rows if row.mutation.beyond is None]
    told = dict(zip(("found", "harmless", "missed"), _tally(must), strict=True))
    counts = {
        **told,
        "count": sum(told.values()),
        "kinds": len(must),
        "beyond": len(rows) - len(must),
    }
    return _SUMMARY.format(**counts) + _groups(must)


def _tally(rows: Sequence[Row]) -> tuple[int, int, int]:
    """How many applications were found, are harmless and were missed."""
    harmless = sum(len(row.outcomes) for row in rows if row.verdict == "harmless")
    found = sum(row.found for row in rows if row.verdict != "harmless")
    return found, harmless, sum(len(row.outcomes) for row in rows) - found - harmless


def _groups(rows: Sequence[Row]) -> str:
    lines = []
    for group in dict.fromkeys(row.mutation.group for row in rows):
        of_group = [row for row in rows if row.mutation.group == group]
        lines.append(_line([group, str(len(of_group)), *map(str, _tally(of_group))]))
    return "\n".join([*_header(("files", "kinds", "found", "harmless", "missed")), *lines, ""])


def _header(columns: Sequence[str]) -> list[str]:
    return [_line(columns), _line(["---"] * len(columns))]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
