"""Audit of split files, the devkit's and other people's, and of releases: what stands on two sides."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Final

from deepaccident_devkit.collisions.twins import torn_twins
from deepaccident_devkit.errors import ConfigError, SplitFileError, shortened
from deepaccident_devkit.plugins.audit.releases import (
    MIN_SHARED_ROAD_USERS,
    places_in,
    shared_moments,
)
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import read_lines
from deepaccident_devkit.support.parallel import run_batch
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import counted, path_of
from deepaccident_devkit.taxonomy import MINI_SPLITS

_NAMED: Final = re.compile(
    r"(type\d+_subtype\d+_(?:accident|normal))[\s/\\]+"  # type, and what may lie between
    r"(?:[\w.-]{1,200}[/\\]+){0,8}?(\w{1,200}?_scenario\d+)"  # name
    r"(?:[^\s,;\"']{0,300}?[/\\_](\d{3,})(?!\d))?"  # frame
)
_MINI: Final = re.compile(r"(?<![a-z])mini(?=[/\\]|$)", re.IGNORECASE)
# Kind of finding → what is counted, and what it means.
_SAYS: Final = {
    "frames": ("frame", "on two sides: what is tested was learnt"),
    "recordings": (
        "recording",
        "on two sides, whole or in part, as by a random split by frames: frames 0.1 s apart are nearly the same",
    ),
    "twins": (
        "twin pair",
        "torn apart, as by a random split by names: twins share junction, traffic and weather",
    ),
    "mini": (
        "scenario",
        "of the mini release beside the full one: of equal names it has other recordings, much alike",
    ),
}


def audit_splits(paths: Iterable[str | os.PathLike[str]]) -> AuditReport:
    """Look for frames, recordings or twins on two sides of a split, and for the mini release beside the full one.

    Of dataroots, two recordings are the same if at least three moving road users of equal ids are at the same places of
    the world at one moment, or go on to them: whatever agents, frames and names each side has. Twins by name are twins
    if they share a road user or a parked car.

    Args:
        paths: two or more files, or two or more dataroots, a side each. A line of a file names a scenario (`<type>
            <name>`, `<type>/<name>`), a sample or a frame by its token, or any file of a release by its path; all names
            in a line count. It is of the mini release if a folder before the scenario's type, the file's own name or
            its folder ends with the word `mini` (`train_mini.txt` and `val_mini.txt` are of the full release).

    Raises:
        ConfigError: there are fewer than two, or files and dataroots.
        DatarootError: a folder is no release.
        MissingFileError: a file is not there.
        ReleaseError: a label or calib file of a release cannot be read.
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
    on: dict[str, set[str]] = defaultdict(set)
    for side, path in places.items():
        for token, frame in _items(path):
            on[token].add(side)
            on[f"{token} frame {frame}" if frame else token].add(side)
    recordings, frames = (
        {item: on[item] for item in sorted(on) if (" " in item) is of} for of in (False, True)
    )
    full = set[str]().union(
        *(sides for token, sides in recordings.items() if not token.startswith("mini:"))
    )
    mini = {
        token: sides | full
        for token, sides in recordings.items()
        if full and token.startswith("mini:")
    }
    twins = torn_twins({token: " and ".join(sorted(sides)) for token, sides in recordings.items()})
    cases = {
        "frames": _shared(frames),
        "recordings": _shared(recordings),
        "twins": [
            " and ".join(map("{} in {}".format, pair.scenarios, pair.splits)) for pair in twins
        ],
        "mini": _shared(mini),
    }
    remedy = "Split by scenarios of one release, twins together: deepaccident split DATAROOT --out FOLDER."
    rows = [
        [side, *(sum(map({side}.issubset, on.values())) for on in (recordings, frames))]
        for side in places
    ]
    return _report(cases, remedy, [("side", "recordings", "frames named"), *rows])


def _shared(on: Mapping[str, set[str]]) -> list[str]:
    """Return which items are on two sides or more, and on which, a phrase each."""
    return [
        f"{item}: {' and '.join(sorted(sides))}" for item, sides in on.items() if len(sides) > 1
    ]


def _report(cases: Mapping[str, Sequence[str]], remedy: str, rows: Sequence[Row]) -> AuditReport:
    """Return the report of the cases of each kind, and of the sides, a row each with its number of recordings.

    A side without a recording is compared with none.
    """
    findings = [
        AuditFinding(
            kind=kind,
            what=f"{counted(len(texts), _SAYS[kind][0])} {_SAYS[kind][1]}.",
            remedy=remedy,
            number=len(texts),
            examples=tuple(texts[:3]),
        )
        for kind, texts in cases.items()
        if texts
    ]
    sides = sum(bool(number) for _, number, *_ in rows[1:])
    compared = {"sides": sides if sides > 1 else 0}
    return AuditReport(compared=compared, findings=tuple(findings), tables={"sides": rows})


def _audit_releases(sides: Mapping[str, Path]) -> AuditReport:
    """Look for recordings of which parts stand in two releases, and for torn twins."""
    releases = {side: find_release(path).scenarios for side, path in sides.items()}
    places = {
        side: run_batch(places_in, scenarios, label="reading")
        for side, scenarios in releases.items()
    }
    cases: dict[str, list[str]] = {"recordings": [], "twins": []}
    for side, other in combinations(sides, 2):
        for (row, other_row), moving in sorted(shared_moments(places[side], places[other]).items()):
            one, two = releases[side][row].token, releases[other][other_row].token
            twins = torn_twins({one: side, two: other})
            if twins or moving >= MIN_SHARED_ROAD_USERS:
                cases["twins" if twins else "recordings"].append(
                    f"{one} of {side} and {two} of {other}"
                )
    remedy = "Make one of the two with another seed, or leave these recordings out."
    rows = [(side, sum(map(bool, map(len, recordings)))) for side, recordings in places.items()]
    return _report(cases, remedy, [("side", "recordings"), *rows])


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
        places = (
            line.partition("type")[0],
            path.parent.name,
            "" if path.stem in MINI_SPLITS else path.stem,
        )
        mini = "mini:" * any(map(_MINI.search, places))
        yield from ((f"{mini}{kind}/{name}", int(frame or 0)) for kind, name, frame in found)
