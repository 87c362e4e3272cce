"""Label files, and the frames of their velocities.

The release writes `(vx, vy) = Rz(yaw) · v_world`, where yaw is the yaw of the row in the agent's
LiDAR frame. The rule is the same in CARLA's left-handed axes and in the devkit's, because mirroring
negates both the angle and y. The agent's own row has yaw 0, so its velocity is in the world frame.

Files are parsed in bulk: the bodies of many files are joined, and Arrow casts their columns. Files
that cannot be parsed like this (CRLF, blanks at line ends, one-token lines) are normalised first;
faults are reported.
"""

import codecs
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from deepaccident_devkit.errors import LabelError, shortened
from deepaccident_devkit.geometry import Boxes, conventions, quaternions
from deepaccident_devkit.release.store import ReleasePath, read_content
from deepaccident_devkit.support.arrays import (
    LARGEST_NUMBER,
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    ShortRepr,
    freeze_arrays,
    in_range,
)
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import LIMITS_VARIABLE, byte_limit
from deepaccident_devkit.support.text import integer_of, number_of
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import CATEGORIES

# The 13 fields of a box line, in order.
LABEL_FIELDS = (
    "class",
    "x",
    "y",
    "z",
    "l",
    "w",
    "h",
    "yaw",
    "vx",
    "vy",
    "id",
    "num_lidar_pts",
    "camera_visible",
)
_FINITE_FIELDS = LABEL_FIELDS[1:8]
_FLOAT_FIELDS = LABEL_FIELDS[1:10]
_INTEGER_FIELDS = ("id", "num_lidar_pts")
# Name → values of all lines.
_Columns: TypeAlias = dict[str, AnyArray]
# The fields of the first line, the velocity of the recording agent.
_HEADER = ("speed_x", "speed_y")
_FILES_PER_CALL = 250
_MAX_THREADS = 4
# Length of the longest lines, which determines how many lines a file of the largest size has.
_MAX_BYTES_PER_LINE = 192
# Number of lines that are searched one by one for a fault.
_LINES_PER_STEP = 1000
_REMEDY = "restore the file from its archive, or leave the scenario out with on_error='skip'"


def label_from_world_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """Convert world velocities to label velocities, shape (N, 2), m/s.

    Args:
        velocity: Velocities in the world frame, shape (N, 2), m/s.
        yaw: Yaws of the boxes in the label's LiDAR frame, shape (N,), radians, with the same
            handedness.
    """
    return turned_vectors(velocity, yaw)


def world_from_label_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """Convert label velocities to world velocities, shape (N, 2), m/s.

    This is the inverse of `label_from_world_velocity`; NaN stays NaN.
    """
    return turned_vectors(velocity, -yaw)


def turned_vectors(vectors: FloatArray, angle: FloatArray) -> FloatArray:
    """Rotate vectors (N, 2) by angles (N,), radians, from the first axis towards the second."""
    cos = np.cos(angle)
    sin = np.sin(angle)
    x = vectors[:, 0]
    y = vectors[:, 1]
    turned_x = cos * x - sin * y
    turned_y = sin * x + cos * y
    return np.column_stack([turned_x, turned_y])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels(ShortRepr):
    """N boxes from F label files, in the order of the files; arrays are read-only.

    Values are right-handed (x forward, y left, yaw counter-clockwise). If read with `raw=True`,
    they keep the files' axes (y right, yaw clockwise).

    Attributes:
        raw: Whether the values are left-handed, as in the files.
        num_boxes: Number of boxes of each file, shape (F,), int64.
        agent_velocity: Velocity of the recording agent in the world frame, shape (F, 2), float64,
            m/s; may be NaN.
        category: Index into `taxonomy.CATEGORIES`, shape (N,), int8.
        center: Centre in the agent's LiDAR frame, shape (N, 3), float64, metres.
        size: Full length, width, height, shape (N, 3), float64, metres.
        yaw: Yaw about z in the LiDAR frame, shape (N,), float64, radians.
        velocity: Velocity as in the label, shape (N, 2), float64, m/s; NaN if the label has NaN,
            infinity or a number beyond 1e9. This is the world velocity rotated by `yaw` (see
            `world_from_label_velocity`).
        actor_id: Actor id, shape (N,), int64; −100 for the recording agent, −1 if untracked, 20000
            and above for parked vehicles.
        num_lidar_pts: Number of LiDAR points, shape (N,), int64.
        camera_visible: Whether a camera sees the box, shape (N,), bool.
    """

    raw: bool
    num_boxes: IntArray
    agent_velocity: FloatArray
    category: AnyArray
    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    velocity: FloatArray
    actor_id: IntArray
    num_lidar_pts: IntArray
    camera_visible: BoolArray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        freeze_arrays(self)

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.center)

    def boxes(self) -> Boxes:
        """Return the boxes in the LiDAR frame, always right-handed, with label velocities."""
        center = self.center
        velocity = self.velocity
        yaw = self.yaw
        if self.raw:
            center = conventions.flip_points(center)
            velocity = conventions.flip_vectors2(velocity)
            yaw = conventions.flip_yaw(yaw)
        rows = [np.arange(count) for count in self.num_boxes]
        return Boxes(
            frame="lidar",
            center=center,
            size=self.size,
            rotation=quaternions.from_yaw(yaw),
            velocity=np.column_stack([velocity, np.zeros(len(self))]),
            category=self.category,
            actor_id=self.actor_id,
            num_lidar_pts=self.num_lidar_pts,
            camera_visible=self.camera_visible,
            row=np.concatenate(rows or [np.zeros(0)]),
        )


def read_label(path: ReleasePath, *, raw: bool = False) -> Labels:
    """Read one label file; see `read_labels`."""
    return read_labels([path], raw=raw)


def read_labels(paths: Sequence[ReleasePath], *, raw: bool = False) -> Labels:
    """Read the boxes of several label files.

    Empty lines and lines with one token are skipped (`read_lone_words` returns the latter). Blanks
    at line ends and CRLF are accepted. A file with only line 1 is valid.

    Args:
        paths: The files.
        raw: Whether to keep CARLA's left-handed values.

    Raises:
        MissingFileError: If a file does not exist.
        LabelError: If a file is truncated or too large, or if a line has the wrong number of
            fields, a word instead of a number, an unknown class, or NaN, infinity or a number
            beyond 1e9 as a position, size or yaw. The message names file and line.
    """
    starts = range(0, len(paths), _FILES_PER_CALL)
    batches = [paths[start : start + _FILES_PER_CALL] for start in starts]
    parsed_batches = _parse_batches(batches or [[]])
    columns = {}
    for name in parsed_batches[0]:
        columns[name] = np.concatenate([parsed[name] for parsed in parsed_batches])
    if not raw:
        columns["agent_velocity"] = conventions.flip_vectors2(columns["agent_velocity"])
        columns["center"] = conventions.flip_points(columns["center"])
        columns["velocity"] = conventions.flip_vectors2(columns["velocity"])
        columns["yaw"] = conventions.flip_yaw(columns["yaw"])
    return Labels(raw=raw, **columns)


def read_lone_words(path: ReleasePath) -> list[tuple[int, str, bool]]:
    """Read the lines of a label file that are skipped because they have only one word.

    If the file cannot be read, the errors are as in `read_label`.

    Returns:
        For each such line its number, its word, and whether the file ends within the word.
    """
    lines = _read_label_bytes(path, ended=False).splitlines(keepends=True)
    lone_words = []
    for number, line in enumerate(lines, start=1):
        words = line.split(maxsplit=1)
        if len(words) == 1:
            word = shortened(words[0].decode(errors="replace"))
            is_cut_off = not line.endswith((b"\n", b"\r"))
            lone_words.append((number, word, is_cut_off))
    return lone_words


def write_label(path: Path, labels: Labels) -> None:
    """Write one file's boxes with CARLA's signs; reading the file returns equal values.

    The last line has no line end.

    Raises:
        LabelError: If `labels` do not come from exactly one file.
    """
    if len(labels.num_boxes) != 1:
        raise LabelError(f"{path}: expected the labels of one file, found {len(labels.num_boxes)}")
    if labels.raw:
        flip = 1.0
    else:
        flip = -1.0
    signs = np.array([1, flip, 1, 1, 1, 1, flip, 1, flip])
    values = np.column_stack([labels.center, labels.size, labels.yaw, labels.velocity])
    # Adding 0.0 removes negative zeros.
    numbers = values * signs + 0.0
    speed = labels.agent_velocity[0] * (1.0, flip) + 0.0
    lines = [_join_numbers(speed.tolist())]
    rows = zip(
        labels.category.tolist(),
        numbers.tolist(),
        labels.actor_id.tolist(),
        labels.num_lidar_pts.tolist(),
        labels.camera_visible.tolist(),
        strict=True,
    )
    for code, row, actor, points, visible in rows:
        lines.append(f"{CATEGORIES[code]} {_join_numbers(row)} {actor} {points} {visible}")
    write_bytes(path, "\n".join(lines).encode("ascii"))


def _join_numbers(numbers: Iterable[float]) -> str:
    """Join numbers with blanks."""
    return " ".join(map(repr, numbers))


def _parse_batches(batches: Sequence[Sequence[ReleasePath]]) -> list[_Columns]:
    """Parse every batch; if there are several, this thread reads files while others parse."""
    if len(batches) < 2:
        return [
            _parse_files(batch, [_read_label_bytes(path) for path in batch]) for batch in batches
        ]
    from concurrent.futures import ThreadPoolExecutor

    # Imported in this thread: pyarrow 25.0.0 crashes after the end of the thread that imports it.
    import pyarrow as pa  # noqa: F401

    with ThreadPoolExecutor(min(_MAX_THREADS, usable_cores())) as pool:
        futures = []
        for batch in batches:
            contents = [_read_label_bytes(path) for path in batch]
            futures.append(pool.submit(_parse_files, batch, contents))
        return [future.result() for future in futures]


def _parse_files(paths: Sequence[ReleasePath], contents: Sequence[bytes]) -> _Columns:
    """Parse files from their bytes; raise LabelError for the first faulty line."""
    columns = _parse_joined(contents)
    if columns is None and not any(b"\0" in content for content in contents):
        columns = _parse_joined([_normalise(content) for content in contents])
    if columns is None or _has_fault(columns):
        raise _find_first_fault(paths, contents)
    return columns


def _read_label_bytes(path: ReleasePath, *, ended: bool = True) -> bytes:
    """Read a file's bytes; if `ended`, add a line end to its last line if it lacks one.

    LabelError is raised if the file has too many lines.
    """
    content = read_content(path, "label", LabelError, _REMEDY).removeprefix(codecs.BOM_UTF8)
    num_lines = max(content.count(b"\n"), content.count(b"\r"))
    max_lines = byte_limit("label") // _MAX_BYTES_PER_LINE
    if num_lines > max_lines:
        limit = f"{LIMITS_VARIABLE}=label={_MAX_BYTES_PER_LINE * num_lines}"
        raise LabelError(
            f"{path}: has {num_lines:,} lines, more than {max_lines:,}; "
            f"if the file is correct, set {limit}; {_REMEDY}"
        )
    if ended and not content.endswith(b"\n"):
        content += b"\n"
    return content


def _parse_joined(contents: Sequence[bytes]) -> _Columns | None:
    """Parse files that end in a line end; return None if their format is unusual or faulty."""
    import pyarrow as pa

    headers = []
    bodies = []
    for content in contents:
        body_start = content.index(b"\n") + 1
        headers.append(content[:body_start])
        bodies.append(memoryview(content)[body_start:])
    header = b"".join(headers)
    body = b"".join(bodies)
    if b"x" in body or b"X" in body:  # Arrow reads hexadecimal integers
        return None
    try:
        header_words = _split_columns(header, _HEADER)
        words = _split_columns(body, LABEL_FIELDS)
        if header_words is None or words is None:
            return None
        num_boxes = np.array([content.count(b"\n") - 1 for content in contents], dtype=np.int64)
        return _parse_columns(words, header_words, num_boxes)
    except pa.ArrowInvalid:
        return None


def _split_columns(content: bytes, names: Sequence[str]) -> NamedValues | None:
    """Return column name → words; None unless each line has one word per name.

    Words must be separated by single blanks. Arrow's CSV reader is not used: up to version 19 it
    writes out of bounds if a line has too many words (apache/arrow 45497), and it starts a thread
    for each call.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    characters = np.frombuffer(content, dtype=np.uint8)
    word_ends = np.flatnonzero((characters == ord(" ")) | (characters == ord("\n")))
    word_numbers = np.arange(len(word_ends))
    num_columns = len(names)
    is_line_end = characters[word_ends] == ord("\n")
    if not np.array_equal(is_line_end, word_numbers % num_columns == num_columns - 1):
        return None
    buffers = [None, pa.py_buffer(np.append(0, word_ends + 1)), pa.py_buffer(content)]
    words = pa.Array.from_buffers(pa.large_binary(), len(word_ends), buffers).cast(
        pa.large_string()
    )
    words = pc.ascii_rtrim(words, characters=" \n")
    columns = {}
    for index, name in enumerate(names):
        columns[name] = words.take(pa.array(word_numbers[index::num_columns]))
    return columns


def _parse_columns(words: NamedValues, header: NamedValues, num_boxes: IntArray) -> _Columns:
    """Convert the words of all columns; an unknown class becomes −1.

    pyarrow.ArrowInvalid is raised if a word does not have the column's type.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    def parse_numbers(columns: NamedValues, names: Sequence[str]) -> FloatArray:
        arrays = [columns[name].cast(pa.float64()) for name in names]
        return np.column_stack([array.to_numpy() for array in arrays])

    def encode_words(name: str, known_words: Sequence[str]) -> AnyArray:
        value_set = pa.array(known_words, pa.large_string())
        indices = pc.index_in(words[name], value_set=value_set)
        return np.asarray(indices.fill_null(-1), dtype=np.int8)

    velocity = parse_numbers(words, ("vx", "vy"))
    velocity[~in_range(velocity)] = np.nan
    agent_velocity = parse_numbers(header, _HEADER)
    agent_velocity[~in_range(agent_velocity)] = np.nan
    visible = encode_words("camera_visible", ("False", "True"))
    if (visible < 0).any():
        raise pa.ArrowInvalid("the last field is neither False nor True")
    return {
        "num_boxes": num_boxes,
        "agent_velocity": agent_velocity,
        "category": encode_words("class", CATEGORIES),
        "center": parse_numbers(words, ("x", "y", "z")),
        "size": parse_numbers(words, ("l", "w", "h")),
        "yaw": parse_numbers(words, ("yaw",)).reshape(-1),
        "velocity": velocity,
        "actor_id": words["id"].cast(pa.int64()).to_numpy(),
        "num_lidar_pts": words["num_lidar_pts"].cast(pa.int64()).to_numpy(),
        "camera_visible": visible == 1,
    }


def _has_fault(columns: _Columns) -> bool:
    """Return whether a value is out of range, or a class is unknown."""
    for name in ("center", "size", "yaw"):
        if not in_range(columns[name]).all():
            return True
    is_unknown = columns["category"] < 0
    return bool(is_unknown.any())


def _normalise(content: bytes) -> bytes:
    """Return a label's bytes without blank lines, one-token lines, CRLF and superfluous blanks."""
    lines = []
    for line in content.splitlines():
        words = _split_words(line)
        if len(words) > 1:
            lines.append(b" ".join(words))
    return b"\n".join([*lines, b""]) or b"\n"


def _split_words(line: bytes) -> list[bytes]:
    """Split a line into words; all superfluous words together are the last one."""
    return line.split(maxsplit=len(LABEL_FIELDS))


def _find_first_fault(paths: Sequence[ReleasePath], contents: Sequence[bytes]) -> LabelError:
    """Return the error of the first wrong line."""
    for path, content in zip(paths, contents, strict=True):
        faulty_line = _find_faulty_line(content)
        if faulty_line is not None:
            number, fault = faulty_line
            return LabelError(f"{path}:{number}: {fault}; {_REMEDY}")
    odd_path = paths[0]
    for path, content in zip(paths, contents, strict=True):
        if _parse_joined([_normalise(content)]) is None:
            odd_path = path
            break
    return LabelError(f"{odd_path}: cannot be parsed, though each line looks right; {_REMEDY}")


def _find_faulty_line(content: bytes) -> tuple[int, str] | None:
    """Return the number and the fault of the first wrong line; None if there is none."""
    has_header = False
    for number, line in _find_suspicious_lines(content.splitlines()):
        if b"\0" in line:
            return number, "contains zero bytes, as happens when a disk is full"
        words = [word.decode("utf-8", errors="replace") for word in _split_words(line)]
        if len(words) < 2:
            continue
        fault = _find_line_fault(words) if has_header else _find_header_fault(words)
        if fault:
            return number, fault
        has_header = True
    if not has_header:
        return 1, "expected '<speed_x> <speed_y>', found an empty file"
    return None


def _find_suspicious_lines(lines: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield numbered lines, leaving out blocks in which bulk parsing finds no fault.

    The lines of the first block are always yielded.
    """
    for start in range(0, len(lines), _LINES_PER_STEP):
        block = lines[start : start + _LINES_PER_STEP]
        joined = b"\n".join(block)
        columns = None
        if start and b"\0" not in joined:
            columns = _parse_joined([b"0 0\n" + _normalise(joined)])
        if columns is None or _has_fault(columns):
            yield from enumerate(block, start=start + 1)


def _find_header_fault(words: Sequence[str]) -> str | None:
    """Describe the fault in the fields of the first line; return None if they are valid."""
    if len(words) != len(_HEADER):
        return (
            f"expected '<speed_x> <speed_y>', found {_count_words(words)} fields: "
            f"{_quote_words(words)}"
        )
    for word in words:
        if number_of(word) is None:
            return f"{shortened(word)!r} is not a number"
    return None


def _find_line_fault(words: Sequence[str]) -> str | None:
    """Describe the fault in the fields of a box's line; return None if they are valid."""
    if len(words) != len(LABEL_FIELDS):
        return (
            f"expected {len(LABEL_FIELDS)} fields, found {_count_words(words)}: "
            f"{_quote_words(words)}"
        )
    for name, word in zip(LABEL_FIELDS, words, strict=True):
        fault = _find_field_fault(name, word)
        if fault:
            return fault
    return None


def _find_field_fault(name: str, word: str) -> str | None:
    """Describe the fault in the word of a field; return None if it is valid."""
    expected = None
    if name == "class" and word not in CATEGORIES:
        expected = f"one of {', '.join(CATEGORIES)}"
    elif name == "camera_visible" and word not in ("True", "False"):
        expected = "True or False"
    elif name in _INTEGER_FIELDS and integer_of(word) is None:
        expected = "an integer"
    elif name in _FLOAT_FIELDS:
        number = number_of(word)
        if number is None:
            expected = "a number"
        elif name in _FINITE_FIELDS and not in_range(number):
            expected = f"a finite number up to {LARGEST_NUMBER:.0e}"
    return expected and f"{name} is {shortened(word)!r}, expected {expected}"


def _count_words(words: Sequence[str]) -> str:
    """Return the number of words for a message."""
    if len(words) <= len(LABEL_FIELDS):
        return str(len(words))
    return f"more than {len(LABEL_FIELDS)}"


def _quote_words(words: Sequence[str]) -> str:
    """Return the words of a line as a short quotation."""
    return repr(shortened(" ".join(words)))
