"""Which split each scenario belongs to: the split files, else the folder of layout B, else unknown."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

from deepaccident_devkit.release import ReleaseLayout, read_split_file
from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitAssignment:
    """The splits of a release's scenarios.

    Attributes:
        split_of: scenario token → split; absent where it is unknown.
        problems: scenario token → why it has no single place, a sentence each.
        unlisted: scenarios that no split file lists, though there is one of every split.
        contradictions: scenario token → how files and folders contradict each other; the files win.
        notices: what is odd but harmless, a sentence each.
    """

    split_of: Mapping[str, str]
    problems: Mapping[str, tuple[str, ...]]
    unlisted: tuple[str, ...]
    contradictions: Mapping[str, tuple[str, ...]]
    notices: tuple[str, ...]


def assign_splits(layout: ReleaseLayout) -> SplitAssignment:
    """Read the split files and compare them with the folders; raises SplitFileError for any other file."""
    listed = {split: set(read_split_file(path)) for split, path in layout.split_files.items()}
    tokens = {scenario.token for scenario in layout.scenarios}
    problems: dict[str, list[str]] = {}
    for group in (SPLITS, MINI_SPLITS):
        for first, second in combinations([split for split in group if split in listed], 2):
            for token in sorted(listed[first] & listed[second] & tokens):
                files = f"{layout.split_files[first]} and {layout.split_files[second]}"
                problems.setdefault(token, []).append(f"stands in two splits: {files}; remove it from one")
    for token, folders in _folders_of(layout).items():
        if len(folders) > 1:
            places = " and ".join(str(layout.root / folder) for folder in folders)
            problems.setdefault(token, []).append(f"stands in two folders: {places}; remove one")
    in_folder = {scenario.token: scenario.folder for scenario in layout.scenarios if scenario.folder in SPLITS}
    in_files = {token: split for split in SPLITS for token in listed.get(split, ())}
    missing = {split: len(set(listed.get(split, ())) - tokens) for split in SPLITS}
    return SplitAssignment(
        split_of={token: split for token, split in {**in_folder, **in_files}.items() if token in tokens},
        problems={token: tuple(messages) for token, messages in problems.items()},
        unlisted=tuple(sorted(tokens - set(in_files))) if set(SPLITS) <= set(listed) else (),
        contradictions=_contradictions(listed, in_folder),
        notices=tuple(
            f"{layout.split_files[split]}: lists {count} scenarios that are not in this release"
            for split, count in missing.items()
            if count
        ),
    )


def _contradictions(listed: Mapping[str, set[str]], in_folder: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    messages: dict[str, list[str]] = {}
    for token, folder in in_folder.items():
        for split in SPLITS:
            if split != folder and token in listed.get(split, ()):
                messages.setdefault(token, []).append(f"lies in {folder}/, {split}.txt lists it")
    for mini in MINI_SPLITS:
        split = mini.removesuffix("_mini")
        if split in listed:
            for token in sorted(listed.get(mini, set()) - listed[split]):
                messages.setdefault(token, []).append(f"{mini}.txt lists it, {split}.txt does not")
    return {token: tuple(found) for token, found in messages.items()}


def _folders_of(layout: ReleaseLayout) -> dict[str, list[str]]:
    folders: dict[str, list[str]] = {}
    for scenario in layout.scenarios:
        folders.setdefault(scenario.token, []).append(scenario.folder)
    return folders
