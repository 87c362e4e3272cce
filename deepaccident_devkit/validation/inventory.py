"""Checks of which files are there, and of the split files."""

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

# Frames that are listed if a folder has no more.
_FEW = 10
# Agent and kind of file: `label`, `calib` or a channel.
_Recording = tuple[str, str]


Inventory = Mapping[_Recording, list[int]]
"""Frame numbers of the sensor folders of a scenario that have any."""
# Repeated lines that a finding names at most.
_NAMED = 3


def take_inventory(scenario: ScenarioFolder, scan: ScenarioScan) -> tuple[Inventory, list[Finding]]:
    """List a scenario's sensor folders; a channel that is wholly absent was not downloaded, and is no finding."""
    findings: list[Finding] = []
    frames: dict[_Recording, list[int]] = {}
    for agent in scan.agents:
        for channel in CHANNELS:
            folder = scenario.kind_folder(agent, channel)
            try:
                found, odd = frame_numbers(folder, CHANNEL_FORMAT[channel])
            except ReleaseError as error:
                findings.append(finding_of(error, "folder-unreadable", scenario.token))
                continue
            if odd:
                names = ", ".join(odd[:3])
                findings.append(
                    make_finding(
                        "sensor-odd-name", scenario.token, str(folder), f"{len(odd)}: {names}"
                    )
                )
            if found:
                frames[agent, channel] = found
                findings += _frame_findings(scenario, scan, agent, channel, found)
    return frames, findings


def absences(scenario: ScenarioFolder, scan: ScenarioScan) -> Iterator[Finding]:
    """Whole parts that a partial download lacks: agents, labels, meta."""
    token = scenario.token
    missing = [agent for agent in AGENTS if agent not in scan.agents]
    with_labels = [agent for agent in missing if scenario.kind_folder(agent, "label").is_dir()]
    for agent in with_labels:
        where = str(scenario.kind_folder(agent, "calib"))
        yield make_finding(
            "labels-without-calib", token, where, f"{agent} has labels, but no calib files"
        )
    missing = [agent for agent in missing if agent not in with_labels]
    if missing:
        yield make_finding("agent-missing", token, token, f"has no {', '.join(missing)}")
    unlabelled = [agent for agent in scan.agents if agent not in scan.labelled]
    if unlabelled:
        code = "agent-unlabelled" if scan.labelled else "unlabelled"
        yield make_finding(code, token, token, f"no labels of {', '.join(unlabelled)}")
    if scan.labelled and not scan.has_meta:
        yield make_finding(
            "meta-missing", token, str(scenario.meta_path), "missing or not readable"
        )


def _frame_findings(
    scenario: ScenarioFolder, scan: ScenarioScan, agent: str, channel: str, found: list[int]
) -> Iterator[Finding]:
    folder = scenario.kind_folder(agent, channel)
    expected = set(range(1, scan.num_frames + 1))
    missing, extra = sorted(expected - set(found)), sorted(set(found) - expected)
    there = expected & set(found)
    if missing and len(there) <= _FEW and len(there) < len(expected) / 2:
        listed = ", ".join(map(str, sorted(there)))
        what = f"has {len(there)} of {scan.num_frames} frames ({listed})"
        finding = make_finding("sensor-frames-missing", scenario.token, str(folder), what)
        yield replace(finding, remedy=f"{finding.remedy}, if you want all")
    elif missing:
        what = f"lacks {frames_text(missing)} of 1 to {scan.num_frames}"
        yield make_finding("sensor-frames-missing", scenario.token, str(folder), what)
    if extra:
        what = f"has frames {frame_ranges(extra)} beyond {scan.num_frames}"
        yield make_finding("sensor-frames-extra", scenario.token, str(folder), what)
    for entry in sorted(store.folder_entries(folder), key=lambda entry: entry.name):
        path = folder / entry.name
        try:
            status = entry.stat()
            irregular = irregular_text(status.st_mode)
        except OSError as error:
            status, irregular = None, fault_text(error)
        if status and not irregular and not status.st_size:
            yield make_finding("sensor-empty", scenario.token, str(path), "has no bytes")
        elif irregular and entry.name.endswith(f".{CHANNEL_FORMAT[channel]}"):
            yield make_finding("sensor-irregular", scenario.token, str(path), irregular)


def check_split_files(layout: ReleaseLayout) -> tuple[ReleaseLayout, list[Finding]]:
    """The release with those split files that can be read, and what is wrong with all of them."""
    found: list[Finding] = []
    readable: dict[str, ReleasePath] = {}
    for split, path in layout.split_files.items():
        try:
            tokens = read_split_file(path, raw=True)
        except ReleaseError as error:
            found.append(finding_of(error, "split-file-unreadable", None))
            continue
        readable[split] = path
        found += _repeated(path, tokens)
    layout = replace(layout, split_files=readable)
    splits = assign_splits(layout)
    return layout, [*found, *_assignment_findings(splits), *_twins(splits)]


def _repeated(path: ReleasePath, tokens: list[str]) -> Iterator[Finding]:
    """Scenarios that a file lists more than once; reading takes them once."""
    repeated = [
        shortened(token.replace("/", " ", 1))
        for token, count in Counter(tokens).items()
        if count > 1
    ]
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
        for (token, mine), (other, theirs) in permutations(
            zip(twins.scenarios, twins.splits, strict=True)
        ):
            yield make_finding(
                "twins-apart", token, token, f"is of {mine}, its twin {other} of {theirs}"
            )
