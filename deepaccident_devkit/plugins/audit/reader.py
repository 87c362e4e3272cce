"""Audit of other people's readers, by a small release in which each column has numbers that occur nowhere else."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from deepaccident_devkit.plugins.audit.output import values_in, values_in_folder
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.release import read_image, read_labels
from deepaccident_devkit.release.npz import write_npz
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.support.files import check_free, replacing_folder
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import path_of, possible_text
from deepaccident_devkit.taxonomy import BEV_CAMERA, BEV_SHAPE, CAMERAS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.testing import SmallRelease, write_small_release

# Number of values that are looked at, as a generator may have no end; of a large array, thousands count as one.
MOST_VALUES: Final = 300_000


class _Column(NamedTuple):
    """A column of the files.

    Attributes:
        first: its number in the first row of the release that readers are audited with.
        step: what is added from row to row; 0 for a column that keeps what it has.
        meaning: what it is.
        right: a pattern of names that are right for it.
        axis: the axis that it lies along; names of another one are wrong.
    """

    first: float
    step: float
    meaning: str
    right: str
    axis: str = ""


_CENTER: Final = "pos|_loc|cent|trans|coord|^(?!.*(vel|speed|acc|size|dim)).*_[cdpt]?[xyz]_"
_VELOCITY: Final = "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_"
_RAW: Final = "raw|label|undecoded|stored"
_SIZE: Final = "size|dim|_d[xyz]_"
# Place in the files → the column.
_COLUMNS: Final[Mapping[str, _Column]] = {
    "line 1 of the labels, number 1": _Column(
        14.05, 0.003, "own velocity along the world's x", _VELOCITY, "x"
    ),
    "line 1 of the labels, number 2": _Column(
        -15.05, -0.003, "own velocity along the world's y", _VELOCITY, "y"
    ),
    "column 2 of the labels": _Column(
        20.03, 0.03, "x of the box's centre in the LiDAR frame", _CENTER, "x"
    ),
    "column 3 of the labels": _Column(
        -31.03, -0.03, "y of the box's centre, to the right", _CENTER, "y"
    ),
    "column 4 of the labels": _Column(-1.61, -0.001, "z of the box's centre", _CENTER, "z"),
    "column 5 of the labels": _Column(
        4.513, 0.002, "the box's length; next are width and height", f"length|_l_|{_SIZE}", "x"
    ),
    "column 6 of the labels": _Column(
        2.013, 0.001, "the box's width; before it is the length", f"width|_w_|{_SIZE}", "y"
    ),
    "column 7 of the labels": _Column(
        1.113, 0.001, "the box's height, after length and width", f"height|_h_|{_SIZE}", "z"
    ),
    "column 8 of the labels": _Column(
        2.513, 0.0015, "the box's yaw in the LiDAR frame, clockwise", "yaw_$|head|rot|angle"
    ),
    "column 9 of the labels": _Column(
        41.03, 0.03, "vx, of no frame until it is decoded", _RAW, "x"
    ),
    "column 10 of the labels": _Column(
        -51.03, -0.03, "vy, of no frame until it is decoded", _RAW, "y"
    ),
    "column 11 of the labels": _Column(0, 0, "the actor's id", "_ids?_|actor|track"),
    "column 12 of the labels": _Column(
        2103, 7, "the LiDAR points in the box", "point|pts|lidar|_num_|_count_"
    ),
    "column 13 of the labels": _Column(
        0, 0, "whether a camera of the agent sees the box", "visib|seen|occl"
    ),
    "line 1 of meta, word 9": _Column(
        12, 0, "the simulated frames, ten more than recorded", "frame|length|_num_|count|total"
    ),
}
# Names that say what something is: of what no column has, and those that are right of some column.
_BELIEFS: Final = "|".join(
    [
        "ttc|tta_|eta_|countdown|time_to|remaining|_left_|until|rate_|angular|accel|speed|vel|_v_|_v_?[xyz]_"
    ]
    + ["colli|crash|accident|_hit_"]
    + [column.right for column in _COLUMNS.values()]
)
# In a name, the axis that it is about.
_AXIS: Final = re.compile("_(?:v|d|c|p|t|pos|loc|vel|coord|cent(?:er|re))?([xyz])(?=_)")
# Files, keys and paths with such a name may be pictures.
_PICTURE: Final = re.compile(r"image|img|rgb|picture|photo|\.(jpe?g|png)$", re.IGNORECASE)
_DECODING: Final = (
    "docs/format.md says what each column holds; of vx and vy, v_world = Rz(−yaw) · (vx, vy)."
)
_AXES: Final = (
    "In the files x is forward, y to the right and z up. If yours are others on purpose, as in nuScenes' LiDAR frame, "
    "this is as it should be."
)
_FLAGS: Final = {"true": 1.0, "false": 0.0}
# Most rows of a label, and labels, of the release that readers are audited with.
_ROWS, _LABELS = 10, 20
# Numbers of a key that are compared with the columns.
_MOST_NUMBERS: Final = 10_000


def write_audit_release(out: Path) -> Path:
    """Write the release that readers are audited with: an accident and its twin of two frames, with all sensors.

    Raises:
        ConfigError: `out` is a file or is not empty.
    """
    check_free(out)
    first, step = np.array([column[:2] for column in _COLUMNS.values()]).T
    with replacing_folder(out) as made:
        write_small_release(
            made, SmallRelease(frames=2, splits=("train",), channels=(*CAMERAS, LIDAR))
        )
        for label, path in enumerate(sorted(made.glob("*/*/label/*/*.txt"))):
            numbers = (
                first + step * np.arange(_ROWS * label, _ROWS * (label + 1))[:, None]
            ).tolist()
            lines = [numbers[0][:2]]
            for place, line in enumerate(path.read_text().splitlines()[1:]):
                category, *_, actor, _, _ = line.split()
                values = numbers[place][2:]
                if actor == str(OWN_ACTOR_ID):
                    values[6:9] = 0, *numbers[0][:2]  # as in the release
                # seven of ten are seen, in a vehicle's the own one first
                lines.append([category, *values[:9], actor, int(values[10]), 0 < place < 8])
            path.write_text("".join(f"{' '.join(map(str, line))}\n" for line in lines))
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
        reader: a function that is given a dataroot and returns mappings, lists, tables, arrays, tensors, objects or an
            iterator, nested as it likes, of which the first `MOST_VALUES` values are looked at; or the folder with the
            JSON, and pictures, that it wrote of the release that `write_audit_release` writes.

    Raises:
        ConfigError: a file of the folder is no JSON. What the function raises is raised as it is.
    """
    with TemporaryDirectory() as temporary:
        release = write_audit_release(Path(temporary) / "release")
        columns = _numbers_of(release)
        values = (
            values_in(reader(str(release)), {}, [""])
            if callable(reader)
            else values_in_folder(path_of(reader))
        )
        numbers, pictures, unread = _collected(values)
    rows = dict[str, Row]()
    findings = list[AuditFinding]()
    judged, others = 0, set[str]()
    for key, values_of_key in numbers.items():
        name, whole = _name(key), _whole(key)
        place, hits = _column(np.array(values_of_key[:_MOST_NUMBERS]), columns)
        says_something = re.search(_BELIEFS, name) is not None
        if hits and whole not in rows:  # else the whole list is of one column
            wrong = _misread(key, name, place) if says_something else []
            rows[key] = (key, place, f"{hits} of {len(values_of_key)}", "misread" if wrong else "")
            findings += wrong
            judged += says_something
        elif says_something and np.isfinite(values_of_key).any():
            others.add(whole)
    if wrong_pictures := [name for name, is_bev in pictures.items() if is_bev]:
        findings.append(
            AuditFinding(
                kind="picture",
                what="the BEV camera's array became an RGB picture: its channels are ids and classes.",
                remedy="Keep the array: JPEG changes ids and classes. Channel 2 is the class, 1 + 256 · 0 the object.",
                number=len(wrong_pictures),
                examples=tuple(wrong_pictures[:3]),
            )
        )
    others.difference_update(map(_whole, rows))
    cannot_say = {
        "no key holds numbers as they are in the release's files.": not rows,
        "the keys' names do not say what they hold; compare the table with what you read.": rows
        and not judged,
        f"the numbers of {possible_text('', others)} are of no column; they may be computed or scaled.": others,
        f"not looked into: {possible_text('', sorted(unread))}.": unread,
    }
    return AuditReport(
        # where numbers were not recognised, right pictures do not speak for them
        compared={
            "keys by their names": judged,
            "pictures": len(pictures) if rows or not others | unread else 0,
        },
        cannot_say=tuple(reason for reason, is_so in cannot_say.items() if is_so),
        findings=tuple(findings),
        tables={"keys": [("key", "holds", "values", ""), *rows.values()]},
    )


def _collected(
    values: Iterable[tuple[list[str], Any]],
) -> tuple[dict[str, list[float]], dict[str, bool], set[str]]:
    """Return the first `MOST_VALUES` values of an output.

    Returns:
        Key, such as `annotations/*/size/*` → the numbers there, NaN for others, with keys of their own for components
        (`size/*[0]`) and rows (`size/*[0]/*`); name of a picture → whether it is a BEV camera's array; types and files
        that were not looked into.
    """
    numbers: dict[str, list[float]] = defaultdict(list)
    pictures: dict[str, bool] = {}
    unread = set()
    left = MOST_VALUES
    for keys, value in values:
        left -= 1 + (value.size // 1000 if isinstance(value, np.ndarray) else 0)
        if left < 0:
            unread.add(f"values after the first {MOST_VALUES:,}")
            break
        number = _number(value)
        for key in keys:
            numbers[key.lstrip("/")].append(number)
        if keys and math.isnan(number):
            name = value if isinstance(value, str) else keys[0].lstrip("/")
            if (
                _PICTURE.search(name)
                and not pictures.get(name)
                and (is_bev := _is_bev(value)) is not None
            ):
                pictures[name] = is_bev
            elif keys == [""] or not isinstance(value, str | float | None):
                unread.add(name if isinstance(value, Path) else type(value).__qualname__)
    return numbers, pictures, unread


def _number(value: Any) -> float:
    """Return the number that a value says, 1 or 0 for true or false; NaN for others."""
    with suppress(TypeError, ValueError, OverflowError):
        return float(_FLAGS.get(value.lower(), value) if isinstance(value, str) else value)
    return math.nan


def _whole(key: str) -> str:
    """Return the key of the list that a component or a row is of."""
    return re.sub(r"\[\d+\]", "", key)


def _misread(key: str, name: str, place: str) -> list[AuditFinding]:
    """Return the finding of a key with another name than that of what it holds; none if the name is right."""
    column, axes = _COLUMNS[place], _AXIS.findall(name)
    is_right = re.search(column.right, name) is not None
    if is_right and (not axes or column.axis in ("", axes[-1])):
        return []
    what = f"{key} holds {place}: {column.meaning}; you read it as `{name.strip('_')}`."
    return [
        AuditFinding(kind="misread", what=what, remedy=_AXES if is_right else _DECODING, number=1)
    ]


def _numbers_of(release: Path) -> dict[str, FloatArray]:
    """Return the numbers that each place in the files has, or could have in more rows, without their signs."""
    rows = np.arange(_ROWS * _LABELS)
    numbers = {
        place: np.unique(np.abs(first + step * rows))
        for place, (first, step, *_) in _COLUMNS.items()
    }
    labels = read_labels(sorted(release.glob("*/*/label/*/*.txt")))
    return {**numbers, "column 11 of the labels": np.unique(np.abs(labels.actor_id)).astype(float)}


def _column(values: FloatArray, columns: Mapping[str, FloatArray]) -> tuple[str, int]:
    """Return the column that some values are, and how many of them are in it; 0 if they are none."""
    if np.isin(values, (0, 1)).all():
        seen, number = int(values.sum()), len(values)
        # seven of the ten rows of a label, or of nine without the own one
        return "column 13 of the labels", number * (
            seen % 7 == 0 and 9 * seen <= 7 * number <= 10 * seen
        )
    numbers = np.abs(values[np.isfinite(values) & (values != 0)])  # zeros tell nothing
    near = {
        place: numbers[np.abs(numbers[:, None] - of).min(axis=1) < 0.0051]
        for place, of in columns.items()
    }
    best = max(near, key=lambda place: len(near[place]))
    is_constant = len(np.unique(near[best])) < min(2, len(columns[best]))
    return best, len(near[best]) * (len(near[best]) >= 0.8 * len(numbers) and not is_constant)


def _name(key: str) -> str:
    """Return the name of a key as words between underscores, and the axis: `_velocity_x_`, `_w_` of `size_whl`."""
    path, *place = re.sub(r"/\*|\]", "", f"/{key}").split("[")
    own = re.findall("[^/]*(?:/[xyz])?$", path)[0]
    words = "_".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", own)).lower()
    axes = re.findall("(?<![a-z])[xyzwhl]{2,3}$", words)
    if not axes and re.search("vel|speed|pos|loc|cent|trans|coord", words):
        axes = ["xyz"]
    axis = axes[0][int(place[0]) :][:1] if axes and place else ""
    if axis in ("w", "h", "l") or [words] == axes:  # which says it all
        return f"_{axis or words}_"
    return f"_{words}_{axis}_".replace("__", "_")


def _is_bev(picture: Any) -> bool | None:
    """Whether an array, or a picture at a path, has the channels of a BEV array; None where there is no picture."""
    import cv2

    with suppress(TypeError, ValueError, cv2.error):
        pixels = (
            read_image(Path(picture))
            if isinstance(picture, str | Path)
            else np.asarray(picture, dtype=np.uint8)
        )
        if pixels.ndim == 3 and pixels.shape[2] == 3:
            small = cv2.resize(pixels, (12, 12), interpolation=cv2.INTER_AREA).astype(float)
            true = _bev()[50::100, 50::100]
            return bool(min(np.abs(small - each).mean() for each in (true, true[..., ::-1])) < 12)
    return None
