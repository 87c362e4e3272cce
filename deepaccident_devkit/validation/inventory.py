"""Checks of the presence of files, and of the split files."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import permutations

from deepaccident_devkit.collisions.twins import torn_twins
from deepaccident_devkit.errors import ReleaseError, shortened
from deepaccident_devkit.release import ReleaseLayout, ScenarioFolder, read_split_file, store
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.reading import fault_text, irregular_text
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.indexing import SplitAssignment, assign_splits
from deepaccident_devkit.tables.scan import ScenarioScan, finding_of, frame_ranges
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT, CHANNELS
from deepaccident_devkit.validation.subject import frames_text, make_finding

# Frames of a sensor folder that a finding lists, rather than the missing frames.
_MAX_LISTED_FRAMES = 10
# Repeated lines that a finding names.
_MAX_NAMED_LINES = 3
# Agent and kind of file: `label`, `calib` or a channel.
_Recording = tuple[str, str]


Inventory = Mapping[_Recording, list[int]]
"""Frame numbers of the sensor folders of a scenario that have any."""


def take_inventory(scenario: ScenarioFolder, scan: ScenarioScan) -> tuple[Inventory, list[Finding]]:
    """List a scenario's sensor folders, and what is wrong with them.

    A channel without any file was not downloaded, and is no finding.
    """
    findings: list[Finding] = []
    inventory: dict[_Recording, list[int]] = {}
    for agent in scan.agents:
        for channel in CHANNELS:
            folder = scenario.kind_folder(agent, channel)
            try:
                frames, odd_names = frame_numbers(folder, CHANNEL_FORMAT[channel])
            except ReleaseError as error:
                findings.append(finding_of(error, "folder-unreadable", scenario.token))
                continue
            if odd_names:
                message = f"{len(odd_names)}: {', '.join(odd_names[:3])}"
                findings.append(
                    make_finding("sensor-odd-name", scenario.token, str(folder), message)
                )
            if frames:
                inventory[agent, channel] = frames
                findings += _frame_findings(scenario, scan, folder, frames)
                findings += _file_findings(scenario, folder, CHANNEL_FORMAT[channel])
    return inventory, findings


def absences(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[Finding]:
    """Yield the parts that a partial download lacks completely: agents, labels, meta."""
    token = scenario.token
    missing = [agent for agent in AGENTS if agent not in scan.agents]
    with_labels = [agent for agent in missing if scenario.kind_folder(agent, "label").is_dir()]
    for agent in with_labels:
        location = str(scenario.kind_folder(agent, "calib"))
        message = f"{agent} has labels, but no calib files"
        yield make_finding("labels-without-calib", token, location, message)
    missing = [agent for agent in missing if agent not in with_labels]
    if missing:
        yield make_finding("agent-missing", token, token, f"has no {', '.join(missing)}")
    unlabelled = [agent for agent in scan.agents if agent not in scan.labelled]
    if unlabelled:
        code = "agent-unlabelled" if scan.labelled else "unlabelled"
        yield make_finding(code, token, token, f"no labels of {', '.join(unlabelled)}")
    if scan.labelled and not scan.has_meta:
        location = str(scenario.meta_path)
        yield make_finding("meta-missing", token, location, "missing or not readable")


def _frame_findings(
    scenario: ScenarioFolder, scan: ScenarioScan, folder: ReleasePath, frames: list[int]
) -> Iterator[Finding]:
    """Yield the missing and surplus frames of a sensor folder."""
    expected = set(range(1, scan.num_frames + 1))
    missing = sorted(expected - set(frames))
    extra = sorted(set(frames) - expected)
    present = sorted(expected & set(frames))
    is_sparse = len(present) <= _MAX_LISTED_FRAMES and len(present) < len(expected) / 2
    if missing and is_sparse:
        listed = ", ".join(map(str, present))
        message = f"has {len(present)} of {scan.num_frames} frames ({listed})"
        finding = make_finding("sensor-frames-missing", scenario.token, str(folder), message)
        yield replace(finding, remedy=f"{finding.remedy}, if you want all")
    elif missing:
        message = f"lacks {frames_text(missing)} of 1 to {scan.num_frames}"
        yield make_finding("sensor-frames-missing", scenario.token, str(folder), message)
    if extra:
        message = f"has frames {frame_ranges(extra)} beyond {scan.num_frames}"
        yield make_finding("sensor-frames-extra", scenario.token, str(folder), message)


def _file_findings(
    scenario: ScenarioFolder, folder: ReleasePath, extension: str
) -> Iterator[Finding]:
    """Yield the empty and irregular files of a sensor folder."""
    for entry in sorted(store.folder_entries(folder), key=lambda entry: entry.name):
        path = str(folder / entry.name)
        try:
            status = entry.stat()
            irregular = irregular_text(status.st_mode)
        except OSError as error:
            status = None
            irregular = fault_text(error)
        if status and not irregular and not status.st_size:
            yield make_finding("sensor-empty", scenario.token, path, "has no bytes")
        elif irregular and entry.name.endswith(f".{extension}"):
            yield make_finding("sensor-irregular", scenario.token, path, irregular)


def check_split_files(layout: ReleaseLayout) -> tuple[ReleaseLayout, list[Finding]]:
    """Return the release with its readable split files only, and the findings in all of them."""
    findings: list[Finding] = []
    readable: dict[str, ReleasePath] = {}
    for split, path in layout.split_files.items():
        try:
            tokens = read_split_file(path, raw=True)
        except ReleaseError as error:
            findings.append(finding_of(error, "split-file-unreadable", None))
            continue
        readable[split] = path
        findings += _find_repeated(path, tokens)
    layout = replace(layout, split_files=readable)
    splits = assign_splits(layout)
    return layout, [*findings, *_assignment_findings(splits), *_find_torn_twins(splits)]


def _find_repeated(path: ReleasePath, tokens: list[str]) -> Iterator[Finding]:
    """Yield a finding of scenarios that a file lists more than once; reading takes them once."""
    counts = Counter(tokens)
    repeated = [token.replace("/", " ", 1) for token in counts if counts[token] > 1]
    if repeated:
        listed = ", ".join(map(shortened, repeated[:_MAX_NAMED_LINES]))
        if len(repeated) > _MAX_NAMED_LINES:
            listed += f" and {len(repeated) - _MAX_NAMED_LINES} more"
        message = f"lists more than once: {listed}"
        yield make_finding("split-file-repeats", None, str(path), message)


def _assignment_findings(splits: SplitAssignment) -> Iterator[Finding]:
    for token, messages in splits.problems.items():
        for message in messages:
            yield make_finding("two-places", token, token, message.rpartition(";")[0])
    for token in splits.unlisted:
        yield make_finding("in-no-split", token, token, "no split file lists it")
    for token, messages in splits.contradictions.items():
        if token in splits.problems:
            continue
        for message in messages:
            yield make_finding("splits-contradict", token, token, message)
    for notice in splits.notices:
        location, _, message = notice.partition(": ")
        yield make_finding("split-file-partial", None, location, message)


def _find_torn_twins(splits: SplitAssignment) -> Iterator[Finding]:
    """Yield scenarios of one name and family in different splits, such as an accident's twin."""
    known = dict(splits.split_of)
    for token in (*splits.problems, *splits.contradictions):
        known.pop(token, None)
    for twins in torn_twins(known):
        pairs = zip(twins.scenarios, twins.splits, strict=True)
        for (token, split), (other, other_split) in permutations(pairs):
            message = f"is of {split}, its twin {other} of {other_split}"
            yield make_finding("twins-apart", token, token, message)
