"""Why perfect maps given as heads do not score 100: how grouping and linking change the labels' instances.

The released evaluation reads instances off heads: cells go to the nearest peak of centerness, and instances of
consecutive frames are linked by where the flow takes them. Labels that go through this do not all come back as they
were: peaks of neighbours merge, those that a warp takes out of the grid are gone, and fast or newly seen actors lose
their ids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray, checked

Reason = Literal["missing", "merged", "cut", "renamed"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LostInstance:
    """An instance that does not come back as itself in a frame.

    Attributes:
        frame: from 0.
        identity: its id in the labels.
        reason: `missing`: most of its cells have no id; `merged`: they have another instance's id, of which it is the
            smaller part; `cut`: they have its own id, but IoU ≤ 0.5; `renamed`: IoU > 0.5, but under another id than
            when it was last found.
        other: the id in the labels with which it was merged, or None.
    """

    frame: int
    identity: int
    reason: Reason
    other: int | None = None


def lost_instances(label: AnyArray, found: AnyArray) -> list[LostInstance]:
    """What VPQ and the accident metrics miss of labels that went through grouping and linking, and why.

    Every instance that has no partner of IoU > 0.5, or has it under a new id, is in the list with one reason: exactly
    VPQ's false negatives.

    Args:
        label: (T, H, W) ids from 1 that stay the same over the frames, 0 elsewhere; lying as `found`.
        found: (T, H, W) ids of the same cells as they were read off heads.

    Returns:
        By frame and id.

    Raises:
        GeometryError: the two have other shapes.
    """
    label = checked("label", label, (None, None, None), np.int64)
    found = checked("found", found, label.shape, np.int64)
    result: list[LostInstance] = []
    names: dict[int, int] = {}
    for frame, (here, read) in enumerate(zip(label, found, strict=True)):
        overlap, ids, read_ids = _overlap(here, read)
        for row, identity in enumerate(ids.tolist()):
            if identity == 0:
                continue
            column = int(np.argmax(overlap[row]))
            name = int(read_ids[column])
            lost = _reason(overlap, row, column, name, names.get(identity, name))
            if lost:
                other = int(ids[np.argmax(overlap[:, column])]) if lost == "merged" else None
                result.append(LostInstance(frame=frame, identity=identity, reason=lost, other=other))
            if lost in (None, "renamed"):
                names[identity] = name
    return result


def _reason(overlap: IntArray, row: int, column: int, name: int, before: int) -> Reason | None:
    if name == 0:
        return "missing"
    shared = overlap[row, column]
    if overlap[:, column].max() > shared:
        return "merged"
    if 2 * shared <= overlap[row].sum() + overlap[:, column].sum() - shared:
        return "cut"
    return "renamed" if name != before else None


def _overlap(label: IntArray, found: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """(I, J) cells in common of I labels' ids (I,) and J found ones (J,), 0 among both if it is there."""
    ids, row = np.unique(label.reshape(-1), return_inverse=True)
    read_ids, column = np.unique(found.reshape(-1), return_inverse=True)
    size = len(ids) * len(read_ids)
    overlap = np.bincount(row * len(read_ids) + column, minlength=size).reshape(len(ids), len(read_ids))
    return overlap, ids, read_ids
