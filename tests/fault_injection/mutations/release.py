"""Splits, folders, and what a partial release lacks."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.taxonomy import BEV_CAMERA, CHANNELS
from fault_injection.kinds import Group
from fault_injection.place import ENDINGS, Place

GROUP = Group("release")


def _line(place: Place) -> bytes:
    return place.token.replace("/", " ").encode() + b"\n"


def _append(place: Place, name: str, line: bytes) -> str:
    path = place.root / name
    place.write(path, path.read_bytes() + line)
    return f"{name}: {line.decode().strip()}"


def _drop(place: Place, name: str, line: bytes | None = None) -> None:
    path = place.root / name
    place.write(path, path.read_bytes().replace(line or _line(place), b""))


def _twin(line: bytes) -> bytes:
    words = (b"_accident ", b"_normal ")
    return line.replace(*(words if words[0] in line else words[::-1]))


@GROUP.kind()
def scenario_in_two_splits(place: Place, rng: np.random.Generator) -> str:
    """A second split file lists the scenario."""
    return _append(place, str(rng.choice(["val.txt", "test.txt"])), _line(place))


@GROUP.kind()
def twins_in_two_splits(place: Place, rng: np.random.Generator) -> str:
    """The scenario is listed in another split than its twin."""
    for name in ("train.txt", "train_mini.txt"):
        _drop(place, name)
    return _append(place, str(rng.choice(["val.txt", "test.txt"])), _line(place))


@GROUP.kind()
def split_line_twice(place: Place, rng: np.random.Generator) -> str:
    """A split file lists the scenario twice."""
    return _append(place, str(rng.choice(["train.txt", "train_mini.txt"])), _line(place))


@GROUP.kind()
def scenario_in_no_split(place: Place, rng: np.random.Generator) -> str:
    """No split file lists the scenario."""
    for name in ("train.txt", "train_mini.txt"):
        _drop(place, name)
    return "train.txt lacks it"


@GROUP.kind()
def scenario_in_two_folders(place: Place, rng: np.random.Generator) -> str:
    """The scenario is in a split folder too (layout B)."""
    for path in _files(place):
        place.write(place.root / "val" / path.relative_to(place.root), path.read_bytes())
    return "copied to val/"


def _files(place: Place) -> list[Path]:
    files = [place.scenario.meta_path]
    for agent in place.agents:
        files += [place.file(agent, kind, frame) for kind in ("label", "calib") for frame in place.frames]
    return files


@GROUP.kind()
def type_folder_unpacked_beside(place: Place, rng: np.random.Generator) -> str:
    """An agent's files are in a folder beside the scenario type's, as a second download is unpacked."""
    name = place.scenario.scenario_type + str(rng.choice(["-001", " (1)", " 2", "-20240101T000000Z-001"]))
    agent = place.any_agent(rng)
    for path in _files(place):
        if agent in path.parts:
            below = path.relative_to(place.root / place.scenario.scenario_type)
            place.write(place.root / name / below, path.read_bytes())
            place.remove(path)
    return f"{name}: {agent}"


@GROUP.kind()
def split_line_of_one_word(place: Place, rng: np.random.Generator) -> str:
    """A split file has a line with a single word."""
    return _append(place, str(rng.choice(["train.txt", "val.txt"])), place.scenario.name.encode() + b"\n")


@GROUP.kind()
def split_file_garbage(place: Place, rng: np.random.Generator) -> str:
    """A split file is no text."""
    place.write(place.root / "val.txt", bytes(range(256)))
    return "val.txt"


@GROUP.kind(harmless="a partial download lacks scenarios that the split files list")
def split_lists_absent_scenario(place: Place, rng: np.random.Generator) -> str:
    """A split file lists a scenario that is not there."""
    return _append(place, "train.txt", b"type1_subtype2_normal Town07_type001_subtype0002_scenario00099\n")


@GROUP.kind()
def agents_exchanged(place: Place, rng: np.random.Generator) -> str:
    """All folders of two vehicles are exchanged."""
    one, other = (str(agent) for agent in rng.choice(place.agents[:4], size=2, replace=False))
    for kind in ENDINGS:
        for frame in place.frames:
            place.exchange(place.file(one, kind, frame), place.file(other, kind, frame))
    return f"{one} and {other}"


@GROUP.kind(harmless="a partial download: a scenario without one of the agents is valid (docs/format.md, Tree)")
def agent_removed(place: Place, rng: np.random.Generator) -> str:
    """All files of an agent are absent."""
    agent = place.any_agent(rng)
    for kind in ENDINGS:
        place.remove_folder(place.folder(agent, kind))
    return agent


@GROUP.kind(harmless="a partial download: users unpack some sensors only (docs/format.md, Tree)")
def sensor_removed(place: Place, rng: np.random.Generator) -> str:
    """All files of one sensor are absent in all agents."""
    channel = str(rng.choice(CHANNELS))
    for agent in place.agents:
        place.remove_folder(place.folder(agent, channel))
    return channel


@GROUP.kind(harmless="a partial download: users unpack some sensors only (docs/format.md, Tree)")
def all_sensors_removed(place: Place, rng: np.random.Generator) -> str:
    """All sensors of all agents are absent; only labels and calib are there."""
    for agent in place.agents:
        for channel in CHANNELS:
            place.remove_folder(place.folder(agent, channel))
    return "labels and calib stay"


@GROUP.kind(harmless="the real test split has no labels, no BEV arrays and sometimes no meta (docs/format.md, Tree)")
def test_labels_removed(place: Place, rng: np.random.Generator) -> str:
    """The scenario is of the test split, as its twin is, and has no labels, no BEV arrays and no meta."""
    line = _line(place)
    for name in ("train.txt", "train_mini.txt"):
        _drop(place, name)
        _drop(place, name, _twin(line))
    _append(place, "test.txt", line + _twin(line))
    for agent in place.agents:
        for kind in ("label", BEV_CAMERA):
            place.remove_folder(place.folder(agent, kind))
    place.remove(place.scenario.meta_path)
    return "moved to test.txt"


@GROUP.kind(harmless="split files can be in their own folder (docs/format.md, Tree)")
def split_files_moved(place: Place, rng: np.random.Generator) -> str:
    """The split files are under split_txt_files/."""
    for path in sorted(place.root.glob("*.txt")):
        place.write(place.root / "split_txt_files" / path.name, path.read_bytes())
        place.remove(path)
    return "split_txt_files/"
