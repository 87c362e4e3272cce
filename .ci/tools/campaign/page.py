"""The numbers of a run, which docs/validation.md shows under "Files from strangers"."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from campaign.kinds import KINDS
from campaign.mutations import GROUPS, MUTATIONS
from campaign.stops import VERBS, StopOutcome
from campaign.worker import Outcome

VERDICTS = ("read", "refused", "failed")
# Kind of fault after a stop → texts in its description.
_FAULTS = {
    "incomplete": ("not whole",),
    "unequal": ("left over", "unequal"),
    "unreported": ("status",),
}
PAGE = Path(__file__).parents[3] / "docs" / "validation.md"
_BLOCK = re.compile("(<!-- campaign -->\n).*?(<!-- /campaign -->)", re.DOTALL)
_SUMMARY = """Of {count:,} changed files of {kinds} kinds (`{command}`),
{read:,} are read, {refused:,} are refused, and {failed:,} failed. After {kills} killed processes
and {full} full disks, in {verbs} commands that write, {incomplete} files are incomplete,
{unequal} are unequal or left over, and {unreported} endings are unreported.
"""


def format_tables(outcomes: Sequence[Outcome], stops: Sequence[StopOutcome]) -> str:
    """Return a row for each kind of files (read, refused, **failed**) and one for each command."""
    tables = [_format_table(_count_outcomes(outcomes))]
    if stops:
        tables.append(_format_table(_count_stops(stops)))
    return "\n".join(tables)


def summarize(outcomes: Sequence[Outcome], stops: Sequence[StopOutcome], command: str) -> str:
    """Return the text of a run for the page: the totals of all kinds of files and all commands."""
    verdicts = Counter(_verdict(outcome) for outcome in outcomes)
    kill_count = sum(outcome.stop.kind == "kill" for outcome in stops)
    fault_counts = _count_faults(stops)
    return _SUMMARY.format(
        count=len(outcomes),
        kinds=len({outcome.case.kind for outcome in outcomes}),
        command=command,
        **{name: verdicts[name] for name in VERDICTS},
        kills=kill_count,
        full=len(stops) - kill_count,
        verbs=len({outcome.stop.verb for outcome in stops}),
        **fault_counts,
    )


def write_summary(text: str) -> None:
    """Write a summary into the page."""
    page = PAGE.read_text(encoding="utf-8")
    page = _BLOCK.sub(lambda match: match[1] + text + match[2], page)
    PAGE.write_text(page, encoding="utf-8")


def _count_outcomes(outcomes: Iterable[Outcome]) -> list[list[str]]:
    """Return the cells of the table of changed files: one row for each kind, then the totals."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for outcome in outcomes:
        group = MUTATIONS[outcome.case.mutation or ""].group
        verdict = _verdict(outcome)
        for kind in (outcome.case.kind, "all"):
            for column in (group, "all"):
                counts[kind, column, verdict] += 1
    columns = [*GROUPS, "all"]
    rows = [["file", *columns]]
    for kind in (*KINDS, "all"):
        row = [kind]
        for column in columns:
            cell = [counts[kind, column, verdict] for verdict in VERDICTS]
            row.append("{} {} **{}**".format(*cell) if any(cell) else "")
        rows.append(row)
    return rows


def _count_stops(stops: Sequence[StopOutcome]) -> list[list[str]]:
    """Return the cells of the table of stops: one row for each command, then the totals."""
    rows = [["command", "kills", "full disks", *_FAULTS]]
    for name in (*(verb.name for verb in VERBS), "all"):
        outcomes = [outcome for outcome in stops if name in (outcome.stop.verb, "all")]
        kinds = Counter(outcome.stop.kind for outcome in outcomes)
        cells = [kinds["kill"], kinds["full disk"]]
        cells += _count_faults(outcomes).values()
        rows.append([name if name == "all" else f"`{name}`", *map(str, cells)])
    return rows


def _verdict(outcome: Outcome) -> str:
    """Return `failed`, or what the reader did with the file."""
    return "failed" if outcome.failed else outcome.verdict


def _count_faults(stops: Iterable[StopOutcome]) -> dict[str, int]:
    """Count the stops with each kind of fault."""
    faults = [outcome.fault for outcome in stops]
    return {
        name: sum(any(text in fault for text in texts) for fault in faults)
        for name, texts in _FAULTS.items()
    }


def _format_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as a Markdown table; the first one is its head."""
    head, *lines = [f"| {' | '.join(row)} |" for row in rows]
    rule = f"|{' --- |' * len(rows[0])}"
    return "\n".join([head, rule, *lines]) + "\n"
