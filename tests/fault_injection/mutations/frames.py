"""Files that are missing, or there though they should not be."""

import numpy as np

from deepaccident_devkit.taxonomy import CHANNELS
from fault_injection.kinds import Group
from fault_injection.place import ENDINGS, Place

GROUP = Group("frames")


def _remove_frame(place: Place, agents: tuple[str, ...], frame: int) -> str:
    for agent in agents:
        for kind in ENDINGS:
            place.remove(place.file(agent, kind, frame))
    return f"{', '.join(agents)} {frame}"


def _remove_file(place: Place, agent: str, kind: str, frame: int) -> str:
    place.remove(place.file(agent, kind, frame))
    return f"{agent} {kind} {frame}"


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
            lambda place, rng: _remove_frame(place, (place.any_agent(rng),), place.middle_frame(rng)),
        ),
        "last_frame_of_agent_removed": (
            "The last frame of one agent is missing.",
            lambda place, rng: _remove_frame(place, (place.any_agent(rng),), place.frames[-1]),
        ),
        "label_removed": (
            "A label file is missing.",
            lambda place, rng: _remove_file(place, place.any_agent(rng), "label", place.any_frame(rng)),
        ),
        "calib_removed": (
            "A calib file is missing.",
            lambda place, rng: _remove_file(place, place.any_agent(rng), "calib", place.any_frame(rng)),
        ),
        "sensor_file_removed": (
            "A file of one sensor is missing.",
            lambda place, rng: _remove_file(
                place, place.any_agent(rng), str(rng.choice(CHANNELS)), place.any_frame(rng)
            ),
        ),
    },
)


@GROUP.kind()
def labels_of_agent_removed(place: Place, rng: np.random.Generator) -> str:
    """One agent has no labels, but the others have."""
    agent = place.any_agent(rng)
    place.remove_folder(place.folder(agent, "label"))
    return agent


@GROUP.kind()
def calibs_of_agent_removed(place: Place, rng: np.random.Generator) -> str:
    """One agent has labels and sensors, but no calib files."""
    agent = place.any_agent(rng)
    place.remove_folder(place.folder(agent, "calib"))
    return agent


@GROUP.kind()
def file_for_folder(place: Place, rng: np.random.Generator) -> str:
    """A file is where an agent's folder of labels must be."""
    folder = place.folder(place.any_agent(rng), "label")
    place.remove_folder(folder)
    place.write(folder, b"")
    return folder.relative_to(place.root).as_posix()


@GROUP.kind()
def extra_frame(place: Place, rng: np.random.Generator) -> str:
    """An agent has a copy of its last frame as one more frame."""
    agent, last = place.any_agent(rng), place.frames[-1]
    for kind in ENDINGS:
        place.write(place.file(agent, kind, last + 1), place.file(agent, kind, last).read_bytes())
    return f"{agent} {last + 1}"


@GROUP.kind()
def extra_frame_of_all(place: Place, rng: np.random.Generator) -> str:
    """All agents have a copy of their last frame as one more frame."""
    last = place.frames[-1]
    for agent in place.agents:
        for kind in ENDINGS:
            place.write(place.file(agent, kind, last + 1), place.file(agent, kind, last).read_bytes())
    return f"all agents {last + 1}"


@GROUP.kind()
def extra_label(place: Place, rng: np.random.Generator) -> str:
    """An agent has a label file of a frame that no agent recorded."""
    agent, last = place.any_agent(rng), place.frames[-1]
    place.write(place.file(agent, "label", last + 3), place.file(agent, "label", last).read_bytes())
    return f"{agent} {last + 3}"


@GROUP.kind()
def extra_image(place: Place, rng: np.random.Generator) -> str:
    """An agent has an image of a frame that no agent recorded."""
    agent, last = place.any_agent(rng), place.frames[-1]
    path = place.file(agent, "Camera_Front", last)
    place.write(place.file(agent, "Camera_Front", last + 1), path.read_bytes())
    return f"{agent} {last + 1}"


@GROUP.kind()
def file_renamed(place: Place, rng: np.random.Generator) -> str:
    """A file's frame number has two digits."""
    agent, kind, frame = place.any_agent(rng), str(rng.choice(list(ENDINGS))), place.any_frame(rng)
    path = place.file(agent, kind, frame)
    place.rename(path, path.name.replace(f"_{frame:03d}.", f"_{frame:02d}."))
    return f"{agent} {kind} {frame}"


@GROUP.kind()
def file_of_another_scenario(place: Place, rng: np.random.Generator) -> str:
    """A folder has a file with another scenario's name."""
    agent, kind, frame = place.any_agent(rng), str(rng.choice(list(ENDINGS))), place.any_frame(rng)
    path = place.file(agent, kind, frame)
    place.write(path.with_name(path.name.replace("scenario0", "scenario9")), path.read_bytes())
    return f"{agent} {kind} {frame}"


@GROUP.kind(harmless="operating systems make such files; no reader opens them")
def stray_files(place: Place, rng: np.random.Generator) -> str:
    """Folders have .DS_Store, Thumbs.db and a note."""
    folder = place.folder(place.any_agent(rng), "label")
    for name in (".DS_Store", "Thumbs.db", "README"):
        place.write(folder / name, b"stray")
    return folder.name
