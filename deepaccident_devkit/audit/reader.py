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
from typing import Any, Final, NamedTuple

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


class _Column(NamedTuple):
    """A column of the files.

    Attributes:
        first: its number in the first row of the release that readers are audited with.
        step: what is added from row to row; 0 for a column that keeps what it has.
        meaning: what it is.
        right: a pattern of names that are right for it.
    """

    first: float
    step: float
    meaning: str
    right: str


_CENTER: Final = "pos|_loc|cent|trans|coord|_[xyz]_"
_VELOCITY: Final = "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_"
_RAW: Final = "raw|label|undecoded|stored"
_COLUMNS: Final[Mapping[str, _Column]] = {
    "line 1 of the labels, number 1": _Column(14.05, 0.003, "own velocity along the world's x", _VELOCITY),
    "line 1 of the labels, number 2": _Column(-15.05, -0.003, "own velocity along the world's y", _VELOCITY),
    "column 2 of the labels": _Column(20.03, 0.03, "x of the box's centre in the LiDAR frame", _CENTER),
    "column 3 of the labels": _Column(-31.03, -0.03, "y of the box's centre, to the right", _CENTER),
    "column 4 of the labels": _Column(-1.61, -0.001, "z of the box's centre", _CENTER),
    "column 5 of the labels": _Column(
        4.513, 0.002, "the box's length; next are width and height", "length|_l_|size|dim"
    ),
    "column 6 of the labels": _Column(2.013, 0.001, "the box's width; before it is the length", "width|_w_|size|dim"),
    "column 7 of the labels": _Column(1.113, 0.001, "the box's height, after length and width", "height|_h_|size|dim"),
    "column 8 of the labels": _Column(
        2.513, 0.0015, "the box's yaw in the LiDAR frame, clockwise", "yaw_$|head|rot|angle"
    ),
    "column 9 of the labels": _Column(41.03, 0.03, "vx, of no frame until it is decoded", _RAW),
    "column 10 of the labels": _Column(-51.03, -0.03, "vy, of no frame until it is decoded", _RAW),
    "column 11 of the labels": _Column(0, 0, "the actor's id", "_ids?_|actor|track"),
    "column 12 of the labels": _Column(2103, 7, "the LiDAR points in the box", "point|pts|lidar|_num_|_count_"),
    "column 13 of the labels": _Column(0, 0, "whether a camera of the agent sees the box", "visib|seen|occl"),
    "line 1 of meta, word 9": _Column(
        12, 0, "the simulated frames, ten more than recorded", "frame|length|_num_|count|total"
    ),
}
"""Place in the files → the column."""
_BELIEFS: Final = "|".join(
    ["ttc|tta_|eta_|countdown|time_to|remaining|_left_|until|rate_|angular|accel|speed|vel|_v_|_v_?[xyz]_"]
    + ["colli|crash|accident|_hit_"]
    + [column.right for column in _COLUMNS.values()]
)
"""Names that say what something is: of what no column has, and those that are right of some column."""
_PICTURE: Final = r"(?i)image|img|rgb|picture|photo|\.(jpe?g|png)$"
"""Files, keys and paths that are called so may be pictures."""


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
        held = _by_key(reader(str(release)) if callable(reader) else _written(folder))
        pictures = [name for name, each in _named(folder, held) if re.search(_PICTURE, name) and _is_bev(each)]
        columns = _numbers_of(release)
    rows: dict[str, Row] = {}
    findings = []
    if pictures:
        findings.append(
            AuditFinding(
                kind="picture",
                what="the BEV camera's array became an RGB picture: its channels are ids and classes.",
                remedy="Keep the array: JPEG changes ids and classes. Channel 2 is the class, 1 + 256 · 0 the object.",
                number=len(pictures),
                examples=tuple(pictures[:3]),
            )
        )
    for key, values in held.items():
        place, hits = _column(values, columns)
        if not hits or key.rpartition("[")[0] in rows:  # the whole list is of one column
            continue
        name, column = _name(key), _COLUMNS[place]
        is_wrong = re.search(_BELIEFS, name) is not None and not re.search(column.right, name)
        rows[key] = (key, place, f"{hits} of {len(values)}", "misread" * is_wrong)
        if is_wrong:
            findings.append(
                AuditFinding(
                    kind="misread",
                    what=f"{key} holds {place}: {column.meaning}; you read it as `{name.strip('_')}`.",
                    remedy="docs/format.md says what each column holds; of vx and vy, v_world = Rz(−yaw) · (vx, vy).",
                    number=1,
                )
            )
    return AuditReport(
        findings=tuple(findings),
        tables={"keys": [("key", "holds", "values", ""), *rows.values()]},
        notes=() if rows or pictures else ("No key holds numbers of the release.",),
    )


def _by_key(read: object) -> dict[str, list[Any]]:
    """The leaves of what was read by their key, `annotations/*/size`; places of a list also by `…/size[0]`."""
    held: dict[str, list[Any]] = defaultdict(list)
    for path, leaf in _leaves(read):
        key = "/".join("*" if isinstance(each, int) else each for each in path).lstrip("/")
        held[key].append(leaf)
        held[f"{key}[{path[-1]}]"].append(leaf)
    return held


def _named(folder: Path, held: Mapping[str, Sequence[Any]]) -> Iterator[tuple[str, Any]]:
    """Name and what may be a picture: files of a folder, texts that may be paths, and arrays by their key."""
    yield from ((str(path.relative_to(folder)), path) for path in sorted(folder.rglob("*")))
    for key, leaves in held.items():
        if "[" not in key:
            yield from {each: each for each in leaves if isinstance(each, str)}.items()
            yield from ((key, each) for each in leaves if isinstance(each, np.ndarray))


def _numbers_of(release: Path) -> dict[str, FloatArray]:
    """Place in the files → the numbers there, without their signs."""
    labels = read_labels(sorted(release.glob("*/*/label/*/*.txt")), raw=True)
    boxes = [labels.center, labels.size, labels.yaw, labels.velocity, labels.actor_id, labels.num_lidar_pts]
    others = np.column_stack(boxes)[labels.actor_id != OWN_ACTOR_ID].T  # the own velocity is that of line 1
    flags, frames = np.full(1, math.inf), np.full(1, _COLUMNS["line 1 of meta, word 9"].first)
    numbers = [*labels.agent_velocity.T, *others, flags, frames]
    return {place: np.abs(each) for place, each in zip(_COLUMNS, numbers, strict=True)}


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
    """The name of a key as words between underscores, and the axis of a place: `_velocity_x_`, `_w_` of `size_whl`."""
    names = [each.partition("[")[0] for each in ["", *key.split("/")] if each[:1] != "*"]
    told = "_".join(names[-2:]) if re.fullmatch("[xyz]", names[-1]) else names[-1]
    words = "_".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", told)).lower()
    axes = words.rpartition("_")[2]
    if not re.fullmatch("[xyzwhl]{2,3}", axes):
        axes = "xyz" if re.search("vel|speed", words) else ""
    axis = "".join(axes[int(place) : int(place) + 1] for place in re.findall(r"\[(\d+)\]$", key))
    if axis in ("w", "h", "l") or words == axes:  # which says it all
        return f"_{axis or words}_"
    return f"_{words}_{axis}_".replace("__", "_")


def _is_bev(picture: Any) -> bool:
    """Whether an array, or a picture at a path, has the channels of a BEV array."""
    import cv2

    with suppress(ValueError, cv2.error):
        pixels = read_image(Path(picture)) if isinstance(picture, str | Path) else np.asarray(picture, dtype=np.uint8)
        if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
            return False
        small = cv2.resize(pixels, (12, 12), interpolation=cv2.INTER_AREA).astype(float)
        true = _bev()[50::100, 50::100]
        return small.shape == true.shape and bool(
            min(np.abs(small - each).mean() for each in (true, true[..., ::-1])) < 12
        )
    return False
