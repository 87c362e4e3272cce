"""Audit of other people's readers, by a small release in which each column has numbers that occur nowhere else."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from deepaccident_devkit.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.errors import ConfigError, shortened
from deepaccident_devkit.release import read_image, read_label, read_labels, write_label
from deepaccident_devkit.release.npz import write_npz
from deepaccident_devkit.reports import Row
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.support.files import check_free, replacing_folder
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import number_of, path_of
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_SHAPE, CAMERAS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.testing import SmallRelease, write_small_release

_COMPONENT, _CENTER = "(vel.*|speed)_[xy]_|_v_?[xy]_", "pos|_loc|cent|trans|coord|_[xyz]_"
_COLUMNS: Final[Mapping[str, tuple[float, float, str, str]]] = {
    "line 1 of the labels, number 1": (
        14.05,
        0.003,
        "own velocity along the world's x",
        "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_",
    ),
    "line 1 of the labels, number 2": (
        -15.05,
        -0.003,
        "own velocity along the world's y",
        "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_",
    ),
    "column 2 of the labels": (20.03, 0.03, "x of the box's centre in the LiDAR frame", _CENTER),
    "column 3 of the labels": (-31.03, -0.03, "y of the box's centre, to the right", _CENTER),
    "column 4 of the labels": (-1.61, -0.001, "z of the box's centre", _CENTER),
    "column 5 of the labels": (4.513, 0.002, "the box's length; next are width and height", "length|_l_|size|dim"),
    "column 6 of the labels": (2.013, 0.001, "the box's width; before it is the length", "width|_w_|size|dim"),
    "column 7 of the labels": (1.113, 0.001, "the box's height, after length and width", "height|_h_|size|dim"),
    "column 8 of the labels": (2.513, 0.0015, "the box's yaw in the LiDAR frame, clockwise", "yaw_$|head|rot|angle"),
    "column 9 of the labels": (41.03, 0.03, "vx, of no frame until it is decoded", "raw|label|undecoded|stored"),
    "column 10 of the labels": (-51.03, -0.03, "vy, of no frame until it is decoded", "raw|label|undecoded|stored"),
    "column 11 of the labels": (0, 0, "the actor's id", "_ids?_|actor|track"),
    "column 12 of the labels": (2103, 7, "the LiDAR points in the box", "point|pts|lidar|_num_|_count_"),
    "column 13 of the labels": (0, 0, "whether a camera of the agent sees the box", "visib|seen|occl"),
    "line 1 of meta, word 9": (12, 0, "the simulated frames, ten more than recorded", "frame|length|_num_|count|total"),
}
"""Place → the number in the first row, the step to the next, what it is, and a pattern of names that are right."""
_BELIEFS: Final = "|".join(
    ["ttc|tta_|countdown|time_to|remaining|rate_|speed|vel|_v_?[xyz]_|colli|crash|accident|_hit_"]
    + [right for _, _, _, right in _COLUMNS.values()]
)
"""Names that say what something is: of what no column has, and those that are right of some column."""
_PICTURE: Final = r"(?i)image|img|rgb|picture|photo|\.(jpe?g|png)$"
"""Files, keys and paths that are called so may be pictures."""
_REMEDIES: Final = {
    "misread": "docs/format.md says what each column holds; of vx and vy, v_world = Rz(−yaw) · (vx, vy).",
    "picture": "Keep the array: JPEG changes ids and classes. Channel 2 is the class, 1 + 256 · 0 the object.",
}


def write_audit_release(out: Path) -> Path:
    """Write the release that readers are audited with: an accident and its twin of two frames, with all sensors.

    Raises:
        ConfigError: `out` is a file or is not empty.
    """
    check_free(out)
    start, step = np.array([each[:2] for each in _COLUMNS.values()]).T
    with replacing_folder(out) as made:
        write_small_release(made, SmallRelease(frames=2, splits=("train",), channels=(*CAMERAS, LIDAR)))
        for number, path in enumerate(sorted(made.glob("*/*/label/*/*.txt"))):
            labels = read_label(path, raw=True)
            place, own = np.arange(len(labels)), labels.actor_id[:, None] == OWN_ACTOR_ID
            line, rows = (start + step * (each + 10 * number)[:, None] for each in (place[:1], place))
            write_label(
                path,
                replace(
                    labels,
                    agent_velocity=line[:, :2],
                    center=rows[:, 2:5],
                    size=rows[:, 5:8],
                    yaw=np.where(own, 0, rows[:, 8:9])[:, 0],
                    velocity=np.where(own, line[:, :2], rows[:, 9:11]),  # as in the release
                    num_lidar_pts=rows[:, 12].astype(int),
                    camera_visible=(place > 0) & (place < 8),  # seven of ten, in a vehicle's the own one first
                ),
            )
            write_npz(path.parents[2] / BEV_CAMERA / path.parent.name / f"{path.stem}.npz", _bev())
    return out


@cache
def _bev() -> ByteArray:
    """(1200, 1200, 3) what the BEV camera sees: each of 12 × 12 patches is another object."""
    row, column = np.indices(BEV_SHAPE) // 100
    return np.stack([row * 20, column * 20, (row * 5 + column) % 11], axis=-1).astype(np.uint8)


def audit_reader(reader: Callable[[str], object] | str | os.PathLike[str]) -> AuditReport:
    """Say which column each key of a reader's output holds, and where the key's name says something else.

    A key holds a column if four fifths of its numbers are the column's, but for their sign and rounding to two
    decimals; a flag is whether a camera sees the box if it is true as often. Words are not looked at.

    Args:
        reader: a function that is given a dataroot and returns nested mappings, lists, arrays, numbers and texts; or
            the folder with the JSON, and pictures, that it wrote of the release that `write_audit_release` writes.

    Raises:
        ConfigError: a file of the folder is no JSON. What the function raises is raised as it is.
    """
    with TemporaryDirectory() as temporary:
        release = write_audit_release(Path(temporary) / "release")
        folder = release if callable(reader) else path_of(reader)
        held: dict[str, list[Any]] = defaultdict(list)
        for path, leaf in _leaves(reader(str(release)) if callable(reader) else _written(folder)):
            key = "/".join("*" if isinstance(each, int) else each for each in path).lstrip("/")
            held[key].append(leaf)
            held[f"{key}[{path[-1]}]"].append(leaf)  # a place of a list, such as [x, y, z]
        named: dict[str, Any] = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*"))} | {
            each if isinstance(each, str) else key: each
            for key in held
            for each in held[key]
            if "[" not in key and isinstance(each, str | np.ndarray)
        }
        pictures = [name for name, each in named.items() if re.search(_PICTURE, name) and _is_bev(each)]
        labels = read_labels(sorted(release.glob("*/*/label/*/*.txt")), raw=True)
    boxes = [labels.center, labels.size, labels.yaw, labels.velocity, labels.actor_id, labels.num_lidar_pts]
    others = np.column_stack(boxes)[labels.actor_id != OWN_ACTOR_ID].T  # the own velocity is that of line 1
    numbers = [*labels.agent_velocity.T, *others, np.full(1, math.inf), np.full(1, 12.0)]
    columns = {place: np.abs(each) for place, each in zip(_COLUMNS, numbers, strict=True)}
    rows: dict[str, Row] = {}
    found = [("picture", "the BEV camera's array became an RGB picture: its channels are ids and classes", pictures)]
    for key, values in held.items():
        place, hits = _column(values, columns)
        if hits and key.rpartition("[")[0] not in rows:
            name, meaning, right = _name(key), *_COLUMNS[place][2:]
            wrong = re.search(_BELIEFS, name) and not re.search(right, name)
            rows[key] = (key, place, f"{hits} of {len(values)}", "misread" if wrong else "")
            what = f"{key} holds {place}: {meaning}; you read it as `{name.strip('_')}`"
            found += [("misread", what, [])] if wrong else []
    return AuditReport(
        findings=tuple(
            AuditFinding(
                kind=kind, what=f"{what}.", remedy=_REMEDIES[kind], number=len(each) or 1, examples=tuple(each[:3])
            )
            for kind, what, each in found
            if each or kind == "misread"
        ),
        tables={"keys": [("key", "holds", "values", ""), *rows.values()]},
        notes=() if rows or pictures else ("No key holds numbers of the release.",),
    )


def _written(folder: Path) -> dict[str, Any]:
    """All the JSON of a folder by name."""
    try:
        paths = sorted(folder.rglob("*.json"))
        return {path.stem: parsed_json(read_bytes(path, "results"), constants=True) for path in paths}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder}: a JSON file {shortened(fault_text(error))}; write it again") from error


def _leaves(value: Any, path: tuple[str | int, ...] = ("",)) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Each number, text and large array, and the way to it: names, and places of lists (0 for names with numbers)."""
    value = value.tolist() if isinstance(value, np.ndarray) and value.size < 20_000 else value
    if isinstance(value, list | tuple | Mapping):
        for name, each in value.items() if isinstance(value, Mapping) else enumerate(value):
            place = name if isinstance(name, int) else 0 if re.search(r"\d{2}|^\d", str(name)) else str(name)
            yield from _leaves(each, (*path, place))
    else:
        yield path, value


def _column(values: Sequence[Any], columns: Mapping[str, FloatArray]) -> tuple[str, int]:
    """The column that some values are, and how many of them are in it; 0 if they are none."""
    words = [str(each).lower() for each in values]
    if {*words} <= {"true", "false", "0", "1", "0.0", "1.0"}:
        seen = sum(each.startswith(("t", "1")) for each in words)
        # seven of the ten rows of a label, or of nine without the own one
        return "column 13 of the labels", len(words) * (seen % 7 == 0 and 9 * seen <= 7 * len(words) <= 10 * seen)
    numbers = np.abs(
        [number for each in words if (number := number_of(each)) and math.isfinite(number)]
    )  # zeros tell nothing
    near = {place: numbers[np.abs(numbers[:, None] - of).min(axis=1) < 0.0051] for place, of in columns.items()}
    best = max(near, key=lambda place: len(near[place]))
    known = len(near[best]) >= 0.8 * len(numbers) and len({*near[best]}) >= min(2, len(columns[best]))  # no constant
    return best, len(near[best]) * known


def _name(key: str) -> str:
    """The name of a key as words between underscores, of places with their axis: `_velocity_x_`, `_w_` of `whl`."""
    last = [each for each in ["", *key.split("/")] if each[:1] != "*"][-1].partition("[")[0]
    words = "_".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", last)).lower()
    axes = words if re.fullmatch("[xyzwhl]{2,3}", words) else "xyz" if re.search("vel|speed", words) else ""
    axis = "".join(axes[int(place) : int(place) + 1] for place in re.findall(r"\[(\d+)\]$", key))
    return f"_{'' if words == axes and axis else words}_{axis}_".replace("___", "_").replace("__", "_")


def _is_bev(picture: Any) -> bool:
    """Whether an array, or a picture at a path, has the channels of a BEV array."""
    import cv2

    with suppress(ValueError, cv2.error):
        pixels = read_image(Path(picture)) if isinstance(picture, str | Path) else np.asarray(picture, dtype=np.uint8)
        small = cv2.resize(pixels, (12, 12), interpolation=cv2.INTER_AREA).astype(float)
        true = _bev()[50::100, 50::100]
        return small.shape == true.shape and bool(
            min(np.abs(small - each).mean() for each in (true, true[..., ::-1])) < 12
        )
    return False
