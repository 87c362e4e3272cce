"""Splits, folders, and what a partial release lacks."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index
from deepaccident_devkit.tables.scan import folder_digest
from deepaccident_devkit.taxonomy import BEV_CAMERA, CHANNELS
from fault_injection.kinds import Group
from fault_injection.place import FILE_ENDINGS, Place

GROUP = Group("release")
PARTIAL = "a partial download: users unpack some sensors only (docs/format.md, Tree)"


def _line(place: Place) -> bytes:
    return place.token.replace("/", " ").encode() + b"\n"


def _append(place: Place, name: str, line: bytes) -> None:
    path = place.root / name
    place.write(path, path.read_bytes() + line)


def _drop(place: Place, *lines: bytes) -> None:
    """Drop lines from the files of train."""
    for path in (place.root / "train.txt", place.root / "train_mini.txt"):
        for line in lines:
            place.write(path, path.read_bytes().replace(line, b""))


def _files(place: Place) -> list[Path]:
    kinds = [(agent, kind) for agent in place.agents for kind in ("label", "calib")]
    return [
        place.scenario.meta_path,
        *(place.file(*each, frame) for each in kinds for frame in place.frames),
    ]


def _list_with_its_twin_elsewhere(place: Place, rng: np.random.Generator) -> None:
    _drop(place, _line(place))
    _append(place, str(rng.choice(["val.txt", "test.txt"])), _line(place))


def _copy_to_val(place: Place, rng: np.random.Generator) -> None:
    for path in _files(place):
        place.write(place.root / "val" / path.relative_to(place.root), path.read_bytes())


def _unpack_beside(place: Place, rng: np.random.Generator) -> None:
    kind = place.scenario.scenario_type
    name = kind + str(rng.choice(["-001", " (1)", " 2", "-20240101T000000Z-001"]))
    agent = place.any_agent(rng)
    for path in _files(place):
        if agent in path.parts:
            place.write(place.root / name / path.relative_to(place.root / kind), path.read_bytes())
            place.remove(path)


def _exchange_agents(place: Place, rng: np.random.Generator) -> None:
    one, other = (str(agent) for agent in rng.choice(place.agents[:4], size=2, replace=False))
    for kind in FILE_ENDINGS:
        place.exchange_agents((one, other), kind, place.frames)


def _remove_folders(place: Place, agents: Sequence[str], kinds: Sequence[str]) -> None:
    for agent in agents:
        for kind in kinds:
            place.remove_folder(place.folder(agent, kind))


def _to_the_test_split(place: Place, rng: np.random.Generator) -> None:
    line, words = _line(place), (b"_accident ", b"_normal ")
    twin = line.replace(*(words if words[0] in line else words[::-1]))
    _drop(place, line, twin)
    _append(place, "test.txt", line + twin)
    _remove_folders(place, place.agents, ("label", BEV_CAMERA))
    place.remove(place.scenario.meta_path)


def _move_split_files(place: Place, rng: np.random.Generator) -> None:
    for path in sorted(place.root.glob("*.txt")):
        place.write(place.root / "split_txt_files" / path.name, path.read_bytes())
        place.remove(path)


def _rename(place: Place, rng: np.random.Generator) -> None:
    odd = os.fsdecode(rng.choice([b"\xff\xfe", b"\xe4\xf6", b"\xc3", b"\xed\xb3\xbf"]))
    for path in _files(place):
        name = str(path.relative_to(place.root)).replace(place.scenario.name, odd)
        place.write(place.root / name, path.read_bytes())
        place.remove(path)


def _index_of_others(place: Place, rng: np.random.Generator) -> None:
    """Leave an index that takes a label for the one that it was made from, as if this was written
    in place.
    """
    index = open_index(find_release(place.root))
    path = place.file(place.any_agent(rng), "label", place.any_frame(rng))
    place.write(path, path.read_bytes() + b"\n")
    layout = find_release(place.root)
    replace(index, fingerprint=folder_digest(layout.scenarios, layout.split_files.values())).write()


GROUP.add(
    {
        "name_not_utf8": ("The scenario's name is not UTF-8.", _rename),
        "index_of_other_files": (
            "A label was written in place, in a way that does no harm, after the index was made.",
            _index_of_others,
        ),
        "scenario_in_two_splits": (
            "A second split file lists the scenario.",
            lambda place, rng: _append(
                place, str(rng.choice(["val.txt", "test.txt"])), _line(place)
            ),
        ),
        "twins_in_two_splits": (
            "The scenario is listed in another split than its twin.",
            _list_with_its_twin_elsewhere,
        ),
        "split_line_twice": (
            "A split file lists the scenario twice.",
            lambda place, rng: _append(
                place, str(rng.choice(["train.txt", "train_mini.txt"])), _line(place)
            ),
        ),
        "scenario_in_no_split": (
            "No split file lists the scenario.",
            lambda place, _: _drop(place, _line(place)),
        ),
        "scenario_in_two_folders": (
            "The scenario is in a split folder too (layout B).",
            _copy_to_val,
        ),
        "type_folder_unpacked_beside": (
            (
                "An agent's files are in a folder beside the scenario type's, as a "
                "second download is unpacked."
            ),
            _unpack_beside,
        ),
        "split_line_of_one_word": (
            "A split file has a line with a single word.",
            lambda place, rng: _append(
                place,
                str(rng.choice(["train.txt", "val.txt"])),
                place.scenario.name.encode() + b"\n",
            ),
        ),
        "split_file_garbage": (
            "A split file is no text.",
            lambda place, _: place.write(place.root / "val.txt", bytes(range(256))),
        ),
    },
)
GROUP.add(
    {
        "split_lists_absent_scenario": (
            "A split file lists a scenario that is not there.",
            lambda place, _: _append(
                place,
                "train.txt",
                b"type1_subtype2_normal Town07_type001_subtype0002_scenario00099\n",
            ),
        ),
    },
    harmless="a partial download lacks scenarios that the split files list",
)
GROUP.add({"agents_exchanged": ("All folders of two vehicles are exchanged.", _exchange_agents)})
GROUP.add(
    {
        "agent_removed": (
            "All files of an agent are absent.",
            lambda place, rng: _remove_folders(place, [place.any_agent(rng)], list(FILE_ENDINGS)),
        ),
    },
    harmless="a partial download: a scenario without one of the agents is valid "
    "(docs/format.md, Tree)",
)
GROUP.add(
    {
        "sensor_removed": (
            "All files of one sensor are absent in all agents.",
            lambda place, rng: _remove_folders(place, place.agents, [str(rng.choice(CHANNELS))]),
        ),
        "all_sensors_removed": (
            "All sensors of all agents are absent; only labels and calib are there.",
            lambda place, _: _remove_folders(place, place.agents, CHANNELS),
        ),
    },
    harmless=PARTIAL,
)
GROUP.add(
    {
        "test_labels_removed": (
            (
                "The scenario is of the test split, as its twin is, and has no labels, "
                "no BEV arrays and no meta."
            ),
            _to_the_test_split,
        ),
    },
    harmless="the real test split has no labels, no BEV arrays and sometimes no "
    "meta (docs/format.md, Tree)",
)
GROUP.add(
    {"split_files_moved": ("The split files are under split_txt_files/.", _move_split_files)},
    harmless="split files can be in their own folder (docs/format.md, Tree)",
)
