"""Files that are missing, or there though they should not be."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.taxonomy import CHANNELS
from fault_injection.kinds import Group
from fault_injection.place import FILE_ENDINGS, Place

GROUP = Group("frames")


def _remove_frame(place: Place, agents: Sequence[str], frame: int) -> None:
    for agent in agents:
        for kind in FILE_ENDINGS:
            place.remove(place.file(agent, kind, frame))


def _remove_file(place: Place, rng: np.random.Generator, *kinds: str) -> None:
    agent, kind = place.any_agent(rng), kinds[0] if len(kinds) == 1 else str(rng.choice(kinds))
    place.remove(place.file(agent, kind, place.any_frame(rng)))


def _file_for_folder(place: Place, rng: np.random.Generator) -> None:
    folder = place.folder(place.any_agent(rng), "label")
    place.remove_folder(folder)
    place.write(folder, b"")


def _repeat_last(place: Place, agents: Sequence[str], *kinds: str, later: int = 1) -> None:
    """Copy the agents' last files of the kinds to a later frame."""
    last = place.frames[-1]
    for agent in agents:
        for kind in kinds:
            place.write(
                place.file(agent, kind, last + later), place.file(agent, kind, last).read_bytes()
            )


def _under_another_name(
    place: Place, rng: np.random.Generator, old: str, new: str, *, copied: bool
) -> None:
    agent, kind, frame = (
        place.any_agent(rng),
        str(rng.choice(list(FILE_ENDINGS))),
        place.any_frame(rng),
    )
    path = place.file(agent, kind, frame)
    place.write(
        path.with_name(path.name.replace(old.format(frame), new.format(frame))), path.read_bytes()
    )
    if not copied:
        place.remove(path)


def _stray(place: Place, rng: np.random.Generator) -> None:
    folder = place.folder(place.any_agent(rng), "label")
    for name in (".DS_Store", "Thumbs.db", "README"):
        place.write(folder / name, b"stray")


GROUP.add(
    {
        "last_frame_removed": (
            "The last frame of all agents is missing.",
            lambda place, _: _remove_frame(place, place.agents, place.frames[-1]),
        ),
        "first_frame_removed": (
            "The first frame of all agents is missing.",
            lambda place, _: _remove_frame(place, place.agents, place.frames[0]),
        ),
        "middle_frame_removed": (
            "A frame in the middle of the scenario is missing in all agents.",
            lambda place, rng: _remove_frame(place, place.agents, place.middle_frame(rng)),
        ),
        "middle_frame_of_agent_removed": (
            "A frame in the middle of the scenario is missing in one agent.",
            lambda place, rng: _remove_frame(
                place, [place.any_agent(rng)], place.middle_frame(rng)
            ),
        ),
        "last_frame_of_agent_removed": (
            "The last frame of one agent is missing.",
            lambda place, rng: _remove_frame(place, [place.any_agent(rng)], place.frames[-1]),
        ),
        "label_removed": (
            "A label file is missing.",
            lambda place, rng: _remove_file(place, rng, "label"),
        ),
        "calib_removed": (
            "A calib file is missing.",
            lambda place, rng: _remove_file(place, rng, "calib"),
        ),
        "sensor_file_removed": (
            "A file of one sensor is missing.",
            lambda place, rng: _remove_file(place, rng, *CHANNELS),
        ),
        "labels_of_agent_removed": (
            "One agent has no labels, but the others have.",
            lambda place, rng: place.remove_folder(place.folder(place.any_agent(rng), "label")),
        ),
        "calibs_of_agent_removed": (
            "One agent has labels and sensors, but no calib files.",
            lambda place, rng: place.remove_folder(place.folder(place.any_agent(rng), "calib")),
        ),
        "file_for_folder": (
            "A file is where an agent's folder of labels must be.",
            _file_for_folder,
        ),
        "extra_frame": (
            "An agent has a copy of its last frame as one more frame.",
            lambda place, rng: _repeat_last(place, [place.any_agent(rng)], *FILE_ENDINGS),
        ),
        "extra_frame_of_all": (
            "All agents have a copy of their last frame as one more frame.",
            lambda place, _: _repeat_last(place, place.agents, *FILE_ENDINGS),
        ),
        "extra_label": (
            "An agent has a label file of a frame that no agent recorded.",
            lambda place, rng: _repeat_last(place, [place.any_agent(rng)], "label", later=3),
        ),
        "extra_image": (
            "An agent has an image of a frame that no agent recorded.",
            lambda place, rng: _repeat_last(place, [place.any_agent(rng)], "Camera_Front"),
        ),
        "file_renamed": (
            "A file's frame number has two digits.",
            lambda place, rng: _under_another_name(
                place, rng, "_{:03d}.", "_{:02d}.", copied=False
            ),
        ),
        "file_of_another_scenario": (
            "A folder has a file with another scenario's name.",
            lambda place, rng: _under_another_name(
                place, rng, "scenario0", "scenario9", copied=True
            ),
        ),
    },
)
GROUP.add(
    {"stray_files": ("Folders have .DS_Store, Thumbs.db and a note.", _stray)},
    harmless="operating systems make such files; no reader opens them",
)
