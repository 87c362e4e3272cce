"""Audit of users' readers, by a small release in which each column has distinct numbers."""

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

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

# Largest number of values that are examined, because a generator may be endless. In a large array,
# a thousand values count as one.
MAX_VALUES = 300_000
# Patterns of key names that are right for a column.
_CENTER_NAMES = "pos|_loc|cent|trans|coord|^(?!.*(vel|speed|acc|size|dim)).*_[cdpt]?[xyz]_"
_VELOCITY_NAMES = "vel.*_[xy]_|_v_?[xy]_|speed_[xy]_"
_RAW_NAMES = "raw|label|undecoded|stored"
_SIZE_NAMES = "size|dim|_d[xyz]_"
# The axis that a name contains.
_AXIS = re.compile("_(?:v|d|c|p|t|pos|loc|vel|coord|cent(?:er|re))?([xyz])(?=_)")
# Files, keys and paths whose names match may be images.
_PICTURE = re.compile(r"image|img|rgb|picture|photo|\.(jpe?g|png)$", re.IGNORECASE)
_COLUMN_REMEDY = (
    "docs/format.md says what each column contains; decode vx and vy by v_world = Rz(−yaw) "
    "· (vx, vy)."
)
_AXES_REMEDY = (
    "In the files x is forward, y to the right and z up. If your axes differ on purpose, as in "
    "nuScenes' LiDAR frame, there is nothing to correct."
)
# Texts that mean true or false.
_FLAGS = {"true": 1.0, "false": 0.0}
# Upper bounds for the audit release: number of rows in a label, and number of labels.
_MAX_LABEL_ROWS = 10
_MAX_LABELS = 20
# Largest number of values of a key that are compared with the columns.
_MAX_COMPARED_NUMBERS = 10_000
# Largest difference between a value and the number in its column.
_NUMBER_TOLERANCE = 0.0051
# Smallest share of a key's values that must be in its column.
_MIN_MATCHING_SHARE = 0.8
# Number of patches in the BEV camera's array along each axis, and patch size in cells.
_NUM_PATCHES = 12
_PATCH_CELLS = 100
# Largest mean difference between an image and the BEV camera's array.
_MAX_PICTURE_DIFFERENCE = 12


class _Column(NamedTuple):
    """A column of the release's files.

    Attributes:
        first: Number in the first row of the audit release.
        step: Difference between successive rows; 0 for a column that keeps its original content.
        meaning: What the column contains, in words.
        right: Pattern of key names that are right for it.
        axis: The axis that the column belongs to; key names with another axis are wrong.
    """

    first: float
    step: float
    meaning: str
    right: str
    axis: str = ""


# Position in the files → the column there.
_COLUMNS: Mapping[str, _Column] = {
    "line 1 of the labels, number 1": _Column(
        14.05, 0.003, "the agent's own velocity along the world's x", _VELOCITY_NAMES, "x"
    ),
    "line 1 of the labels, number 2": _Column(
        -15.05, -0.003, "the agent's own velocity along the world's y", _VELOCITY_NAMES, "y"
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
        "the box's length, followed by its width and height",
        f"length|_l_|{_SIZE_NAMES}",
        "x",
    ),
    "column 6 of the labels": _Column(
        2.013, 0.001, "the box's width, which follows its length", f"width|_w_|{_SIZE_NAMES}", "y"
    ),
    "column 7 of the labels": _Column(
        1.113, 0.001, "the box's height, after length and width", f"height|_h_|{_SIZE_NAMES}", "z"
    ),
    "column 8 of the labels": _Column(
        2.513, 0.0015, "the box's yaw in the LiDAR frame, clockwise", "yaw_$|head|rot|angle"
    ),
    "column 9 of the labels": _Column(
        41.03, 0.03, "vx, which must be decoded before it is in any frame", _RAW_NAMES, "x"
    ),
    "column 10 of the labels": _Column(
        -51.03, -0.03, "vy, which must be decoded before it is in any frame", _RAW_NAMES, "y"
    ),
    "column 11 of the labels": _Column(0, 0, "the actor's id", "_ids?_|actor|track"),
    "column 12 of the labels": _Column(
        2103, 7, "the number of LiDAR points in the box", "point|pts|lidar|_num_|_count_"
    ),
    "column 13 of the labels": _Column(
        0, 0, "whether a camera of the agent sees the box", "visib|seen|occl"
    ),
    "line 1 of meta, word 9": _Column(
        12,
        0,
        "the number of simulated frames, which is the number of recorded frames plus ten",
        "frame|length|_num_|count|total",
    ),
}
# Patterns of names with a fixed meaning: of quantities that no column contains, and of columns.
_MEANINGFUL_NAMES = "|".join(
    [
        "ttc|tta_|eta_|countdown|time_to|remaining|_left_|until|rate_|angular",
        "accel|speed|vel|_v_|_v_?[xyz]_",
        "colli|crash|accident|_hit_",
        *(column.right for column in _COLUMNS.values()),
    ]
)


def write_audit_release(out: Path) -> Path:
    """Write the release that readers are audited with; return its path.

    It contains an accident and its twin, two frames each, with all sensors.

    Raises:
        ConfigError: If `out` is a file or is not empty.
    """
    check_free(out)
    first, step = np.array([column[:2] for column in _COLUMNS.values()]).T
    config = SmallRelease(frames=2, splits=("train",), channels=(*CAMERAS, LIDAR))
    with replacing_folder(out) as folder:
        write_small_release(folder, config)
        for label, path in enumerate(sorted(folder.glob("*/*/label/*/*.txt"))):
            rows = np.arange(_MAX_LABEL_ROWS * label, _MAX_LABEL_ROWS * (label + 1))
            numbers = (first + step * rows[:, None]).tolist()
            own_velocity = numbers[0][:2]
            lines = [own_velocity]
            for row, line in enumerate(path.read_text().splitlines()[1:]):
                category, *_, actor, _, _ = line.split()
                values = numbers[row][2:]
                if actor == str(OWN_ACTOR_ID):
                    values[6:9] = [0, *own_velocity]  # as in the real release
                # A camera sees seven of ten rows; in a vehicle's label, the vehicle's row is first.
                is_visible = 0 < row < 8
                lines.append([category, *values[:9], actor, int(values[10]), is_visible])
            texts = [" ".join(map(str, line)) for line in lines]
            path.write_text("".join(f"{text}\n" for text in texts))
            bev_path = path.parents[2] / BEV_CAMERA / path.parent.name / f"{path.stem}.npz"
            write_npz(bev_path, _make_bev_array())
    return out


@cache
def _make_bev_array() -> ByteArray:
    """Make an array of the BEV camera, (1200, 1200, 3): 12 × 12 patches of distinct objects."""
    row, column = np.indices(BEV_SHAPE) // _PATCH_CELLS
    object_class = (row * 5 + column) % 11
    channels = np.stack([row * 20, column * 20, object_class], axis=-1)
    return channels.astype(np.uint8)


def audit_reader(reader: Callable[[str], object] | str | os.PathLike[str]) -> AuditReport:
    """Report which column each key of a reader's output contains, and keys with a wrong name.

    A key contains a column if four fifths of its values are in the column, ignoring signs and
    rounding to two decimals. A flag is the camera's visibility if it is true equally often. Words
    are not examined.

    Args:
        reader: A function that takes a dataroot and returns mappings, lists, tables, arrays,
            tensors, objects or an iterator, nested in any way; the first `MAX_VALUES` values are
            examined. Or the folder of JSON files and images that it wrote for the release of
            `write_audit_release`.

    Raises:
        ConfigError: If a JSON file in the folder is invalid. Exceptions of `reader` are not caught.
    """
    with TemporaryDirectory() as temporary:
        release = write_audit_release(Path(temporary) / "release")
        columns = _column_numbers(release)
        if callable(reader):
            values = values_in(reader(str(release)), {}, [""])
        else:
            values = values_in_folder(path_of(reader))
        numbers, pictures, unread = _collect_values(values)
    rows = dict[str, Row]()
    findings = list[AuditFinding]()
    judged_count = 0
    unmatched = set[str]()
    for key, key_numbers in numbers.items():
        name = _readable_name(key)
        list_key = _list_key(key)
        compared_numbers = np.array(key_numbers[:_MAX_COMPARED_NUMBERS])
        position, match_count = _match_column(compared_numbers, columns)
        is_meaningful = re.search(_MEANINGFUL_NAMES, name) is not None
        if match_count and list_key not in rows:  # otherwise, the whole list is one column
            misreadings = _find_misreadings(key, name, position) if is_meaningful else []
            verdict = "misread" if misreadings else ""
            rows[key] = (key, position, f"{match_count} of {len(key_numbers)}", verdict)
            findings += misreadings
            judged_count += is_meaningful
        elif is_meaningful and np.isfinite(key_numbers).any():
            unmatched.add(list_key)
    wrong_pictures = [name for name, is_bev in pictures.items() if is_bev]
    if wrong_pictures:
        findings.append(_picture_finding(wrong_pictures))
    unmatched.difference_update(map(_list_key, rows))
    # If no numbers were recognised, correct images prove nothing about them.
    pictures_count = len(pictures) if rows or not unmatched | unread else 0
    cannot_say = []
    if not rows:
        cannot_say.append("no key contains the numbers in the release's files.")
    if rows and not judged_count:
        cannot_say.append(
            "the names of the keys do not say what they contain; compare the table with what you "
            "read."
        )
    if unmatched:
        cannot_say.append(
            f"the numbers of {possible_text('', unmatched)} match no column; they may be computed "
            "or scaled."
        )
    if unread:
        cannot_say.append(f"not examined: {possible_text('', sorted(unread))}.")
    return AuditReport(
        compared={"keys by their names": judged_count, "pictures": pictures_count},
        cannot_say=tuple(cannot_say),
        findings=tuple(findings),
        tables={"keys": [("key", "holds", "values", ""), *rows.values()]},
    )


def _picture_finding(names: Sequence[str]) -> AuditFinding:
    """Return the finding about images that are arrays of the BEV camera."""
    return AuditFinding(
        kind="picture",
        what="the BEV camera's array became an RGB picture: its channels are ids and classes.",
        remedy="Keep the array: JPEG changes ids and classes. Channel 2 is the class, 1 + 256 · 0 "
        "the object.",
        number=len(names),
        examples=tuple(names[:3]),
    )


def _collect_values(
    values: Iterable[tuple[list[str], Any]],
) -> tuple[dict[str, list[float]], dict[str, bool], set[str]]:
    """Collect the first `MAX_VALUES` values of an output.

    Returns:
        Key, such as `annotations/*/size/*` → its values (NaN if not a number), also with keys for
        components (`size/*[0]`) and rows (`size/*[0]/*`); name of an image → whether it is a BEV
        camera's array; types and files that were not examined.
    """
    numbers: dict[str, list[float]] = defaultdict(list)
    pictures: dict[str, bool] = {}
    unread = set()
    remaining = MAX_VALUES
    for keys, value in values:
        remaining -= 1
        if isinstance(value, np.ndarray):
            remaining -= value.size // 1000
        if remaining < 0:
            unread.add(f"values after the first {MAX_VALUES:,}")
            break
        number = _as_number(value)
        for key in keys:
            numbers[key.lstrip("/")].append(number)
        if not keys or not math.isnan(number):
            continue
        name = value if isinstance(value, str) else keys[0].lstrip("/")
        is_bev = None
        if _PICTURE.search(name) and not pictures.get(name):
            is_bev = _resembles_bev(value)
        if is_bev is not None:
            pictures[name] = is_bev
        elif keys == [""] or not isinstance(value, str | float | None):
            type_name = type(value).__qualname__
            unread.add(name if isinstance(value, Path) else type_name)
    return numbers, pictures, unread


def _as_number(value: Any) -> float:
    """Convert a value to a number; true is 1, false is 0, and anything else is NaN."""
    with suppress(TypeError, ValueError, OverflowError):
        if isinstance(value, str):
            value = _FLAGS.get(value.lower(), value)
        return float(value)
    return math.nan


def _list_key(key: str) -> str:
    """Return the key of the list that a component or a row belongs to."""
    return re.sub(r"\[\d+\]", "", key)


def _find_misreadings(key: str, name: str, position: str) -> list[AuditFinding]:
    """Return a finding if a key's name does not mean the column that it contains.

    The list is empty if the name is right.
    """
    column = _COLUMNS[position]
    axes = _AXIS.findall(name)
    is_right_name = re.search(column.right, name) is not None
    is_right_axis = not axes or column.axis in ("", axes[-1])
    if is_right_name and is_right_axis:
        return []
    what = f"{key} contains {position}: {column.meaning}; you read it as `{name.strip('_')}`."
    remedy = _AXES_REMEDY if is_right_name else _COLUMN_REMEDY
    return [AuditFinding(kind="misread", what=what, remedy=remedy, number=1)]


def _column_numbers(release: Path) -> dict[str, FloatArray]:
    """Return the absolute numbers of each column; rows that were not written are included."""
    rows = np.arange(_MAX_LABEL_ROWS * _MAX_LABELS)
    numbers = {}
    for position, (first, step, *_) in _COLUMNS.items():
        numbers[position] = np.unique(np.abs(first + step * rows))
    labels = read_labels(sorted(release.glob("*/*/label/*/*.txt")))
    numbers["column 11 of the labels"] = np.unique(np.abs(labels.actor_id)).astype(float)
    return numbers


def _match_column(values: FloatArray, columns: Mapping[str, FloatArray]) -> tuple[str, int]:
    """Return the column that matches values (N,) best, and how many match; 0 if none does."""
    if np.isin(values, (0, 1)).all():
        true_count = int(values.sum())
        count = len(values)
        # A camera sees seven of a label's ten rows, or of the nine without the agent's own row.
        is_visibility = true_count % 7 == 0 and 9 * true_count <= 7 * count <= 10 * true_count
        return "column 13 of the labels", count if is_visibility else 0
    numbers = np.abs(values[np.isfinite(values) & (values != 0)])  # zeros occur in all columns
    matches = {}
    for position, column in columns.items():
        differences = np.abs(numbers[:, None] - column).min(axis=1)
        matches[position] = numbers[differences < _NUMBER_TOLERANCE]
    best_position = max(matches, key=lambda position: len(matches[position]))
    match_count = len(matches[best_position])
    is_constant = len(np.unique(matches[best_position])) < min(2, len(columns[best_position]))
    if is_constant or match_count < _MIN_MATCHING_SHARE * len(numbers):
        return best_position, 0
    return best_position, match_count


def _readable_name(key: str) -> str:
    """Return the name of a key as words separated by underscores, with its axis.

    Examples are `_velocity_x_`, and `_w_` for a component of `size_whl`.
    """
    path, *indices = re.sub(r"/\*|\]", "", f"/{key}").split("[")
    own_name = re.findall("[^/]*(?:/[xyz])?$", path)[0]
    words = "_".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+|\d+", own_name)).lower()
    axes = re.findall("(?<![a-z])[xyzwhl]{2,3}$", words)
    if not axes and re.search("vel|speed|pos|loc|cent|trans|coord", words):
        axes = ["xyz"]
    axis = ""
    if axes and indices:
        component = int(indices[0])
        axis = axes[0][component : component + 1]
    is_complete_name = axis in ("w", "h", "l") or [words] == axes
    if is_complete_name:
        return f"_{axis or words}_"
    return f"_{words}_{axis}_".replace("__", "_")


def _resembles_bev(picture: Any) -> bool | None:
    """Return whether an array or an image file has the channels of a BEV array.

    Return None if it is not an image.
    """
    import cv2

    with suppress(TypeError, ValueError, cv2.error):
        if isinstance(picture, str | Path):
            pixels = read_image(Path(picture))
        else:
            pixels = np.asarray(picture, dtype=np.uint8)
        if pixels.ndim == 3 and pixels.shape[2] == 3:
            size = (_NUM_PATCHES, _NUM_PATCHES)
            small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(float)
            middles = slice(_PATCH_CELLS // 2, None, _PATCH_CELLS)
            bev = _make_bev_array()[middles, middles]
            rgb_difference = np.abs(small - bev).mean()
            bgr_difference = np.abs(small - bev[..., ::-1]).mean()
            return bool(min(rgb_difference, bgr_difference) < _MAX_PICTURE_DIFFERENCE)
    return None
