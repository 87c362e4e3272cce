"""Audit of split files, the devkit's and other people's, and of releases: what stands on two sides."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from deepaccident_devkit.accidents.twins import torn_twins
from deepaccident_devkit.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.errors import ConfigError, SplitFileError, shortened
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.fingerprints import folder_hashes
from deepaccident_devkit.release.store import read_lines
from deepaccident_devkit.support.text import counted, path_of
from deepaccident_devkit.taxonomy import MINI_SPLITS

_NAMED: Final = re.compile(
    r"(type\d+_subtype\d+_(?:accident|normal))[\s/\\]+"  # type, and what may lie between
    r"(?:[\w.-]{1,200}[/\\]+){0,8}?(\w{1,200}?_scenario\d+)"  # name
    r"(?:[^\s,;\"']{0,300}?[/\\_](\d{3,})(?!\d))?"  # frame
)
_MINI: Final = re.compile(r"(?<![a-z])mini(?=[/\\]|$)", re.IGNORECASE)
_SAYS: Final = {
    "frames": ("frame", "on two sides: what is tested was learnt"),
    "recordings": ("recording", "on two sides, as by a random split by frames: frames 0.1 s apart are nearly the same"),
    "twins": ("twin pair", "torn apart, as by a random split by names: twins share junction, traffic and weather"),
    "copies": ("recording", "with the same labels on two sides: what is tested was learnt"),
    "mini": ("scenario", "of the mini release beside the full one: of equal names it has other recordings, much alike"),
}
"""Kind of finding, of releases `copies` → what is counted, and what it means."""


def audit_splits(paths: Iterable[str | os.PathLike[str]]) -> AuditReport:
    """Look for frames, recordings or twins on two sides of a split, and for the mini release beside the full one.

    Of releases, recordings are the same if names and label files are.

    Args:
        paths: two or more files, or two or more dataroots, a side each. A line of a file names a scenario (`<type>
            <name>`, `<type>/<name>`), a sample or a frame by its token, or any file of a release by its path; all names
            in a line count. It is of the mini release if a folder before the scenario's type, the file's own name or
            its folder ends with the word `mini` (`train_mini.txt` and `val_mini.txt` are of the full release).

    Raises:
        ConfigError: there are fewer than two, or files and dataroots.
        DatarootError: a folder is no release.
        MissingFileError: a file is not there.
        SplitFileError: a file cannot be read, or a line names no scenario with its type.
    """
    places = {str(path): path_of(path) for path in paths}
    folders = [path.is_dir() for path in places.values()]
    if len(places) < 2 or (any(folders) and not all(folders)):
        raise ConfigError(
            f"expected two or more split files, or dataroots, a side each, found {', '.join(places) or 'none'}"
        )
    if any(folders):
        return _audit_releases(places)
    sides = {side: sorted(set(_items(path))) for side, path in places.items()}
    on: dict[tuple[str, int], set[str]] = defaultdict(set)
    for side, token, frame in [(side, *item) for side, items in sides.items() for item in items]:
        on[token, 0].add(side)  # the recording
        on[token, frame].add(side)
    told = {item: " and ".join(sorted(on[item])) for item in sorted(on)}
    full = {side for token, frame in on if not token.startswith("mini:") for side in on[token, frame]}
    twins = torn_twins({token: sides for (token, frame), sides in told.items() if not frame})
    found = {
        "frames": [f"{each[0]} frame {each[1]}: {told[each]}" for each in told if each[1] and len(on[each]) > 1],
        "recordings": [f"{each[0]}: {told[each]}" for each in told if not each[1] and len(on[each]) > 1],
        "twins": [" and ".join(map("{} in {}".format, each.scenarios, each.splits)) for each in twins],
        "mini": [
            f"{each[0]}: {told[each]}"
            for each in told
            if each[0].startswith("mini:") and not each[1] and full and len(on[each] | full) > 1
        ],
    }
    remedy = "Split by scenarios of one release, twins together: deepaccident split DATAROOT --out FOLDER."
    return AuditReport(
        findings=tuple(_finding(kind, _SAYS[kind], cases, remedy) for kind, cases in found.items() if cases),
        tables={
            "sides": [
                ("side", "recordings", "frames named"),
                *((side, len(dict(items)), sum(frame > 0 for _, frame in items)) for side, items in sides.items()),
            ]
        },
    )


def _audit_releases(sides: Mapping[str, Path]) -> AuditReport:
    """Look for recordings that two releases have, by the hashes of their label files."""
    where: dict[str, list[str]] = defaultdict(list)
    of_labels = partial(folder_hashes, kinds=["label"])
    scenarios = {side: find_release(path).scenarios for side, path in sides.items()}
    for side, folders in scenarios.items():
        for folder, hashes in zip(folders, run_batch(of_labels, folders), strict=True):
            if hashes.label is not None:
                where[hashes.label].append(f"{folder.token} of {side}")
    cases = [" and ".join(each) for each in where.values() if len(each) > 1]
    remedy = "Make one of the two with another seed, or leave these recordings out."
    return AuditReport(
        findings=(_finding("recordings", _SAYS["copies"], cases, remedy),) if cases else (),
        tables={"sides": [("side", "recordings"), *((side, len(folders)) for side, folders in scenarios.items())]},
    )


def _finding(kind: str, says: tuple[str, str], cases: Sequence[str], remedy: str) -> AuditFinding:
    return AuditFinding(
        kind=kind,
        what=f"{counted(len(cases), says[0])} {says[1]}.",
        remedy=remedy,
        number=len(cases),
        examples=tuple(cases[:3]),
    )


def _items(path: Path) -> Iterator[tuple[str, int]]:
    """The token of the scenario, of mini with `mini:` before it, and the frame (0: all) of each name in a file."""
    remedy = "give a text file with a scenario, a frame or a path in each line"
    for number, line in enumerate(read_lines(path, "results", SplitFileError, remedy), start=1):
        found = _NAMED.findall(line)
        if line.strip() and not found:
            raise SplitFileError(
                f"{path}:{number}: expected a scenario's type and name, such as type1_subtype1_accident/Town03_type001_"
                f"subtype0001_scenario00024, found {shortened(line.strip())!r}; {remedy}: a name alone is not unique"
            )
        places = (line.partition("type")[0], path.parent.name, "" if path.stem in MINI_SPLITS else path.stem)
        mini = "mini:" * any(map(_MINI.search, places))
        yield from ((f"{mini}{kind}/{name}", int(frame or 0)) for kind, name, frame in found)
