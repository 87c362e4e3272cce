"""Split files, folders, and files that a partial release lacks."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index
from deepaccident_devkit.tables.scan import folder_digest
from deepaccident_devkit.taxonomy import BEV_CAMERA, CHANNELS
from fault_injection.editor import FILE_ENDINGS, UndoableEditor
from fault_injection.kinds import Group

GROUP = Group("release")
PARTIAL_DOWNLOAD = "a partial download: users unpack some sensors only (docs/format.md, Tree)"


def _split_line(editor: UndoableEditor) -> bytes:
    return editor.token.replace("/", " ").encode() + b"\n"


def _append_line(editor: UndoableEditor, name: str, line: bytes) -> None:
    editor.append(editor.root / name, line)


def _drop_from_train(editor: UndoableEditor, *lines: bytes) -> None:
    """Remove lines from the split files of train."""
    for path in (editor.root / "train.txt", editor.root / "train_mini.txt"):
        for line in lines:
            editor.write(path, path.read_bytes().replace(line, b""))


def _metadata_files(editor: UndoableEditor) -> list[Path]:
    """Return the paths of the meta file and of all labels and calib files."""
    return [
        editor.scenario.meta_path,
        *(
            editor.file(agent, kind, frame)
            for agent in editor.agents
            for kind in ("label", "calib")
            for frame in editor.frames
        ),
    ]


def _list_in_another_split(editor: UndoableEditor, rng: np.random.Generator) -> None:
    _drop_from_train(editor, _split_line(editor))
    _append_line(editor, str(rng.choice(["val.txt", "test.txt"])), _split_line(editor))


def _copy_to_val(editor: UndoableEditor, rng: np.random.Generator) -> None:
    for path in _metadata_files(editor):
        editor.write(editor.root / "val" / path.relative_to(editor.root), path.read_bytes())


def _unpack_beside_type_folder(editor: UndoableEditor, rng: np.random.Generator) -> None:
    scenario_type = editor.scenario.scenario_type
    name = scenario_type + str(rng.choice(["-001", " (1)", " 2", "-20240101T000000Z-001"]))
    agent = editor.any_agent(rng)
    for path in _metadata_files(editor):
        if agent in path.parts:
            new_path = editor.root / name / path.relative_to(editor.root / scenario_type)
            editor.write(new_path, path.read_bytes())
            editor.remove(path)


def _exchange_agents(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, other = map(str, rng.choice(editor.agents[:4], size=2, replace=False))
    for kind in FILE_ENDINGS:
        editor.exchange_agents((agent, other), kind, editor.frames)


def _remove_folders(editor: UndoableEditor, agents: Sequence[str], kinds: Sequence[str]) -> None:
    for agent in agents:
        for kind in kinds:
            editor.remove_folder(editor.folder(agent, kind))


def _move_to_test_split(editor: UndoableEditor, rng: np.random.Generator) -> None:
    line = _split_line(editor)
    if b"_accident " in line:
        line_of_twin = line.replace(b"_accident ", b"_normal ")
    else:
        line_of_twin = line.replace(b"_normal ", b"_accident ")
    _drop_from_train(editor, line, line_of_twin)
    _append_line(editor, "test.txt", line + line_of_twin)
    _remove_folders(editor, editor.agents, ("label", BEV_CAMERA))
    editor.remove(editor.scenario.meta_path)


def _move_split_files(editor: UndoableEditor, rng: np.random.Generator) -> None:
    for path in sorted(editor.root.glob("*.txt")):
        editor.write(editor.root / "split_txt_files" / path.name, path.read_bytes())
        editor.remove(path)


def _rename_scenario(editor: UndoableEditor, rng: np.random.Generator) -> None:
    odd_name = os.fsdecode(rng.choice([b"\xff\xfe", b"\xe4\xf6", b"\xc3", b"\xed\xb3\xbf"]))
    for path in _metadata_files(editor):
        new_path = str(path.relative_to(editor.root)).replace(editor.scenario.name, odd_name)
        editor.write(editor.root / new_path, path.read_bytes())
        editor.remove(path)


def _make_index_of_other_files(editor: UndoableEditor, rng: np.random.Generator) -> None:
    """Change a label after the index was made, in a way that the index cannot notice.

    This is what happens when a file is written in place.
    """
    index = open_index(find_release(editor.root))
    path = editor.file(editor.any_agent(rng), "label", editor.any_frame(rng))
    editor.append(path, b"\n")
    layout = find_release(editor.root)
    fingerprint = folder_digest(layout.scenarios, layout.split_files.values())
    replace(index, fingerprint=fingerprint).write()


GROUP.add(
    {
        "name_not_utf8": ("The scenario's name is not UTF-8.", _rename_scenario),
        "index_of_other_files": (
            "A label was written in place, in a way that does no harm, after the index was made.",
            _make_index_of_other_files,
        ),
        "scenario_in_two_splits": (
            "A second split file lists the scenario.",
            lambda editor, rng: _append_line(
                editor, str(rng.choice(["val.txt", "test.txt"])), _split_line(editor)
            ),
        ),
        "twins_in_two_splits": (
            "The scenario is listed in another split than its twin.",
            _list_in_another_split,
        ),
        "split_line_twice": (
            "A split file lists the scenario twice.",
            lambda editor, rng: _append_line(
                editor, str(rng.choice(["train.txt", "train_mini.txt"])), _split_line(editor)
            ),
        ),
        "scenario_in_no_split": (
            "No split file lists the scenario.",
            lambda editor, _: _drop_from_train(editor, _split_line(editor)),
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
            _unpack_beside_type_folder,
        ),
        "split_line_of_one_word": (
            "A split file has a line with a single word.",
            lambda editor, rng: _append_line(
                editor,
                str(rng.choice(["train.txt", "val.txt"])),
                editor.scenario.name.encode() + b"\n",
            ),
        ),
        "split_file_garbage": (
            "A split file is no text.",
            lambda editor, _: editor.write(editor.root / "val.txt", bytes(range(256))),
        ),
    },
)
GROUP.add(
    {
        "split_lists_absent_scenario": (
            "A split file lists a scenario that is not there.",
            lambda editor, _: _append_line(
                editor,
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
            lambda editor, rng: _remove_folders(
                editor, [editor.any_agent(rng)], list(FILE_ENDINGS)
            ),
        ),
    },
    harmless="a partial download: a scenario without one of the agents is valid "
    "(docs/format.md, Tree)",
)
GROUP.add(
    {
        "sensor_removed": (
            "All files of one sensor are absent in all agents.",
            lambda editor, rng: _remove_folders(editor, editor.agents, [str(rng.choice(CHANNELS))]),
        ),
        "all_sensors_removed": (
            "All sensors of all agents are absent; only labels and calib are there.",
            lambda editor, _: _remove_folders(editor, editor.agents, CHANNELS),
        ),
    },
    harmless=PARTIAL_DOWNLOAD,
)
GROUP.add(
    {
        "test_labels_removed": (
            (
                "The scenario is of the test split, as its twin is, and has no labels, "
                "no BEV arrays and no meta."
            ),
            _move_to_test_split,
        ),
    },
    harmless="the real test split has no labels, no BEV arrays and sometimes no "
    "meta (docs/format.md, Tree)",
)
GROUP.add(
    {"split_files_moved": ("The split files are under split_txt_files/.", _move_split_files)},
    harmless="split files can be in their own folder (docs/format.md, Tree)",
)
