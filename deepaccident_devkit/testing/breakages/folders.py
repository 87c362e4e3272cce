"""Missing, odd and exchanged files and folders, and split files."""

from pathlib import Path

from deepaccident_devkit.errors import BrokenReleaseError, SplitFileError
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import SPLITS
from deepaccident_devkit.testing.breakages.kinds import Group, Victim
from deepaccident_devkit.testing.editing import ENDINGS

BROKEN = Group("release", opening=BrokenReleaseError)
ODD = Group("release")
SPLIT_FILES = Group("release", opening=SplitFileError, reading=SplitFileError)


@BROKEN.enter("frames-missing")
def label_missing(victim: Victim) -> Path:
    """A label file of one frame is missing."""
    victim.editor.remove(victim.file("label"))
    return victim.file("label")


@BROKEN.enter("frames-missing")
def calib_missing(victim: Victim) -> Path:
    """A calib file of one frame is missing."""
    victim.editor.remove(victim.file("calib"))
    return victim.file("calib")


@BROKEN.enter("frames-missing", "sensor-frames-missing")
def frame_lost(victim: Victim) -> Path:
    """An agent lacks all files of a frame."""
    for kind in ENDINGS:
        if victim.file(kind).exists():
            victim.editor.remove(victim.file(kind))
    return victim.file("calib")


@BROKEN.enter("frames-missing", "odd-name")
def frame_number_short(victim: Victim) -> Path:
    """A label file's name has two digits for the frame."""
    path = victim.file("label")
    victim.editor.rename(path, path.name.replace(f"_{victim.frame:03d}.", f"_{victim.frame:02d}."))
    return path


@BROKEN.enter("agent-unlabelled", "folder-unreadable")
def folder_is_a_file(victim: Victim) -> Path:
    """A file is where an agent's folder of labels must be."""
    folder = victim.editor.folder(victim.agent, "label")
    victim.editor.remove_folder(folder)
    victim.editor.write(folder, b"")
    return folder


@BROKEN.enter("two-places")
def scenario_twice(victim: Victim) -> Path:
    """A scenario is also in the folder of a second split."""
    scenario = victim.editor.scenario
    root = real_path(scenario.root)
    start = root / scenario.folder
    copy = root / ("val" if scenario.folder != "val" else "train")
    for path in sorted((start / scenario.scenario_type).rglob(f"{scenario.name}*")):
        if path.is_file():
            victim.editor.write(copy / path.relative_to(start), path.read_bytes())
    return copy / scenario.scenario_type


@ODD.enter("labels-without-calib")
def agent_half_unpacked(victim: Victim) -> Path:
    """An agent has labels and sensor files, but no calib files."""
    folder = victim.editor.folder(victim.agent, "calib")
    victim.editor.remove_folder(folder)
    return folder


@ODD.enter("agent-unlabelled")
def agent_unlabelled(victim: Victim) -> Path:
    """An agent has no labels, but the others have."""
    folder = victim.editor.folder(victim.agent, "label")
    victim.editor.remove_folder(folder)
    return folder


@ODD.enter("ids-differ", "meta-pair", "own-box-apart", "sizes-differ")
def agents_swapped(victim: Victim) -> Path:
    """All folders of two vehicles are swapped."""
    for kind in ENDINGS:
        for frame in victim.editor.frames:
            files = [victim.editor.file(agent, kind, frame) for agent in (victim.agent, victim.other)]
            if all(path.exists() for path in files):
                victim.editor.exchange(*files)
    return victim.editor.folder(victim.agent, "calib").parents[1]


@ODD.enter("positions-differ", "velocity-off")
def frames_swapped(victim: Victim) -> Path:
    """Two frames' label files of an agent are swapped."""
    frames = victim.editor.frames
    victim.editor.exchange(*(victim.editor.file(victim.agent, "label", frame) for frame in (frames[0], frames[-1])))
    return victim.editor.folder(victim.agent, "label")


@SPLIT_FILES.enter("split-file-unreadable")
def split_file_garbled(victim: Victim) -> Path:
    """A split file has a line of one word."""
    path = victim.editor.root / "val.txt"
    victim.editor.write(path, path.read_bytes() + b"Town03\n")
    return path


@ODD.enter("split-file-repeats")
def split_line_twice(victim: Victim) -> Path:
    """A split file lists a scenario twice."""
    files = (victim.editor.root / f"{split}.txt" for split in SPLITS)
    path = max(files, key=lambda path: path.stat().st_size)  # files of splits that were not made are empty
    victim.editor.write(path, path.read_bytes() * 2)
    return path
