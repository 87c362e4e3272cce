"""Checks which sensor files are present, and what the split files list."""

from collections import Counter
from collections.abc import Mapping
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
from deepaccident_devkit.validation.subject import Findings, frames_text, make_finding

# Largest number of present frames for which a finding lists these instead of the missing ones.
_MAX_LISTED_FRAMES = 10
# Largest number of repeated lines that a finding lists.
_MAX_NAMED_LINES = 3
# Agent and kind of file: `label`, `calib` or a channel.
_Recording = tuple[str, str]


Inventory = Mapping[_Recording, list[int]]
"""Recording → frame numbers in its sensor folder, for the folders that have any."""


def take_inventory(scenario: ScenarioFolder, scan: ScenarioScan) -> tuple[Inventory, list[Finding]]:
    """List a scenario's sensor folders, and find faults in them.

    A channel without any files was not downloaded, which is not a fault.
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


def absences(scenario: ScenarioFolder, scan: ScenarioScan) -> Findings:
    """Yield findings about what a partial download lacks entirely: agents, labels, meta."""
    token = scenario.token
    missing_agents = [agent for agent in AGENTS if agent not in scan.agents]
    absent = []
    for agent in missing_agents:
        if not scenario.kind_folder(agent, "label").is_dir():
            absent.append(agent)
            continue
        location = str(scenario.kind_folder(agent, "calib"))
        message = f"{agent} has labels but no calib files"
        yield make_finding("labels-without-calib", token, location, message)
    if absent:
        yield make_finding("agent-missing", token, token, f"has no {', '.join(absent)}")
    unlabelled = [agent for agent in scan.agents if agent not in scan.labelled]
    if unlabelled:
        code = "agent-unlabelled" if scan.labelled else "unlabelled"
        yield make_finding(code, token, token, f"no labels of {', '.join(unlabelled)}")
    if scan.labelled and not scan.has_meta:
        location = str(scenario.meta_path)
        yield make_finding("meta-missing", token, location, "missing or not readable")


def _frame_findings(
    scenario: ScenarioFolder, scan: ScenarioScan, folder: ReleasePath, frames: list[int]
) -> Findings:
    """Yield findings about missing and surplus frames in a sensor folder."""
    expected = set(range(1, scan.num_frames + 1))
    missing = sorted(expected - set(frames))
    surplus = sorted(set(frames) - expected)
    present = sorted(expected & set(frames))
    is_sparse = len(present) <= _MAX_LISTED_FRAMES and len(present) < len(expected) / 2
    if missing and is_sparse:
        listed_frames = ", ".join(map(str, present))
        message = f"has {len(present)} of {scan.num_frames} frames ({listed_frames})"
        finding = make_finding("sensor-frames-missing", scenario.token, str(folder), message)
        yield replace(finding, remedy=f"{finding.remedy} if you need them")
    elif missing:
        message = f"lacks {frames_text(missing)} (expected 1 to {scan.num_frames})"
        yield make_finding("sensor-frames-missing", scenario.token, str(folder), message)
    if surplus:
        message = f"has frames {frame_ranges(surplus)} after the last frame {scan.num_frames}"
        yield make_finding("sensor-frames-extra", scenario.token, str(folder), message)


def _file_findings(scenario: ScenarioFolder, folder: ReleasePath, extension: str) -> Findings:
    """Yield findings about empty and irregular files in a sensor folder."""
    for entry in sorted(store.folder_entries(folder), key=lambda entry: entry.name):
        path = str(folder / entry.name)
        try:
            status = entry.stat()
            irregular = irregular_text(status.st_mode)
        except OSError as error:
            status = None
            irregular = fault_text(error)
        if status and not irregular and not status.st_size:
            yield make_finding("sensor-empty", scenario.token, path, "the file is empty")
        elif irregular and entry.name.endswith(f".{extension}"):
            yield make_finding("sensor-irregular", scenario.token, path, irregular)


def check_split_files(layout: ReleaseLayout) -> tuple[ReleaseLayout, list[Finding]]:
    """Return the release with only its readable split files, and the findings about all of them."""
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


def _find_repeated(path: ReleasePath, tokens: list[str]) -> Findings:
    """Yield a finding if a file lists scenarios more than once; readers use each only once."""
    counts = Counter(tokens)
    repeated = [token.replace("/", " ", 1) for token in counts if counts[token] > 1]
    if repeated:
        listed_tokens = ", ".join(map(shortened, repeated[:_MAX_NAMED_LINES]))
        if len(repeated) > _MAX_NAMED_LINES:
            listed_tokens += f" and {len(repeated) - _MAX_NAMED_LINES} more"
        message = f"lists more than once: {listed_tokens}"
        yield make_finding("split-file-repeats", None, str(path), message)


def _assignment_findings(splits: SplitAssignment) -> Findings:
    for token, messages in splits.problems.items():
        for message in messages:
            yield make_finding("two-places", token, token, message.rpartition(";")[0])
    for token in splits.unlisted:
        yield make_finding("in-no-split", token, token, "not listed in any split file")
    for token, messages in splits.contradictions.items():
        if token in splits.problems:
            continue
        for message in messages:
            yield make_finding("splits-contradict", token, token, message)
    for notice in splits.notices:
        location, _, message = notice.partition(": ")
        yield make_finding("split-file-partial", None, location, message)


def _find_torn_twins(splits: SplitAssignment) -> Findings:
    """Yield findings about twins (such as an accident and its normal twin) in different splits.

    Twins have the same name and family.
    """
    split_by_token = dict(splits.split_of)
    for token in (*splits.problems, *splits.contradictions):
        split_by_token.pop(token, None)
    for twins in torn_twins(split_by_token):
        pairs = zip(twins.scenarios, twins.splits, strict=True)
        for (token, split), (other, other_split) in permutations(pairs):
            message = f"is in {split}, but its twin {other} is in {other_split}"
            yield make_finding("twins-apart", token, token, message)
