"""Labels that track nobody: every id is −1, which is normal for far actors only (docs/format.md, Label)."""

from collections.abc import Iterator

import numpy as np

from deepaccident_devkit.arrays import BoolArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID
from deepaccident_devkit.validation.agreement import SAME_PLACE
from deepaccident_devkit.validation.subject import Subject, frames_text, near_pairs

NEAR = 15.0
"""Metres within which a vehicle that the agent saw is not too far away to be tracked."""
_LEAST_BOXES = 2
"""The number of boxes that must show it: the tracking of a single one comes and goes."""
_VEHICLES = tuple(CATEGORIES.index(name) for name in ("car", "truck", "van"))


def check_untracked(subject: Subject) -> Iterator[Finding]:
    """Say which labels, or all labels of which agents, lost their ids."""
    agents, frames = len(subject.agents), subject.num_frames
    untracked = subject.label_id == UNTRACKED_ID
    tracked = np.bincount(subject.boxes.sample[subject.seen], minlength=agents * frames).reshape(agents, frames)
    rows = np.flatnonzero(untracked & (tracked == 0)[subject.boxes.agent, subject.boxes.frame - 1])
    rows = rows[_trackable(subject, rows)]
    shown = np.bincount(subject.boxes.sample[rows], minlength=agents * frames).reshape(agents, frames)
    for agent in range(agents):
        lost = np.flatnonzero(shown[agent] >= _LEAST_BOXES) + 1
        if not tracked[agent].any() and shown[agent].sum() >= _LEAST_BOXES:
            what = f"every id of its labels is {UNTRACKED_ID}, also of {shown[agent].sum()} boxes that can be tracked"
            yield subject.finding("ids-untracked", subject.label_where(agent), what)
        elif len(lost):
            what = f"every id is {UNTRACKED_ID}, also of actors that can be tracked, {frames_text(lost)}"
            yield subject.finding("ids-untracked", subject.label_where(agent), what)


def _trackable(subject: Subject, rows: IntArray) -> BoolArray:
    """Which untracked boxes (M,) of what their agent saw are near vehicles, or tracked by an agent no nearer."""
    labels, boxes = subject.boxes.labels, subject.boxes
    distance = np.linalg.norm(labels.center[:, :2], axis=1)
    found: BoolArray = np.isin(labels.category[rows], _VEHICLES) & (distance[rows] < NEAR)
    others = np.flatnonzero(subject.seen)
    if len(rows) and len(others):
        both = np.concatenate([rows, others])
        pairs, _ = near_pairs(subject.centers[both], boxes.frame[both], SAME_PLACE)
        pairs = np.sort(pairs, axis=1)
        pairs = pairs[(pairs[:, 0] < len(rows)) & (pairs[:, 1] >= len(rows))]
        no_nearer = distance[both[pairs[:, 1]]] >= distance[both[pairs[:, 0]]]
        found[pairs[no_nearer, 0]] = True
    return found & ((labels.num_lidar_pts[rows] > 0) | labels.camera_visible[rows])
