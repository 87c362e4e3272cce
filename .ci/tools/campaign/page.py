"""The numbers of docs/validation.md, Files of strangers: made from a run; a test reads them."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from campaign.kinds import KINDS
from campaign.mutations import GROUPS, MUTATIONS
from campaign.stops import VERBS, Stopped
from campaign.worker import Outcome

VERDICTS = ("read", "refused", "failed")
PAGE = Path(__file__).parents[3] / "docs" / "validation.md"
_BLOCK = re.compile("(<!-- campaign -->\n).*?(<!-- /campaign -->)", re.DOTALL)
_SUMMARY = """{count:,} changed files of {kinds} kinds, by `{command}`:

{changed}
{kills} killed processes and {full} full disks, with {verbs} commands that write:

{stopped}"""


def tables(outcomes: Sequence[Outcome], stops: Sequence[Stopped]) -> str:
    """A row for each kind of file (read, refused, **failed**), and one for each command."""
    return "\n".join([_table(_rows(outcomes)), *([_table(_stop_rows(stops))] if stops else [])])


def summary(outcomes: Sequence[Outcome], stops: Sequence[Stopped], command: str) -> str:
    """What the page says of a run: the numbers of all kinds of files and of all commands."""
    head, *_, every = _rows(outcomes)
    cells = [re.findall(r"\d+", cell) or ["0"] * 3 for cell in every[1:]]
    changed = [
        ["", *head[1:]],
        *([name, *(cell[row] for cell in cells)] for row, name in enumerate(VERDICTS)),
    ]
    kills = sum(each.stop.kind == "kill" for each in stops)
    head, *_, every = _stop_rows(stops)
    return _SUMMARY.format(
        count=len(outcomes),
        kinds=len({outcome.case.kind for outcome in outcomes}),
        command=command,
        changed=_table(changed),
        kills=kills,
        full=len(stops) - kills,
        verbs=len({each.stop.verb for each in stops}),
        stopped=_table([head[3:], every[3:]]),
    )


def put(text: str) -> None:
    """Write a summary into the page."""
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(_BLOCK.sub(lambda marks: marks[1] + text + marks[2], page), encoding="utf-8")


def _rows(outcomes: Iterable[Outcome]) -> list[list[str]]:
    counts: Counter[tuple[str, str, str]] = Counter()
    for outcome in outcomes:
        group = MUTATIONS[outcome.case.mutation or ""].group
        verdict = "failed" if outcome.failed else outcome.verdict
        for kind in (outcome.case.kind, "all"):
            for column in (group, "all"):
                counts[kind, column, verdict] += 1
    columns = [*GROUPS, "all"]
    rows = [["file", *columns]]
    for kind in (*KINDS, "all"):
        cells = [[counts[kind, column, verdict] for verdict in VERDICTS] for column in columns]
        rows.append([kind, *("{} {} **{}**".format(*cell) if any(cell) else "" for cell in cells)])
    return rows


def _stop_rows(stops: Sequence[Stopped]) -> list[list[str]]:
    rows = [["command", "kills", "full disks", "half-written", "unequal or left", "not told"]]
    for name in (*(verb.name for verb in VERBS), "all"):
        of_verb = [each for each in stops if name in (each.stop.verb, "all")]
        kinds = Counter(each.stop.kind for each in of_verb)
        faults = [
            sum(any(text in each.fault for text in texts) for each in of_verb)
            for texts in (("not whole",), ("left over", "unequal"), ("status",))
        ]
        rows.append(
            [
                name if name == "all" else f"`{name}`",
                *map(str, (kinds["kill"], kinds["full disk"], *faults)),
            ]
        )
    return rows


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], f"|{' --- |' * len(rows[0])}", *lines[1:]]) + "\n"
