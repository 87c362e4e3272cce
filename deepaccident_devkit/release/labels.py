"""Label files, and the frames of their velocities.

The release writes `(vx, vy) = Rz(yaw) · v_world`, with the row's own yaw in the agent's LiDAR frame. The rule is the
same in CARLA's left-handed axes and in the devkit's: mirroring negates both the angle and y. The agent's own row has
yaw 0, so it reads as the world's.

Files are parsed in bulk: the bodies of many files are joined, and Arrow casts their columns. Files that it cannot read
(CRLF, blanks at line ends, one-token lines, faults) are tidied, or their fault is named.
"""

import codecs
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

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
    in_range,
    readonly,
)
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import LIMITS_VARIABLE, byte_limit
from deepaccident_devkit.support.text import integer_of, number_of
from deepaccident_devkit.taxonomy import CATEGORIES


def label_from_world_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 2) m/s as a label writes them.

    Args:
        velocity: (N, 2) m/s in world.
        yaw: (N,) radians, each box's in the LiDAR frame of the label, of the same handedness.
    """
    return turned_vectors(velocity, yaw)


def world_from_label_velocity(velocity: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 2) m/s in world: the inverse of `label_from_world_velocity`; NaN stays NaN."""
    return turned_vectors(velocity, -yaw)


def turned_vectors(vectors: FloatArray, angle: FloatArray) -> FloatArray:
    """Vectors (N, 2) turned by angles (N,), from the first axis to the second."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])


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
_HEADER = ("speed_x", "speed_y")
_FILES_A_CALL = 250
_MOST_THREADS = 4
# Of the longest lines; a file that is as large as it may be has so many lines at the most.
_BYTES_A_LINE = 192
# Lines among which a fault is looked for one by one.
_LINES_A_STEP = 1000
_REMEDY = "restore the file from its archive, or leave the scenario out with on_error='skip'"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels(ShortRepr):
    """The N boxes of F label files, file after file; arrays are read-only.

    Right-handed (x forward, y left, yaw counter-clockwise) unless read with `raw=True`, then as the files say
    (y right, yaw clockwise).

    Attributes:
        raw: whether the values are the files' own.
        num_boxes: (F,) int64, boxes of each file.
        agent_velocity: (F, 2) float64, m/s, the recording agent's velocity in the world frame; NaN as well.
        category: (N,) int8, index into `taxonomy.CATEGORIES`.
        center: (N, 3) float64, metres, box centre in the agent's LiDAR frame.
        size: (N, 3) float64, full length, width, height, metres.
        yaw: (N,) float64, radians about z in the LiDAR frame.
        velocity: (N, 2) float64, m/s, as the label says; NaN where the label's is NaN, infinite or beyond 1e9. The
            world's, turned once more by `yaw` (`world_from_label_velocity`).
        actor_id: (N,) int64; −100 the recording agent, −1 untracked, from 20000 on parked.
        num_lidar_pts: (N,) int64.
        camera_visible: (N,) bool.
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
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, field.name, readonly(value))

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.center)

    def boxes(self) -> Boxes:
        """The boxes in the LiDAR frame, with the label's velocity; right-handed, whatever `raw` was."""
        sign = conventions.flip_yaw if self.raw else np.asarray
        center, velocity = self.center, self.velocity
        if self.raw:
            center, velocity = conventions.flip_points(center), conventions.flip_vectors2(velocity)
        return Boxes(
            frame="lidar",
            center=center,
            size=self.size,
            rotation=quaternions.from_yaw(sign(self.yaw)),
            velocity=np.column_stack([velocity, np.zeros(len(self))]),
            category=self.category,
            actor_id=self.actor_id,
            num_lidar_pts=self.num_lidar_pts,
            camera_visible=self.camera_visible,
            row=np.concatenate([np.arange(count) for count in self.num_boxes] or [np.zeros(0)]),
        )


def read_label(path: ReleasePath, *, raw: bool = False) -> Labels:
    """One label file; see `read_labels`."""
    return read_labels([path], raw=raw)


def read_labels(paths: Sequence[ReleasePath], *, raw: bool = False) -> Labels:
    """The boxes of several label files.

    Lines with one token or none are skipped (`read_lone_words` tells them), blanks at line ends and CRLF are read, a
    file with only line 1 is valid.

    Args:
        paths: the files.
        raw: keep CARLA's left-handed values.

    Raises:
        MissingFileError: a file is not there.
        LabelError: a file is truncated or too large, or a line has another number of fields, a word where a number
            belongs, an unknown class, NaN, infinity or more than 1e9 in a position, size or yaw; the message names file
            and line.
    """
    batches = [
        paths[start : start + _FILES_A_CALL] for start in range(0, len(paths), _FILES_A_CALL)
    ]
    parts = _parse_batches(batches or [[]])
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not raw:
        columns["agent_velocity"] = conventions.flip_vectors2(columns["agent_velocity"])
        columns["center"] = conventions.flip_points(columns["center"])
        columns["velocity"] = conventions.flip_vectors2(columns["velocity"])
        columns["yaw"] = conventions.flip_yaw(columns["yaw"])
    return Labels(raw=raw, **columns)


def read_lone_words(path: ReleasePath) -> list[tuple[int, str, bool]]:
    """The lines of a label that are skipped since they have one word: number, word, whether the file ends within it.

    Raises as `read_label` does, if the file cannot be read.
    """
    lines = _content(path, ended=False).splitlines(keepends=True)
    return [
        (number, shortened(words[0].decode(errors="replace")), not line.endswith((b"\n", b"\r")))
        for number, line in enumerate(lines, start=1)
        if len(words := line.split(maxsplit=1)) == 1
    ]


def write_label(path: Path, labels: Labels) -> None:
    """Write one file's boxes with CARLA's signs; reading it back gives equal values. The last line has no end.

    Raises:
        LabelError: `labels` are not those of one file.
    """
    if len(labels.num_boxes) != 1:
        raise LabelError(f"{path}: expected the labels of one file, found {len(labels.num_boxes)}")
    flip = 1.0 if labels.raw else -1.0
    signs = np.array([1, flip, 1, 1, 1, 1, flip, 1, flip])
    numbers = (
        np.column_stack([labels.center, labels.size, labels.yaw, labels.velocity]) * signs + 0.0
    )
    speed = labels.agent_velocity[0] * (1.0, flip) + 0.0  # + 0.0: no negative zeros
    lines = [_words(speed.tolist())]
    rows = zip(
        labels.category.tolist(),
        numbers.tolist(),
        labels.actor_id.tolist(),
        labels.num_lidar_pts.tolist(),
        labels.camera_visible.tolist(),
        strict=True,
    )
    lines += [
        f"{CATEGORIES[code]} {_words(row)} {actor} {points} {seen}"
        for code, row, actor, points, seen in rows
    ]
    write_bytes(path, "\n".join(lines).encode("ascii"))


def _words(numbers: Iterable[float]) -> str:
    return " ".join(map(repr, numbers))


def _parse_batches(batches: Sequence[Sequence[ReleasePath]]) -> list[dict[str, AnyArray]]:
    """Parse every batch: of several, this thread reads files while other threads parse."""
    if len(batches) < 2:
        return [_parse_files(batch, [_content(path) for path in batch]) for batch in batches]
    from concurrent.futures import ThreadPoolExecutor

    import pyarrow as pa  # noqa: F401 - here: pyarrow 25.0.0 crashes after the thread has ended that imports it

    with ThreadPoolExecutor(min(_MOST_THREADS, usable_cores())) as pool:
        parts = [
            pool.submit(_parse_files, batch, [_content(path) for path in batch])
            for batch in batches
        ]
        return [part.result() for part in parts]


def _parse_files(paths: Sequence[ReleasePath], contents: Sequence[bytes]) -> dict[str, AnyArray]:
    parsed = _parse_joined(contents)
    if parsed is None and not any(b"\0" in content for content in contents):
        parsed = _parse_joined([_tidied(content) for content in contents])
    if parsed is None or _has_fault(parsed):
        raise _first_fault(paths, contents)
    return parsed


def _content(path: ReleasePath, *, ended: bool = True) -> bytes:
    """A file's bytes, of not too many lines, ending in a line end if `ended`."""
    content = read_content(path, "label", LabelError, _REMEDY).removeprefix(codecs.BOM_UTF8)
    lines = max(content.count(b"\n"), content.count(b"\r"))
    if lines > (most := byte_limit("label") // _BYTES_A_LINE):
        sound = f"if it is sound, set {LIMITS_VARIABLE}=label={_BYTES_A_LINE * lines}"
        raise LabelError(f"{path}: has {lines:,} lines, more than {most:,}; {sound}; {_REMEDY}")
    return content if content.endswith(b"\n") or not ended else content + b"\n"


def _parse_joined(contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
    """Parse files that end in a line end; None where they need tidying or hold a fault."""
    import pyarrow as pa

    body_starts = [content.index(b"\n") + 1 for content in contents]
    header = b"".join(
        [content[:start] for content, start in zip(contents, body_starts, strict=True)]
    )
    body = b"".join(
        [memoryview(content)[start:] for content, start in zip(contents, body_starts, strict=True)]
    )
    if b"x" in body or b"X" in body:  # Arrow reads hexadecimal integers
        return None
    try:
        header_words, words = _columns(header, _HEADER), _columns(body, LABEL_FIELDS)
        if header_words is None or words is None:
            return None
        num_boxes = np.array([content.count(b"\n") - 1 for content in contents], dtype=np.int64)
        return _parse_columns(words, header_words, num_boxes)
    except pa.ArrowInvalid:
        return None


def _columns(content: bytes, names: Sequence[str]) -> dict[str, Any] | None:
    """The words of each column, by its name; None unless each line has that many, with one blank between.

    Not by Arrow's reader of CSV: up to 19 it writes beyond its memory where a line has too many words (apache/arrow
    45497), and it starts a thread for each call.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    characters = np.frombuffer(content, dtype=np.uint8)
    ends = np.flatnonzero((characters == ord(" ")) | (characters == ord("\n")))
    numbers = np.arange(len(ends))
    if not np.array_equal(characters[ends] == ord("\n"), numbers % len(names) == len(names) - 1):
        return None
    buffers = [None, pa.py_buffer(np.append(0, ends + 1)), pa.py_buffer(content)]
    words = pa.Array.from_buffers(pa.large_binary(), len(ends), buffers).cast(pa.large_string())
    words = pc.ascii_rtrim(words, characters=" \n")
    return {name: words.take(pa.array(numbers[at :: len(names)])) for at, name in enumerate(names)}


def _parse_columns(
    words: dict[str, Any], header: dict[str, Any], num_boxes: IntArray
) -> dict[str, AnyArray]:
    """Raises pyarrow.ArrowInvalid for what is none of its kind; an unknown class is −1."""
    import pyarrow as pa
    import pyarrow.compute as pc

    def numbers(columns: dict[str, Any], names: Sequence[str]) -> FloatArray:
        return np.column_stack([columns[name].cast(pa.float64()).to_numpy() for name in names])

    def codes(name: str, known: Sequence[str]) -> AnyArray:
        found = pc.index_in(words[name], value_set=pa.array(known, pa.large_string()))
        return np.asarray(found.fill_null(-1), dtype=np.int8)

    velocity = numbers(words, ("vx", "vy"))
    velocity[~in_range(velocity)] = np.nan
    agent_velocity = numbers(header, _HEADER)
    agent_velocity[~in_range(agent_velocity)] = np.nan
    visible = codes("camera_visible", ("False", "True"))
    if (visible < 0).any():
        raise pa.ArrowInvalid("a boolean is neither False nor True")
    return {
        "num_boxes": num_boxes,
        "agent_velocity": agent_velocity,
        "category": codes("class", CATEGORIES),
        "center": numbers(words, ("x", "y", "z")),
        "size": numbers(words, ("l", "w", "h")),
        "yaw": numbers(words, ("yaw",))[:, 0],
        "velocity": velocity,
        "actor_id": words["id"].cast(pa.int64()).to_numpy(),
        "num_lidar_pts": words["num_lidar_pts"].cast(pa.int64()).to_numpy(),
        "camera_visible": visible == 1,
    }


def _has_fault(columns: dict[str, AnyArray]) -> bool:
    values_good = all(in_range(columns[name]).all() for name in ("center", "size", "yaw"))
    return not values_good or bool((columns["category"] < 0).any())


def _tidied(content: bytes) -> bytes:
    """The same label without blank lines, one-token lines, CRLF and superfluous blanks."""
    lines = (b" ".join(words) for words in map(_split, content.splitlines()) if len(words) > 1)
    return b"\n".join([*lines, b""]) or b"\n"


def _split(line: bytes) -> list[bytes]:
    """The words of a line; of one with too many, the last is all the rest."""
    return line.split(maxsplit=len(LABEL_FIELDS))


def _first_fault(paths: Sequence[ReleasePath], contents: Sequence[bytes]) -> LabelError:
    """Name the first line that is wrong."""
    for path, content in zip(paths, contents, strict=True):
        if (fault := _faulty_line(content)) is not None:
            number, what = fault
            return LabelError(f"{path}:{number}: {what}; {_REMEDY}")
    odd = [
        path
        for path, content in zip(paths, contents, strict=True)
        if _parse_joined([_tidied(content)]) is None
    ]
    return LabelError(
        f"{(odd or paths)[0]}: cannot be parsed, though each line looks right; {_REMEDY}"
    )


def _faulty_line(content: bytes) -> tuple[int, str] | None:
    """The number of the first line that is wrong, and what is."""
    header_seen = False
    for number, line in _suspicious_lines(content.splitlines()):
        if b"\0" in line:
            return number, "holds zero bytes, as a full disk leaves them"
        words = [word.decode("utf-8", errors="replace") for word in _split(line)]
        if len(words) < 2:
            continue
        fault = _line_fault(words) if header_seen else _header_fault(words)
        if fault:
            return number, fault
        header_seen = True
    return None if header_seen else (1, "expected '<speed_x> <speed_y>', found an empty file")


def _suspicious_lines(lines: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """Lines and their numbers, without stretches after the first that are read in bulk and hold no fault."""
    for start in range(0, len(lines), _LINES_A_STEP):
        stretch = lines[start : start + _LINES_A_STEP]
        joined = b"\n".join(stretch)
        parsed = (
            _parse_joined([b"0 0\n" + _tidied(joined)]) if start and b"\0" not in joined else None
        )
        if parsed is None or _has_fault(parsed):
            yield from enumerate(stretch, start=start + 1)


def _header_fault(words: Sequence[str]) -> str | None:
    if len(words) != len(_HEADER):
        return f"expected '<speed_x> <speed_y>', found {_counted(words)} fields: {_quoted(words)}"
    return next(
        (f"{shortened(word)!r} is no number" for word in words if number_of(word) is None), None
    )


def _line_fault(words: Sequence[str]) -> str | None:
    if len(words) != len(LABEL_FIELDS):
        return f"expected {len(LABEL_FIELDS)} fields, found {_counted(words)}: {_quoted(words)}"
    return next(
        (
            fault
            for fault in (
                _field_fault(name, word) for name, word in zip(LABEL_FIELDS, words, strict=True)
            )
            if fault
        ),
        None,
    )


def _field_fault(name: str, word: str) -> str | None:
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


def _counted(words: Sequence[str]) -> str:
    return str(len(words)) if len(words) <= len(LABEL_FIELDS) else f"more than {len(LABEL_FIELDS)}"


def _quoted(words: Sequence[str]) -> str:
    return repr(shortened(" ".join(words)))
