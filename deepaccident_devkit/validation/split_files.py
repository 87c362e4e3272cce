"""Whether split files, and folders of layout B, give every scenario one split, and twins the same one."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations

from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.reading import shortened
from deepaccident_devkit.release import ReleaseLayout, read_split_file
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.safety import torn_twins
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.findings import finding_of
from deepaccident_devkit.tables.split_assignment import SplitAssignment, assign_splits
from deepaccident_devkit.validation.subject import make_finding

_NAMED = 3
"""Repeated lines that a finding names at most."""


def check_splits(layout: ReleaseLayout) -> tuple[ReleaseLayout, list[Finding]]:
    """The release with those split files that can be read, and what is wrong with all of them."""
    found: list[Finding] = []
    readable: dict[str, ReleasePath] = {}
    for split, path in layout.split_files.items():
        try:
            lines = read_split_file(path, raw=True)
        except ReleaseError as error:
            found.append(finding_of(error, "split-file-unreadable", None))
            continue
        readable[split] = path
        found += _repeated(path, lines)
    layout = replace(layout, split_files=readable)
    splits = assign_splits(layout)
    return layout, [*found, *_assignment_findings(splits), *_twins(splits)]


def _repeated(path: ReleasePath, lines: list[tuple[str, ...]]) -> Iterator[Finding]:
    """Scenarios that a file lists more than once; reading takes them once."""
    repeated = [shortened(" ".join(words)) for words, count in Counter(lines).items() if count > 1]
    if repeated:
        more = f" and {len(repeated) - _NAMED} more" if len(repeated) > _NAMED else ""
        what = f"lists more than once: {', '.join(repeated[:_NAMED])}{more}"
        yield make_finding("split-file-repeats", None, str(path), what)


def _assignment_findings(splits: SplitAssignment) -> Iterator[Finding]:
    for token, messages in splits.problems.items():
        for message in messages:
            yield make_finding("two-places", token, token, message.rpartition(";")[0])
    for token in splits.unlisted:
        yield make_finding("in-no-split", token, token, "no split file lists it")
    for token, messages in splits.contradictions.items():
        for message in messages if token not in splits.problems else ():
            yield make_finding("splits-contradict", token, token, message)
    for notice in splits.notices:
        where, _, what = notice.partition(": ")
        yield make_finding("split-file-partial", None, where, what)


def _twins(splits: SplitAssignment) -> Iterator[Finding]:
    """Scenarios of one name and family, such as an accident and its normal twin, that belong to different splits."""
    known = {
        token: split
        for token, split in splits.split_of.items()
        if token not in splits.problems and token not in splits.contradictions
    }
    for twins in torn_twins(known):
        sides = list(zip(twins.scenarios, twins.splits, strict=True))
        for (token, mine), (other, theirs) in permutations(sides):
            yield make_finding("twins-apart", token, token, f"is of {mine}, its twin {other} of {theirs}")
