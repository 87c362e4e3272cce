"""Files that are missing or that do not belong in the release."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.taxonomy import CHANNELS
from fault_injection.editor import FILE_ENDINGS, UndoableEditor
from fault_injection.kinds import Group

GROUP = Group("frames")


def _remove_frame(editor: UndoableEditor, agents: Sequence[str], frame: int) -> None:
    for agent in agents:
        for kind in FILE_ENDINGS:
            editor.remove(editor.file(agent, kind, frame))


def _remove_one_file(editor: UndoableEditor, rng: np.random.Generator, *kinds: str) -> None:
    agent = editor.any_agent(rng)
    kind = kinds[0] if len(kinds) == 1 else str(rng.choice(kinds))
    editor.remove(editor.file(agent, kind, editor.any_frame(rng)))


def _replace_folder_by_file(editor: UndoableEditor, rng: np.random.Generator) -> None:
    folder = editor.folder(editor.any_agent(rng), "label")
    editor.remove_folder(folder)
    editor.write(folder, b"")


def _repeat_last(
    editor: UndoableEditor, agents: Sequence[str], *kinds: str, later: int = 1
) -> None:
    """Copy the agents' last files of the kinds to a later frame."""
    last_frame = editor.frames[-1]
    for agent in agents:
        for kind in kinds:
            editor.take(agent, kind, last_frame + later, agent, last_frame)


def _rename_file(
    editor: UndoableEditor, rng: np.random.Generator, old: str, new: str, *, copied: bool
) -> None:
    agent = editor.any_agent(rng)
    kind = str(rng.choice(list(FILE_ENDINGS)))
    frame = editor.any_frame(rng)
    path = editor.file(agent, kind, frame)
    new_name = path.name.replace(old.format(frame), new.format(frame))
    editor.write(path.with_name(new_name), path.read_bytes())
    if not copied:
        editor.remove(path)


def _add_stray_files(editor: UndoableEditor, rng: np.random.Generator) -> None:
    folder = editor.folder(editor.any_agent(rng), "label")
    for name in (".DS_Store", "Thumbs.db", "README"):
        editor.write(folder / name, b"stray")


GROUP.add(
    {
        "last_frame_removed": (
            "The last frame of all agents is missing.",
            lambda editor, _: _remove_frame(editor, editor.agents, editor.frames[-1]),
        ),
        "first_frame_removed": (
            "The first frame of all agents is missing.",
            lambda editor, _: _remove_frame(editor, editor.agents, editor.frames[0]),
        ),
        "middle_frame_removed": (
            "A frame in the middle of the scenario is missing in all agents.",
            lambda editor, rng: _remove_frame(editor, editor.agents, editor.middle_frame(rng)),
        ),
        "middle_frame_of_agent_removed": (
            "A frame in the middle of the scenario is missing in one agent.",
            lambda editor, rng: _remove_frame(
                editor, [editor.any_agent(rng)], editor.middle_frame(rng)
            ),
        ),
        "last_frame_of_agent_removed": (
            "The last frame of one agent is missing.",
            lambda editor, rng: _remove_frame(editor, [editor.any_agent(rng)], editor.frames[-1]),
        ),
        "label_removed": (
            "A label file is missing.",
            lambda editor, rng: _remove_one_file(editor, rng, "label"),
        ),
        "calib_removed": (
            "A calib file is missing.",
            lambda editor, rng: _remove_one_file(editor, rng, "calib"),
        ),
        "sensor_file_removed": (
            "A file of one sensor is missing.",
            lambda editor, rng: _remove_one_file(editor, rng, *CHANNELS),
        ),
        "labels_of_agent_removed": (
            "One agent has no labels, but the others have.",
            lambda editor, rng: editor.remove_folder(editor.folder(editor.any_agent(rng), "label")),
        ),
        "calibs_of_agent_removed": (
            "One agent has labels and sensors, but no calib files.",
            lambda editor, rng: editor.remove_folder(editor.folder(editor.any_agent(rng), "calib")),
        ),
        "file_for_folder": (
            "A file is where an agent's folder of labels must be.",
            _replace_folder_by_file,
        ),
        "extra_frame": (
            "An agent has a copy of its last frame as one more frame.",
            lambda editor, rng: _repeat_last(editor, [editor.any_agent(rng)], *FILE_ENDINGS),
        ),
        "extra_frame_of_all": (
            "All agents have a copy of their last frame as one more frame.",
            lambda editor, _: _repeat_last(editor, editor.agents, *FILE_ENDINGS),
        ),
        "extra_label": (
            "An agent has a label file of a frame that no agent recorded.",
            lambda editor, rng: _repeat_last(editor, [editor.any_agent(rng)], "label", later=3),
        ),
        "extra_image": (
            "An agent has an image of a frame that no agent recorded.",
            lambda editor, rng: _repeat_last(editor, [editor.any_agent(rng)], "Camera_Front"),
        ),
        "file_renamed": (
            "A file's frame number has two digits.",
            lambda editor, rng: _rename_file(editor, rng, "_{:03d}.", "_{:02d}.", copied=False),
        ),
        "file_of_another_scenario": (
            "A folder has a file with another scenario's name.",
            lambda editor, rng: _rename_file(editor, rng, "scenario0", "scenario9", copied=True),
        ),
    },
)
GROUP.add(
    {"stray_files": ("Folders have .DS_Store, Thumbs.db and a note.", _add_stray_files)},
    harmless="operating systems make such files; no reader opens them",
)
