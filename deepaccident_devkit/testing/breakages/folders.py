"""Breakages of folders and split files, and unusual releases that loaders must read."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.errors import BrokenReleaseError, SplitFileError
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CHANNELS,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    SPLITS,
    UNTRACKED_ID,
)
from deepaccident_devkit.testing.breakages.breakage import (
    FIELD,
    FILE_ENDINGS,
    BreakageGroup,
    Victim,
)

BROKEN = BreakageGroup("release", opening=BrokenReleaseError)
ODD = BreakageGroup("release")
SPLIT_FILE = BreakageGroup("release", opening=SplitFileError, reading=SplitFileError)


@BROKEN.enter("frames-missing")
def label_missing(victim: Victim) -> Path:
    """A label file of one frame is missing."""
    return victim.editor.remove(victim.file("label"))


@BROKEN.enter("frames-missing")
def calib_missing(victim: Victim) -> Path:
    """A calib file of one frame is missing."""
    return victim.editor.remove(victim.file("calib"))


@BROKEN.enter("frames-missing", "sensor-frames-missing")
def frame_lost(victim: Victim) -> Path:
    """An agent lacks all files of a frame."""
    for kind in FILE_ENDINGS:
        if victim.file(kind).exists():
            victim.editor.remove(victim.file(kind))
    return victim.file("calib")


@BROKEN.enter("frames-missing", "odd-name")
def frame_number_short(victim: Victim) -> Path:
    """A label file's name has two digits for the frame."""
    path = victim.file("label")
    short_name = path.name.replace(f"_{victim.frame:03d}.", f"_{victim.frame:02d}.")
    victim.editor.rename(path, short_name)
    return path


@BROKEN.enter("agent-unlabelled", "folder-unreadable")
def folder_is_a_file(victim: Victim) -> Path:
    """A file is where an agent's folder of labels must be."""
    folder = victim.folder("label")
    victim.editor.remove_folder(folder)
    return victim.editor.write(folder, b"")


@BROKEN.enter("two-places")
def scenario_twice(victim: Victim) -> Path:
    """A scenario is also in the folder of a second split."""
    scenario = victim.editor.scenario
    root = real_path(scenario.root)
    split_folder = root / scenario.folder
    other_split_folder = root / "val"
    if scenario.folder == "val":
        other_split_folder = root / "train"
    type_folder = split_folder / scenario.scenario_type
    for path in sorted(type_folder.rglob(f"{scenario.name}*")):
        if path.is_file():
            copy = other_split_folder / path.relative_to(split_folder)
            victim.editor.write(copy, path.read_bytes())
    return other_split_folder / scenario.scenario_type


@ODD.enter("labels-without-calib")
def agent_half_unpacked(victim: Victim) -> Path:
    """An agent has labels and sensor files, but no calib files."""
    folder = victim.folder("calib")
    return victim.editor.remove_folder(folder)


@ODD.enter("agent-unlabelled")
def agent_unlabelled(victim: Victim) -> Path:
    """An agent has no labels, but the others have."""
    folder = victim.folder("label")
    return victim.editor.remove_folder(folder)


@ODD.enter("ids-differ", "meta-pair", "own-box-apart", "sizes-differ")
def agents_swapped(victim: Victim) -> Path:
    """All folders of two vehicles are swapped."""
    for kind in FILE_ENDINGS:
        for frame in victim.editor.frames:
            path = victim.editor.file(victim.agent, kind, frame)
            other_path = victim.editor.file(victim.other, kind, frame)
            if path.exists() and other_path.exists():
                victim.editor.exchange(path, other_path)
    return victim.folder("calib").parents[1]


@ODD.enter("positions-differ", "velocity-off")
def frames_swapped(victim: Victim) -> Path:
    """Two frames' label files of an agent are swapped."""
    frames = victim.editor.frames
    first_path = victim.editor.file(victim.agent, "label", frames[0])
    last_path = victim.editor.file(victim.agent, "label", frames[-1])
    victim.editor.exchange(first_path, last_path)
    return victim.folder("label")


@SPLIT_FILE.enter("split-file-unreadable")
def split_file_garbled(victim: Victim) -> Path:
    """A split file has a line of one word."""
    path = victim.editor.root / "val.txt"
    return victim.editor.append(path, b"Town03\n")


@ODD.enter("split-file-repeats")
def split_line_twice(victim: Victim) -> Path:
    """A split file lists a scenario twice."""
    paths = [victim.editor.root / f"{split}.txt" for split in SPLITS]
    # Split files that the release lacks are treated as empty.
    path = max(paths, key=lambda path: path.stat().st_size)
    return victim.editor.write(path, path.read_bytes() * 2)


LEGAL = BreakageGroup("legal")


@LEGAL.enter()
def label_windows_lines(victim: Victim) -> Path:
    """A label file has Windows line ends, with blanks before them."""
    return victim.replace("label", lambda content: content.replace(b"\n", b" \r\n"))


@LEGAL.enter("label-line-skipped")
def label_short_lines(victim: Victim) -> Path:
    """A label file has blank lines and lines of one word, which the reference reader skips."""
    return victim.replace("label", lambda content: content.replace(b"\n", b"\n\ncar\n", 3))


@LEGAL.enter()
def label_header_only(victim: Victim) -> Path:
    """The infrastructure's label has no boxes."""
    rows = victim.editor.rows(INFRASTRUCTURE, victim.frame)
    header = rows[:1]
    return victim.editor.write_rows(INFRASTRUCTURE, victim.frame, header)


@LEGAL.enter("velocity-unknown")
def label_velocity_nan(victim: Victim) -> Path:
    """A tracked actor's velocity is NaN."""
    rows = victim.read_rows()
    untracked_ids = (str(OWN_ACTOR_ID), str(UNTRACKED_ID))
    tracked_rows = [row for row in rows[1:] if row[FIELD["id"]] not in untracked_ids]
    for name in ("vx", "vy"):
        tracked_rows[0][FIELD[name]] = "nan"
    return victim.write_rows(rows)


@LEGAL.enter("meta-incomplete")
def meta_short(victim: Victim) -> Path:
    """A meta file ends after its third line."""
    lines = victim.editor.meta_lines()
    return victim.editor.write_meta_lines(lines[:3])


@LEGAL.enter("no-collision-in-accident", "overlap-unnamed")
def meta_no_collision(victim: Victim) -> Path:
    """The meta file in an accident's folder names no collision."""
    first_line, _, *other_lines = victim.editor.meta_lines()
    words = first_line.split()
    no_collision = " ".join([words[0], *["-1"] * 7, words[8]])
    no_agents = " colliding agents: none none"
    return victim.editor.write_meta_lines([no_collision, no_agents, *other_lines])


@LEGAL.enter("agent-missing")
def infrastructure_absent(victim: Victim) -> Path:
    """A scenario has no infrastructure agent, like those of one mirror of the release."""
    for kind in FILE_ENDINGS:
        victim.editor.remove_folder(victim.editor.folder(INFRASTRUCTURE, kind))
    return victim.editor.folder(INFRASTRUCTURE, "calib")


@LEGAL.enter("unlabelled")
def labels_absent(victim: Victim) -> Path:
    """A scenario has no labels, BEV arrays and meta, like those of the test split."""
    for agent in AGENTS:
        for kind in ("label", BEV_CAMERA):
            victim.editor.remove_folder(victim.editor.folder(agent, kind))
    victim.editor.remove(real_path(victim.editor.scenario.meta_path))
    return victim.folder("label")


@LEGAL.enter()
def sensors_absent(victim: Victim) -> Path:
    """A scenario has no sensor files: their archives were not unpacked."""
    for agent in AGENTS:
        for channel in CHANNELS:
            victim.editor.remove_folder(victim.editor.folder(agent, channel))
    return victim.folder(CHANNELS[0])


@LEGAL.enter("split-file-partial")
def split_lists_more(victim: Victim) -> Path:
    """A split file lists a scenario that was not downloaded."""
    path = victim.editor.root / "train.txt"
    line = b"type1_subtype2_normal Town07_type001_subtype0002_scenario00099\n"
    return victim.editor.append(path, line)


@LEGAL.enter()
def files_stray(victim: Victim) -> Path:
    """A folder of labels has files that operating systems make."""
    folder = victim.folder("label")
    for name in (".DS_Store", "Thumbs.db", "README"):
        victim.editor.write(folder / name, b"stray")
    return folder


@LEGAL.enter(channel=LIDAR)
def lidar_other_key(victim: Victim) -> Path:
    """The only array of a point cloud has another name than `data`."""
    return victim.replace_array(LIDAR, lambda points: points, key="arr_0")


@LEGAL.enter(channel=LIDAR)
def lidar_single(victim: Victim) -> Path:
    """A point cloud has single precision."""
    return victim.replace_array(LIDAR, lambda points: points.astype(np.float32))
