"""Unusual files without a fault: the format allows them, real releases have them, and a loader must read them."""

from pathlib import Path

import numpy as np

from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CHANNELS, INFRASTRUCTURE, LIDAR, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.testing.breakages.kinds import Group, Victim
from deepaccident_devkit.testing.editing import ENDINGS, FIELD

GROUP = Group("legal")


@GROUP.enter()
def label_windows_lines(victim: Victim) -> Path:
    """A label file has Windows line ends, with blanks before them."""
    return victim.replace("label", lambda content: content.replace(b"\n", b" \r\n"))


@GROUP.enter("label-line-skipped")
def label_short_lines(victim: Victim) -> Path:
    """A label file has blank lines and lines of one word, which the reference reader skips."""
    return victim.replace("label", lambda content: content.replace(b"\n", b"\n\ncar\n", 3))


@GROUP.enter()
def label_header_only(victim: Victim) -> Path:
    """The infrastructure's label has no boxes."""
    rows = victim.editor.rows(INFRASTRUCTURE, victim.frame)
    victim.editor.write_rows(INFRASTRUCTURE, victim.frame, rows[:1])
    return victim.editor.file(INFRASTRUCTURE, "label", victim.frame)


@GROUP.enter("velocity-unknown")
def label_velocity_nan(victim: Victim) -> Path:
    """A tracked actor's velocity is NaN."""
    rows = victim.editor.rows(victim.agent, victim.frame)
    tracked = [row for row in rows[1:] if int(row[FIELD["id"]]) not in (OWN_ACTOR_ID, UNTRACKED_ID)]
    tracked[0][FIELD["vx"]] = tracked[0][FIELD["vy"]] = "nan"
    victim.editor.write_rows(victim.agent, victim.frame, rows)
    return victim.file("label")


@GROUP.enter("meta-incomplete")
def meta_short(victim: Victim) -> Path:
    """A meta file ends after its third line."""
    victim.editor.write_meta_lines(victim.editor.meta_lines()[:3])
    return real_path(victim.editor.scenario.meta_path)


@GROUP.enter("no-collision-in-accident")
def meta_no_collision(victim: Victim) -> Path:
    """The meta file in an accident's folder names no collision."""
    first, _, *rest = victim.editor.meta_lines()
    words = first.split()
    victim.editor.write_meta_lines([" ".join([words[0], *["-1"] * 7, words[8]]), " colliding agents: none none", *rest])
    return real_path(victim.editor.scenario.meta_path)


@GROUP.enter("agent-missing")
def infrastructure_absent(victim: Victim) -> Path:
    """A scenario has no infrastructure agent, like those of one mirror of the release."""
    for kind in ENDINGS:
        victim.editor.remove_folder(victim.editor.folder(INFRASTRUCTURE, kind))
    return victim.editor.folder(INFRASTRUCTURE, "calib")


@GROUP.enter("unlabelled")
def labels_absent(victim: Victim) -> Path:
    """A scenario has no labels, BEV arrays and meta, like those of the test split."""
    for agent in AGENTS:
        for kind in ("label", BEV_CAMERA):
            victim.editor.remove_folder(victim.editor.folder(agent, kind))
    victim.editor.remove(real_path(victim.editor.scenario.meta_path))
    return victim.editor.folder(victim.agent, "label")


@GROUP.enter()
def sensors_absent(victim: Victim) -> Path:
    """A scenario has no sensor files: their archives were not unpacked."""
    for agent in AGENTS:
        for channel in CHANNELS:
            victim.editor.remove_folder(victim.editor.folder(agent, channel))
    return victim.editor.folder(victim.agent, CHANNELS[0])


@GROUP.enter("split-file-partial")
def split_lists_more(victim: Victim) -> Path:
    """A split file lists a scenario that was not downloaded."""
    path = victim.editor.root / "train.txt"
    more = b"type1_subtype2_normal Town07_type001_subtype0002_scenario00099\n"
    victim.editor.write(path, path.read_bytes() + more)
    return path


@GROUP.enter()
def files_stray(victim: Victim) -> Path:
    """A folder of labels has files that operating systems make."""
    folder = victim.editor.folder(victim.agent, "label")
    for name in (".DS_Store", "Thumbs.db", "README"):
        victim.editor.write(folder / name, b"stray")
    return folder


@GROUP.enter(channel=LIDAR)
def lidar_other_key(victim: Victim) -> Path:
    """The only array of a point cloud has another name than `data`."""
    points = victim.editor.array(victim.agent, LIDAR, victim.frame)
    victim.editor.write_array(victim.agent, LIDAR, victim.frame, points, key="arr_0")
    return victim.file(LIDAR)


@GROUP.enter(channel=LIDAR)
def lidar_single(victim: Victim) -> Path:
    """A point cloud has single precision."""
    points = victim.editor.array(victim.agent, LIDAR, victim.frame)
    victim.editor.write_array(victim.agent, LIDAR, victim.frame, points.astype(np.float32))
    return victim.file(LIDAR)
