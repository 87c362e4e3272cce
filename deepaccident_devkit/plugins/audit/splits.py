"""Audit of split files, the devkit's and other people's, and of releases: what is on two sides."""

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

_SCENARIO_NAME: Final = re.compile(
    r"(type\d+_subtype\d+_(?:accident|normal))[\s/\\]+"  # type, and optional folders
    r"(?:[\w.-]{1,200}[/\\]+){0,8}?(\w{1,200}?_scenario\d+)"  # name
    r"(?:[^\s,;\"']{0,300}?[/\\_](\d{3,})(?!\d))?"  # frame
)
_MINI: Final = re.compile(r"(?<![a-z])mini(?=[/\\]|$)", re.IGNORECASE)
# Kind of finding → the noun of its cases, and their meaning.
_MEANINGS: Final = {
    "frames": ("frame", "on two sides: what is tested was learnt"),
    "recordings": (
        "recording",
        (
            "on two sides, whole or in part, as by a random split by frames: frames 0.1 s apart "
            "are nearly the same"
        ),
    ),
    "twins": (
        "twin pair",
        "torn apart, as by a random split by names: twins share junction, traffic and weather",
    ),
    "mini": (
        "scenario",
        (
            "of the mini release beside the full one: of equal names it has other recordings, much "
            "alike"
        ),
    ),
}


def audit_splits(paths: Iterable[str | os.PathLike[str]]) -> AuditReport:
    """Report frames, recordings or twins on two sides of a split, and mini beside the full release.

    With dataroots, two recordings are the same if at least three moving road users of equal ids are
    at the same places of the world at one moment, or will be soon: whatever agents, frames and
    names each side has. Scenarios that are twins by name are twins if they share a road user or a
    parked car.

    Args:
        paths: Two or more files, or two or more dataroots, one for each side. A line of a file
            names a scenario (`<type> <name>`, `<type>/<name>`), a sample or a frame by its token,
            or any file of a release by its path; all names in a line count. A name belongs to the
            mini release if a folder before the scenario's type, the file's own name or its folder
            ends with the word `mini` (`train_mini.txt` and `val_mini.txt` belong to the full
            release).

    Raises:
        ConfigError: There are fewer than two paths, or both files and dataroots.
        DatarootError: A folder is no release.
        MissingFileError: A file does not exist.
        ReleaseError: A label or calib file of a release cannot be read.
        SplitFileError: A file cannot be read, or a line names no scenario with its type.
    """
    path_of_side = {str(path): path_of(path) for path in paths}
    are_folders = [path.is_dir() for path in path_of_side.values()]
    if len(path_of_side) < 2 or (any(are_folders) and not all(are_folders)):
        raise ConfigError(
            "expected two or more split files, or dataroots, a side each, found "
            f"{', '.join(path_of_side) or 'none'}"
        )
    if any(are_folders):
        return _audit_releases(path_of_side)
    return _audit_files(path_of_side)


def _audit_files(path_of_side: Mapping[str, Path]) -> AuditReport:
    """Report frames, recordings, twins and scenarios of mini that occur in two split files."""
    sides_of_item: dict[str, set[str]] = defaultdict(set)
    for side, path in path_of_side.items():
        for token, frame in _items(path):
            sides_of_item[token].add(side)
            sides_of_item[f"{token} frame {frame}" if frame else token].add(side)
    recordings, frames, mini = {}, {}, {}
    full_sides = set[str]()
    for item in sorted(sides_of_item):
        sides = sides_of_item[item]
        if " " in item:
            frames[item] = sides
            continue
        recordings[item] = sides
        if item.startswith("mini:"):
            mini[item] = sides
        else:
            full_sides |= sides
    mini = {token: sides | full_sides for token, sides in mini.items() if full_sides}
    split_of = {token: " and ".join(sorted(sides)) for token, sides in recordings.items()}
    twin_texts = []
    for twins in torn_twins(split_of):
        texts = map("{} in {}".format, twins.scenarios, twins.splits)
        twin_texts.append(" and ".join(texts))
    cases = {
        "frames": _shared(frames),
        "recordings": _shared(recordings),
        "twins": twin_texts,
        "mini": _shared(mini),
    }
    remedy = (
        "Split by scenarios of one release, twins together: deepaccident split DATAROOT --out "
        "FOLDER."
    )
    rows = []
    for side in path_of_side:
        recording_count = sum(side in sides for sides in recordings.values())
        frame_count = sum(side in sides for sides in frames.values())
        rows.append((side, recording_count, frame_count))
    return _report(cases, remedy, [("side", "recordings", "frames named"), *rows])


def _shared(sides_of_item: Mapping[str, set[str]]) -> list[str]:
    """Return a text for each item on two or more sides: the item and its sides."""
    texts = []
    for item, sides in sides_of_item.items():
        if len(sides) > 1:
            texts.append(f"{item}: {' and '.join(sorted(sides))}")
    return texts


def _report(cases: Mapping[str, Sequence[str]], remedy: str, rows: Sequence[Row]) -> AuditReport:
    """Return the report of cases by their kind, and of sides: rows with their number of recordings.

    A side without a recording is compared with none.
    """
    findings = []
    for kind, texts in cases.items():
        if texts:
            noun, meaning = _MEANINGS[kind]
            what = f"{counted(len(texts), noun)} {meaning}."
            examples = tuple(texts[:3])
            findings.append(
                AuditFinding(
                    kind=kind, what=what, remedy=remedy, number=len(texts), examples=examples
                )
            )
    side_count = sum(bool(number) for _, number, *_ in rows[1:])
    compared = {"sides": side_count if side_count > 1 else 0}
    return AuditReport(compared=compared, findings=tuple(findings), tables={"sides": rows})


def _audit_releases(path_of_side: Mapping[str, Path]) -> AuditReport:
    """Report recordings that occur in two releases, completely or partly, and torn twins."""
    releases = {side: find_release(path).scenarios for side, path in path_of_side.items()}
    places = {
        side: run_batch(places_in, scenarios, label="reading")
        for side, scenarios in releases.items()
    }
    cases: dict[str, list[str]] = {"recordings": [], "twins": []}
    for side, other_side in combinations(path_of_side, 2):
        moments = shared_moments(places[side], places[other_side])
        for (row, other_row), moving_count in sorted(moments.items()):
            token = releases[side][row].token
            other_token = releases[other_side][other_row].token
            twins = torn_twins({token: side, other_token: other_side})
            if twins or moving_count >= MIN_SHARED_ROAD_USERS:
                kind = "twins" if twins else "recordings"
                cases[kind].append(f"{token} of {side} and {other_token} of {other_side}")
    remedy = "Make one of the two with another seed, or leave these recordings out."
    rows = []
    for side, recordings in places.items():
        rows.append((side, sum(len(recording) > 0 for recording in recordings)))
    return _report(cases, remedy, [("side", "recordings"), *rows])


def _items(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the scenario's token and the frame (0 for all) of each name in a file.

    Tokens of the mini release are prefixed with `mini:`.
    """
    remedy = "give a text file with a scenario, a frame or a path in each line"
    for number, line in enumerate(read_lines(path, "results", SplitFileError, remedy), start=1):
        matches = _SCENARIO_NAME.findall(line)
        if line.strip() and not matches:
            raise SplitFileError(
                f"{path}:{number}: expected a scenario's type and name, such as "
                "type1_subtype1_accident/Town03_type001_subtype0001_scenario00024, found "
                f"{shortened(line.strip())!r}; {remedy}: a name alone is not unique"
            )
        prefixes = [line.partition("type")[0], path.parent.name]
        if path.stem not in MINI_SPLITS:
            prefixes.append(path.stem)
        mini = "mini:" if any(map(_MINI.search, prefixes)) else ""
        for kind, name, frame in matches:
            yield f"{mini}{kind}/{name}", int(frame or 0)
