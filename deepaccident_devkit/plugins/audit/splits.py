"""Audit of split files (the devkit's or others') and releases: what several parts share."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

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
from deepaccident_devkit.support.text import PathType, counted, path_of
from deepaccident_devkit.taxonomy import MINI_SPLITS

_SCENARIO_NAME = re.compile(
    r"(type\d+_subtype\d+_(?:accident|normal))[\s/\\]+"  # type, and optional folders
    r"(?:[\w.-]{1,200}[/\\]+){0,8}?(\w{1,200}?_scenario\d+)"  # name
    r"(?:[^\s,;\"']{0,300}?[/\\_](\d{3,})(?!\d))?"  # frame
)
_MINI = re.compile(r"(?<![a-z])mini(?=[/\\]|$)", re.IGNORECASE)
# Kind of finding → noun for its cases, and what they mean.
_MEANINGS = {
    "frames": ("frame", "on two sides: the test data was also used for training"),
    "recordings": (
        "recording",
        (
            "on two sides, completely or in part, as after a random split by frames: frames 0.1 s "
            "apart are nearly the same"
        ),
    ),
    "twins": (
        "twin pair",
        "split apart, as after a random split by names: twins share junction, traffic and weather",
    ),
    "mini": (
        "scenario",
        (
            "in a mix of the mini and the full release: the same names stand for different but "
            "very similar recordings"
        ),
    ),
}


def audit_splits(paths: Iterable[PathType]) -> AuditReport:
    """Report frames, recordings or twins in several parts of a split, and mixed mini and full data.

    With dataroots, two recordings are the same if at least three moving road users with equal ids
    are, now or in the near future, at the same places in the world at the same time. Agents, frames
    and names may differ. Scenarios that are twins by name must also share a road user or a parked
    car.

    Args:
        paths: Two or more files, or two or more dataroots, one per part. A line of a file names
            a scenario (`<type> <name>`, `<type>/<name>`), a sample or frame by its token, or any
            file of a release by its path; all names in a line count. A name belongs to the mini
            release if a folder before the scenario's type, the split file or its folder has a name
            that ends with the word `mini` (`train_mini.txt` and `val_mini.txt` belong to the full
            release).

    Raises:
        ConfigError: If there are fewer than two paths, or both files and dataroots.
        DatarootError: If a folder is not a release.
        MissingFileError: If a file does not exist.
        ReleaseError: If a label or calib file of a release cannot be read.
        SplitFileError: If a file cannot be read, or a line names no scenario with its type.
    """
    path_of_side = {str(path): path_of(path) for path in paths}
    are_folders = [path.is_dir() for path in path_of_side.values()]
    if len(path_of_side) < 2 or (any(are_folders) and not all(are_folders)):
        raise ConfigError(
            "expected at least two split files, or dataroots, one per side, found "
            f"{', '.join(path_of_side) or 'none'}"
        )
    if any(are_folders):
        return _audit_releases(path_of_side)
    return _audit_files(path_of_side)


def _audit_files(path_of_side: Mapping[str, Path]) -> AuditReport:
    """Report frames, recordings, twins and mini scenarios that occur in two split files."""
    sides_of_item: dict[str, set[str]] = defaultdict(set)
    for side, path in path_of_side.items():
        for token, frame in _read_items(path):
            sides_of_item[token].add(side)
            if frame:
                sides_of_item[f"{token} frame {frame}"].add(side)
    recordings = {}
    frames = {}
    mini = {}
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
    mixed_mini = {}
    if full_sides:
        mixed_mini = {token: sides | full_sides for token, sides in mini.items()}
    split_of = {token: " and ".join(sorted(sides)) for token, sides in recordings.items()}
    twin_texts = []
    for twins in torn_twins(split_of):
        texts = map("{} in {}".format, twins.scenarios, twins.splits)
        twin_texts.append(" and ".join(texts))
    cases = {
        "frames": _describe_shared(frames),
        "recordings": _describe_shared(recordings),
        "twins": twin_texts,
        "mini": _describe_shared(mixed_mini),
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
    return _make_report(cases, remedy, [("side", "recordings", "frames named"), *rows])


def _describe_shared(sides_of_item: Mapping[str, set[str]]) -> list[str]:
    """Describe each item that occurs in two or more parts, with the names of the parts."""
    texts = []
    for item, sides in sides_of_item.items():
        if len(sides) > 1:
            texts.append(f"{item}: {' and '.join(sorted(sides))}")
    return texts


def _make_report(
    cases: Mapping[str, Sequence[str]], remedy: str, rows: Sequence[Row]
) -> AuditReport:
    """Build the report of an audit of splits.

    Args:
        cases: Kind of finding → texts that describe its cases.
        remedy: Remedy for all findings.
        rows: Heading, then a row per part, which begins with its name and number of recordings.
            A part without recordings is not compared.
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
    """Report recordings that occur in two releases, completely or partly, and split twins."""
    releases = {side: find_release(path).scenarios for side, path in path_of_side.items()}
    places = {}
    for side, scenarios in releases.items():
        places[side] = run_batch(places_in, scenarios, label="Reading scenarios")
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
    remedy = "Make one of the two with another seed, or remove these recordings."
    rows = []
    for side, recordings in places.items():
        recording_count = sum(len(recording) > 0 for recording in recordings)
        rows.append((side, recording_count))
    return _make_report(cases, remedy, [("side", "recordings"), *rows])


def _read_items(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the scenario token and the frame (0 for all) that each name in a file means.

    Tokens of the mini release have the prefix `mini:`.
    """
    remedy = "give a text file with a scenario, a frame or a path in each line"
    for number, line in enumerate(read_lines(path, "results", SplitFileError, remedy), start=1):
        matches = _SCENARIO_NAME.findall(line)
        if line.strip() and not matches:
            raise SplitFileError(
                f"{path}:{number}: expected the type and name of a scenario, such as "
                "type1_subtype1_accident/Town03_type001_subtype0001_scenario00024, found "
                f"{shortened(line.strip())!r}; {remedy} (a name without its type is not unique)"
            )
        prefixes = [line.partition("type")[0], path.parent.name]
        if path.stem not in MINI_SPLITS:
            prefixes.append(path.stem)
        mini = ""
        if any(map(_MINI.search, prefixes)):
            mini = "mini:"
        for kind, name, frame in matches:
            yield f"{mini}{kind}/{name}", int(frame or 0)
