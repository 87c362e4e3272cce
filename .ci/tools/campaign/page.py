"""docs/reliability.md: what was tried and what became of it, made from a run; a test reads its numbers."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence

from campaign.kinds import KINDS
from campaign.mutations import GROUPS, MUTATIONS
from campaign.stops import VERBS, Stopped
from campaign.worker import MEGABYTES, SECONDS, Outcome

_HEAD = """# What damaged files and killed processes do

For everybody who reads files of strangers, or works on a machine where jobs are killed and disks get full: what was
tried, and what became of it. 10 minutes. [SECURITY.md](../SECURITY.md) says what the devkit guarantees.

## Changed files

{count:,} times, one file of a healthy tree was changed in one way and then read, as a user would read it: by opening
the release or its zip, by `validate`, by evaluating the results, by verifying and comparing the bundle,
by going on with an export that was killed, by `results`, by loading weights, by going on with a run of
training, and so on. A case is *read* if all that was read equals what a plain reader finds in the same bytes (Python's
`json`, `split` and `zipfile`, numpy, Pillow, PyTorch) or what a checksum says. It is *refused* if the devkit raises its
own error, which names the file in at most 2,000 characters, none of which moves a terminal's cursor or turns the
direction of letters. Anything else *failed*: other values, another exception, more than {seconds:g} s of the
processor's time, more than {megabytes} MB of memory above that of the healthy file, code that ran, a process that died,
and anything that was changed in a folder outside of what was read and written, to which links and paths lead.

Each cell of the table has three numbers: read, refused, **failed**. The columns are the ways to change a file:

- bytes: flipped bits, cut, inserted, removed, swapped and zeroed parts, other line ends and byte order marks
- numbers: huge ones, NaN, sizes that are not so; ends of archives, tables and headers that lie
- types: other types, keys and formats; pickles that run code or ask for names; YAML tags; tensors that are views,
  sparse or without numbers; members of archives that are there twice, encrypted or lie on each other
- bombs: holes of 5 GB, endless lines, deep nesting, values of 5 MB, addresses of 50 MB, archives and images that unpack
  to gigabytes, pickles that ask for 6 GB in ten bytes, tensors of which one number stands for gigabytes
- links: links to themselves, to devices and elsewhere; named pipes and folders in the file's place; no file; below an
  export's folder links to what is outside, and paths in its journals that lead there
- names: HTML, control characters, letters from right to left and commands as names and texts; members of archives whose
  names lead elsewhere; odd files beside the healthy one

Each kind of file has cases drawn by a seed of its own, so that a new kind changes nothing of the others.{left_out}

{failed_text}
"""
_STOPS = """## Killed processes and full disks

{kills} times, a command that writes was ended by `kill -9` at a random moment, and {full} times the disk was full (a
limit on the size of files). Then the same command ran again.

- *half-written*: after the stop, a file under its final name is not whole
- *unequal or left*: after the next run, a file differs from that of an undisturbed run, or a temporary file is left
- *not told*: a full disk, or the next run, ended in anything but what it should: one line and exit status 2, or 0

"""
_END = """
## Run it again

    PYTHONPATH=.ci/tools python -m campaign

at the top of a checkout repeats all of it and writes this page, which is of {command}. The same seed makes the
same cases; `--count` is how many a kind has, and `--kinds "weights,zip of a release"` runs these alone. Weights and
training states need the extra `torch`, and are left out where it is not installed.
`pytest -m "" tests/test_campaign.py` tries others, a few of each kind; a test compares the numbers of this page with
each other and with the kinds of files. What fails is printed with its kind, mutation and seed.
"""


def page(outcomes: Sequence[Outcome], stops: Sequence[Stopped], command: str) -> str:
    """The whole page; kinds of which there is no outcome are named as left out."""
    failed = sum(outcome.failed for outcome in outcomes)
    text = "Nothing failed." if not failed else f"{failed} failed."
    absent = [name for name in KINDS if name not in {outcome.case.kind for outcome in outcomes}]
    left_out = f" Left out: {', '.join(absent)}." if absent else ""
    head = _HEAD.format(count=len(outcomes), seconds=SECONDS, megabytes=MEGABYTES, left_out=left_out, failed_text=text)
    kills = [each for each in stops if each.stop.kind == "kill"]
    stopped = _STOPS.format(kills=len(kills), full=len(stops) - len(kills))
    tables = (_table(_rows(outcomes)), _table(_stop_rows(stops)))
    return f"{head}\n{tables[0]}\n{stopped}{tables[1]}{_END.format(command=command)}"


def numbers(markdown: str) -> dict[str, list[list[int]]]:
    """First cell of each row of the tables → the numbers in its other cells."""
    rows = [line.strip("| ").split(" | ") for line in markdown.splitlines() if line.startswith("| ")]
    return {
        row[0]: [[int(number) for number in re.findall(r"\d+", cell.replace(",", ""))] for cell in row[1:]]
        for row in rows
    }


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
        cells = [[counts[kind, column, verdict] for verdict in ("read", "refused", "failed")] for column in columns]
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
        rows.append([name if name == "all" else f"`{name}`", *map(str, (kinds["kill"], kinds["full disk"], *faults))])
    return rows


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], f"|{' --- |' * len(rows[0])}", *lines[1:]]) + "\n"
