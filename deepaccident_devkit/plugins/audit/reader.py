"""Audit of other people's readers, by a small release with distinct numbers in each column."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
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

# Number of values that are examined, because a generator may be endless; thousands of values of a
# large array count as one.
MAX_VALUES: Final = 300_000
_CENTER_NAMES: Final = "pos|_loc|cent|trans|coord|^(?!.*(vel|speed|acc|size|dim)).*_[cdpt]?[xyz]_"
_VELOCITY_NAMES: Final = "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_"
_RAW_NAMES: Final = "raw|label|undecoded|stored"
_SIZE_NAMES: Final = "size|dim|_d[xyz]_"
# The axis in a name.
_AXIS: Final = re.compile("_(?:v|d|c|p|t|pos|loc|vel|coord|cent(?:er|re))?([xyz])(?=_)")
# Files, keys and paths with such a name may be pictures.
_PICTURE: Final = re.compile(r"image|img|rgb|picture|photo|\.(jpe?g|png)$", re.IGNORECASE)
_COLUMN_REMEDY: Final = (
    "docs/format.md says what each column holds; of vx and vy, v_world = Rz(−yaw) · (vx, vy)."
)
_AXES_REMEDY: Final = (
    "In the files x is forward, y to the right and z up. If yours are others on purpose, as in "
    "nuScenes' LiDAR frame, this is as it should be."
)
_FLAGS: Final = {"true": 1.0, "false": 0.0}
# Upper bounds for the release that readers are audited with: rows of a label, and labels.
_MAX_LABEL_ROWS, _MAX_LABELS = 10, 20
# Numbers of a key that are compared with the columns.
_MAX_COMPARED_NUMBERS: Final = 10_000


class _Column(NamedTuple):
    """A column of the files.

    Attributes:
        first: Its number in the first row of the release that readers are audited with.
        step: Difference between successive rows; 0 for a column that keeps its original content.
        meaning: What it holds, in words.
        right: Pattern of names that are right for it.
        axis: The axis that it lies along; names of another axis are wrong.
    """

    first: float
    step: float
    meaning: str
    right: str
    axis: str = ""


# Position in the files → the column.
_COLUMNS: Final[Mapping[str, _Column]] = {
    "line 1 of the labels, number 1": _Column(
        14.05, 0.003, "own velocity along the world's x", _VELOCITY_NAMES, "x"
    ),
    "line 1 of the labels, number 2": _Column(
        -15.05, -0.003, "own velocity along the world's y", _VELOCITY_NAMES, "y"
    ),
    "column 2 of the labels": _Column(
        20.03, 0.03, "x of the box's centre in the LiDAR frame", _CENTER_NAMES, "x"
    ),
    "column 3 of the labels": _Column(
        -31.03, -0.03, "y of the box's centre, to the right", _CENTER_NAMES, "y"
    ),
    "column 4 of the labels": _Column(-1.61, -0.001, "z of the box's centre", _CENTER_NAMES, "z"),
    "column 5 of the labels": _Column(
        4.513,
        0.002,
        "the box's length; next are width and height",
        f"length|_l_|{_SIZE_NAMES}",
        "x",
    ),
    "column 6 of the labels": _Column(
        2.013, 0.001, "the box's width; before it is the length", f"width|_w_|{_SIZE_NAMES}", "y"
    ),
    "column 7 of the labels": _Column(
        1.113, 0.001, "the box's height, after length and width", f"height|_h_|{_SIZE_NAMES}", "z"
    ),
    "column 8 of the labels": _Column(
        2.513, 0.0015, "the box's yaw in the LiDAR frame, clockwise", "yaw_$|head|rot|angle"
    ),
    "column 9 of the labels": _Column(
        41.03, 0.03, "vx, of no frame until it is decoded", _RAW_NAMES, "x"
    ),
    "column 10 of the labels": _Column(
        -51.03, -0.03, "vy, of no frame until it is decoded", _RAW_NAMES, "y"
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
# Patterns of names with a definite meaning: of quantities that no column has, and of the columns.
_MEANINGFUL_NAMES: Final = "|".join(
    [
        "ttc|tta_|eta_|countdown|time_to|remaining|_left_|until|rate_|angular",
        "accel|speed|vel|_v_|_v_?[xyz]_",
        "colli|crash|accident|_hit_",
        *(column.right for column in _COLUMNS.values()),
    ]
)


def write_audit_release(out: Path) -> Path:
    """Write the release that readers are audited with; return its path.

    It is an accident and its twin of two frames, with all sensors.

    Raises:
        ConfigError: `out` is a file or is not empty.
    """
    check_free(out)
    first, step = np.array([column[:2] for column in _COLUMNS.values()]).T
    config = SmallRelease(frames=2, splits=("train",), channels=(*CAMERAS, LIDAR))
    with replacing_folder(out) as folder:
        write_small_release(folder, config)
        for label, path in enumerate(sorted(folder.glob("*/*/label/*/*.txt"))):
            rows = np.arange(_MAX_LABEL_ROWS * label, _MAX_LABEL_ROWS * (label + 1))
            numbers = (first + step * rows[:, None]).tolist()
            lines = [numbers[0][:2]]
            for row, line in enumerate(path.read_text().splitlines()[1:]):
                category, *_, actor, _, _ = line.split()
                values = numbers[row][2:]
                if actor == str(OWN_ACTOR_ID):
                    values[6:9] = 0, *numbers[0][:2]  # as in the release
                # A camera sees seven of ten rows; in a vehicle's label its own row comes first.
                is_visible = 0 < row < 8
                lines.append([category, *values[:9], actor, int(values[10]), is_visible])
            path.write_text("".join(f"{' '.join(map(str, line))}\n" for line in lines))
            bev_path = path.parents[2] / BEV_CAMERA / path.parent.name / f"{path.stem}.npz"
            write_npz(bev_path, _bev_image())
    return out


@cache
def _bev_image() -> ByteArray:
    """Return an array of the BEV camera, (1200, 1200, 3): 12 × 12 patches, each another object."""
    row, column = np.indices(BEV_SHAPE) // 100
    return np.stack([row * 20, column * 20, (row * 5 + column) % 11], axis=-1).astype(np.uint8)


def audit_reader(reader: Callable[[str], object] | str | os.PathLike[str]) -> AuditReport:
    """Report the column that each key of a reader's output holds, and keys with a wrong name.

    A key holds a column if four fifths of its numbers are the column's, except for their sign and
    rounding to two decimals; a flag is whether a camera sees the box if it is true as often. Words
    are not examined.

    Args:
        reader: A function that takes a dataroot and returns mappings, lists, tables, arrays,
            tensors, objects or an iterator, nested in any way; the first `MAX_VALUES` values are
            examined. Or the folder of JSON files and pictures that it wrote from the release of
            `write_audit_release`.

    Raises:
        ConfigError: A file of the folder is no JSON. Exceptions of the function are not caught.
    """
    with TemporaryDirectory() as temporary:
        release = write_audit_release(Path(temporary) / "release")
        columns = _column_numbers(release)
        if callable(reader):
            values = values_in(reader(str(release)), {}, [""])
        else:
            values = values_in_folder(path_of(reader))
        numbers, pictures, unread = _collected(values)
    rows = dict[str, Row]()
    findings = list[AuditFinding]()
    judged_count = 0
    unmatched = set[str]()
    for key, key_numbers in numbers.items():
        name, list_key = _name(key), _list_key(key)
        position, matches = _match_column(np.array(key_numbers[:_MAX_COMPARED_NUMBERS]), columns)
        is_meaningful = re.search(_MEANINGFUL_NAMES, name) is not None
        if matches and list_key not in rows:  # otherwise the complete list is of one column
            misreadings = _misreadings(key, name, position) if is_meaningful else []
            verdict = "misread" if misreadings else ""
            rows[key] = (key, position, f"{matches} of {len(key_numbers)}", verdict)
            findings += misreadings
            judged_count += is_meaningful
        elif is_meaningful and np.isfinite(key_numbers).any():
            unmatched.add(list_key)
    wrong_pictures = [name for name, is_bev in pictures.items() if is_bev]
    if wrong_pictures:
        findings.append(_picture_finding(wrong_pictures))
    unmatched.difference_update(map(_list_key, rows))
    # If numbers were not recognised, right pictures do not speak for them.
    pictures_count = len(pictures) if rows or not unmatched | unread else 0
    cannot_say = []
    if not rows:
        cannot_say.append("no key holds numbers as they are in the release's files.")
    if rows and not judged_count:
        cannot_say.append(
            "the keys' names do not say what they hold; compare the table with what you read."
        )
    if unmatched:
        cannot_say.append(
            f"the numbers of {possible_text('', unmatched)} are of no column; they may be computed "
            "or scaled."
        )
    if unread:
        cannot_say.append(f"not looked into: {possible_text('', sorted(unread))}.")
    return AuditReport(
        compared={"keys by their names": judged_count, "pictures": pictures_count},
        cannot_say=tuple(cannot_say),
        findings=tuple(findings),
        tables={"keys": [("key", "holds", "values", ""), *rows.values()]},
    )


def _picture_finding(names: Sequence[str]) -> AuditFinding:
    """Return the finding of pictures that are arrays of the BEV camera."""
    return AuditFinding(
        kind="picture",
        what="the BEV camera's array became an RGB picture: its channels are ids and classes.",
        remedy="Keep the array: JPEG changes ids and classes. Channel 2 is the class, 1 + 256 · 0 "
        "the object.",
        number=len(names),
        examples=tuple(names[:3]),
    )


def _collected(
    values: Iterable[tuple[list[str], Any]],
) -> tuple[dict[str, list[float]], dict[str, bool], set[str]]:
    """Return the first `MAX_VALUES` values of an output.

    Returns:
        Key, such as `annotations/*/size/*` → its numbers, NaN for other values, with additional
        keys for components (`size/*[0]`) and rows (`size/*[0]/*`); name of a picture → whether it
        is a BEV camera's array; types and files that were not examined.
    """
    numbers: dict[str, list[float]] = defaultdict(list)
    pictures: dict[str, bool] = {}
    unread = set()
    remaining = MAX_VALUES
    for keys, value in values:
        remaining -= 1 + (value.size // 1000 if isinstance(value, np.ndarray) else 0)
        if remaining < 0:
            unread.add(f"values after the first {MAX_VALUES:,}")
            break
        number = _number(value)
        for key in keys:
            numbers[key.lstrip("/")].append(number)
        if keys and math.isnan(number):
            name = value if isinstance(value, str) else keys[0].lstrip("/")
            is_bev = None
            if _PICTURE.search(name) and not pictures.get(name):
                is_bev = _is_bev(value)
            if is_bev is not None:
                pictures[name] = is_bev
            elif keys == [""] or not isinstance(value, str | float | None):
                unread.add(name if isinstance(value, Path) else type(value).__qualname__)
    return numbers, pictures, unread


def _number(value: Any) -> float:
    """Return a value as a number, 1 or 0 for true or false; NaN if it is none."""
    with suppress(TypeError, ValueError, OverflowError):
        return float(_FLAGS.get(value.lower(), value) if isinstance(value, str) else value)
    return math.nan


def _list_key(key: str) -> str:
    """Return the key of the list that a component or a row belongs to."""
    return re.sub(r"\[\d+\]", "", key)


def _misreadings(key: str, name: str, position: str) -> list[AuditFinding]:
    """Return the finding of a key with a name that means something other than its column."""
    column, axes = _COLUMNS[position], _AXIS.findall(name)
    is_right = re.search(column.right, name) is not None
    if is_right and (not axes or column.axis in ("", axes[-1])):
        return []
    what = f"{key} holds {position}: {column.meaning}; you read it as `{name.strip('_')}`."
    remedy = _AXES_REMEDY if is_right else _COLUMN_REMEDY
    return [AuditFinding(kind="misread", what=what, remedy=remedy, number=1)]


def _column_numbers(release: Path) -> dict[str, FloatArray]:
    """Return the absolute numbers of each column, including numbers of unwritten rows."""
    rows = np.arange(_MAX_LABEL_ROWS * _MAX_LABELS)
    numbers = {}
    for position, (first, step, *_) in _COLUMNS.items():
        numbers[position] = np.unique(np.abs(first + step * rows))
    labels = read_labels(sorted(release.glob("*/*/label/*/*.txt")))
    numbers["column 11 of the labels"] = np.unique(np.abs(labels.actor_id)).astype(float)
    return numbers


def _match_column(values: FloatArray, columns: Mapping[str, FloatArray]) -> tuple[str, int]:
    """Return the best column for values (N,), and how many of them are in it; 0 for no match."""
    if np.isin(values, (0, 1)).all():
        true_count, count = int(values.sum()), len(values)
        # A camera sees seven of the ten rows of a label, or of the nine without the agent's own.
        is_visibility = true_count % 7 == 0 and 9 * true_count <= 7 * count <= 10 * true_count
        return "column 13 of the labels", count if is_visibility else 0
    numbers = np.abs(values[np.isfinite(values) & (values != 0)])  # zeros occur in all columns
    matches = {}
    for position, column in columns.items():
        differences = np.abs(numbers[:, None] - column).min(axis=1)
        matches[position] = numbers[differences < 0.0051]
    best = max(matches, key=lambda position: len(matches[position]))
    match_count = len(matches[best])
    is_constant = len(np.unique(matches[best])) < min(2, len(columns[best]))
    is_match = match_count >= 0.8 * len(numbers) and not is_constant
    return best, match_count if is_match else 0


def _name(key: str) -> str:
    """Return the name of a key as words between underscores, with its axis.

    Examples are `_velocity_x_`, and `_w_` of `size_whl`.
    """
    path, *index = re.sub(r"/\*|\]", "", f"/{key}").split("[")
    own_name = re.findall("[^/]*(?:/[xyz])?$", path)[0]
    words = "_".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", own_name)).lower()
    axes = re.findall("(?<![a-z])[xyzwhl]{2,3}$", words)
    if not axes and re.search("vel|speed|pos|loc|cent|trans|coord", words):
        axes = ["xyz"]
    axis = axes[0][int(index[0]) :][:1] if axes and index else ""
    if axis in ("w", "h", "l") or [words] == axes:  # the axis is a complete name
        return f"_{axis or words}_"
    return f"_{words}_{axis}_".replace("__", "_")


def _is_bev(picture: Any) -> bool | None:
    """Return whether an array or a picture file has a BEV array's channels; None for no picture."""
    import cv2

    with suppress(TypeError, ValueError, cv2.error):
        if isinstance(picture, str | Path):
            pixels = read_image(Path(picture))
        else:
            pixels = np.asarray(picture, dtype=np.uint8)
        if pixels.ndim == 3 and pixels.shape[2] == 3:
            small = cv2.resize(pixels, (12, 12), interpolation=cv2.INTER_AREA).astype(float)
            bev = _bev_image()[50::100, 50::100]
            differences = [np.abs(small - image).mean() for image in (bev, bev[..., ::-1])]
            return bool(min(differences) < 12)
    return None
