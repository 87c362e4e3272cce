"""A label file in words (docs/format.md, label)."""

from collections import Counter
from pathlib import Path

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import LabelError
from deepaccident_devkit.geometry import handedness
from deepaccident_devkit.release.labels import Labels, read_label_to_fault
from deepaccident_devkit.release.velocities import world_from_label_velocity
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, STATIC_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.text import columns_text, fixed_text

_KMH = 3.6
_LEGEND = [
    ("row", "counted from 0, as in the devkit's annotation tokens"),
    ("class", f"one of {', '.join(CATEGORIES)}"),
    ("x y z", "m, centre of the box in the recording agent's LiDAR frame"),
    ("l w h", "m, full length, width and height"),
    ("yaw", "rad, heading of the box about z in the LiDAR frame"),
    ("vx vy", "m/s, velocity over the ground in the world frame, turned once more by the row's yaw;"),
    ("", "the second table has turned it back: (vx, vy) = Rz(yaw) · v_world"),
    ("speed", "km/h, length of the velocity"),
    ("id", f"CARLA actor id; {OWN_ACTOR_ID} the recording agent itself, {UNTRACKED_ID} not trackable (too far away),"),
    ("", f"from {STATIC_ACTOR_ID} on static (parked)"),
    ("points", "num_lidar_pts: points of the recording agent's LiDAR in the box"),
    ("seen", "camera_visible: whether any of its six cameras sees it"),
]
_AFTERWORD = (
    "The velocity is decoded by the real release's rule; `deepaccident validate` tells if a release has another.\n"
    "In Python: release.read_label(path), with raw=True for the first table's values."
)


def label_text(path: Path, rows: int | None) -> tuple[str, LabelError | None]:
    """What a label file says, at most so many boxes, and the fault that ends it, if there is one.

    Raises as `read_label` does, if nothing of it can be read.
    """
    labels, fault = read_label_to_fault(path, raw=True)
    shown = slice(0, rows)
    until = "" if fault is None else ", before the line that cannot be read"
    more = max(len(labels) - len(range(len(labels))[shown]), 0)
    parts = [
        f"A label: the boxes that one agent annotated at one frame. {_counts(labels)}{until}.",
        _agent_text(labels.agent_velocity[0]),
    ]
    if len(labels):
        ellipsis = f"\n… {more} more" if more else ""
        parts += [
            "As the file says (CARLA, left-handed: x forward, y right, z up; yaw clockwise from above)\n"
            + columns_text(_file_rows(labels, shown), left=2)
            + ellipsis,
            "What the devkit makes of it (right-handed: y left, yaw counter-clockwise; x, z and sizes stay)\n"
            + columns_text(_devkit_rows(labels, shown), left=2)
            + ellipsis,
            columns_text(_LEGEND, left=2) + "\n" + _AFTERWORD,
        ]
    return "\n\n".join(parts), fault


def _counts(labels: Labels) -> str:
    counts = Counter(CATEGORIES[code] for code in labels.category.tolist())
    names = ", ".join(f"{count} {name}" for name, count in counts.items())
    return f"{len(labels)} boxes" + (f": {names}" if names else "")


def _agent_text(velocity: FloatArray) -> str:
    x, y = velocity.tolist()
    speed = float(np.hypot(x, y))
    return (
        "Line 1: velocity of the recording agent over the ground, world frame\n"
        f"  file    speed_x {fixed_text(x, 3)}, speed_y {fixed_text(y, 3)} m/s (left-handed)\n"
        f"  devkit  vx {fixed_text(x, 3)}, vy {fixed_text(-y, 3)} m/s (right-handed); "
        f"speed {fixed_text(speed, 2)} m/s = {fixed_text(speed * _KMH, 1)} km/h"
    )


def _file_rows(labels: Labels, shown: slice) -> list[list[str]]:
    metres = np.column_stack([labels.center, labels.size])[shown]
    rows = [
        ["row", "class", "x", "y", "z", "l", "w", "h", "yaw", "vx", "vy", "id", "points", "seen"],
        ["", "", *["m"] * 6, "rad", "m/s", "m/s", "", "", ""],
    ]
    rows += [
        [
            str(row),
            CATEGORIES[labels.category[row]],
            *(fixed_text(value, 2) for value in values),
            fixed_text(labels.yaw[row], 3),
            *(fixed_text(value, 2) for value in labels.velocity[row]),
            str(labels.actor_id[row]),
            str(labels.num_lidar_pts[row]),
            "yes" if labels.camera_visible[row] else "no",
        ]
        for row, values in enumerate(metres)
    ]
    return rows


def _devkit_rows(labels: Labels, shown: slice) -> list[list[str]]:
    world = handedness.flip_vectors2(world_from_label_velocity(labels.velocity, labels.yaw))[shown]
    y, yaw = handedness.flip_points(labels.center)[:, 1], handedness.flip_yaw(labels.yaw)
    rows = [
        ["row", "class", "y", "yaw", "yaw", "vx", "vy", "speed", "who"],
        ["", "", "m", "rad", "deg", "m/s world", "m/s world", "km/h", ""],
    ]
    rows += [
        [
            str(row),
            CATEGORIES[labels.category[row]],
            fixed_text(y[row], 2),
            fixed_text(yaw[row], 3),
            fixed_text(np.degrees(yaw[row]), 1),
            *(fixed_text(value, 2) for value in velocity),
            fixed_text(np.hypot(*velocity) * _KMH, 1),
            _who(int(labels.actor_id[row])),
        ]
        for row, velocity in enumerate(world)
    ]
    return rows


def _who(actor_id: int) -> str:
    if actor_id == OWN_ACTOR_ID:
        return "the agent itself"
    if actor_id == UNTRACKED_ID:
        return "not trackable"
    return f"static {actor_id}" if actor_id >= STATIC_ACTOR_ID else f"actor {actor_id}"
