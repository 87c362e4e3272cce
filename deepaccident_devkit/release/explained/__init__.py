"""A file of the release in words: every value with its name, its unit and its frame."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import ReleaseError
from deepaccident_devkit.files import path_of
from deepaccident_devkit.release._content import read_content
from deepaccident_devkit.release.explained.calib import calib_text
from deepaccident_devkit.release.explained.label import label_text
from deepaccident_devkit.release.explained.meta import meta_text
from deepaccident_devkit.release.explained.sensor import sensor_text
from deepaccident_devkit.release.labels import FIELDS
from deepaccident_devkit.taxonomy import CATEGORIES

__all__ = ["Explanation", "explain_file"]

_REMEDY = "give a label or meta file (.txt), a calib file (.pkl), or an array of LiDAR or BEV camera (.npz)"
_NUMBER = re.compile(r"[+-]?[\d.]+(e[+-]?\d+)?|nan", re.ASCII | re.IGNORECASE)
_META_KEY = re.compile(
    r"(colliding agents|agents id|road_type|another_vehicle_spawn_side|(ego|other)_vehicle_direction):"
)
_HEAD = 1 << 16
"""Bytes of a text that show what it is."""
_IMAGES = (b"\xff\xd8\xff", b"\x89PNG")
"""How JPEG and PNG files begin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation(ShortRepr):
    """What a file says.

    Attributes:
        kind: `label`, `meta`, `calib` or `sensor`.
        text: for people, several lines.
        fault: what the file's reader would raise; the text then goes as far as the file can be understood.
    """

    kind: str
    text: str
    fault: ReleaseError | None = None


def explain_file(path: Path, *, rows: int | None = 10) -> Explanation:
    """Say what a label, meta or calib file, a point cloud or a BEV camera's array holds.

    What kind of file it is tells its content, or else its ending and its folder.

    Args:
        path: the file.
        rows: how many boxes of a label to list; None for all.

    Raises:
        MissingFileError: there is no such file.
        ReleaseError: it is of none of these kinds, or so damaged that nothing of it can be said.
    """
    path = path_of(path)
    kind = _kind_of(path, read_content(path, "label", ReleaseError, _REMEDY))
    fault: ReleaseError | None = None
    if kind == "label":
        text, fault = label_text(path, rows)
    elif kind == "meta":
        text = meta_text(path)
    elif kind == "calib":
        text, fault = calib_text(path)
    else:
        text = sensor_text(path)
    return Explanation(kind=kind, text=f"{path}\n{text}", fault=fault)


def _kind_of(path: Path, content: bytes) -> str:
    if content.startswith(_IMAGES):
        raise ReleaseError(f"{path}: is an image, which needs no words; open it in an image viewer, or {_REMEDY}")
    if content.startswith(b"PK") or path.suffix == ".npz":
        return "sensor"
    if content.startswith(b"\x80") or path.suffix == ".pkl":
        return "calib"
    lines = [line.split() for line in content[:_HEAD].decode("utf-8-sig", errors="replace").splitlines()]
    kind = _kind_of_text([words for words in lines if words]) or _kind_of_folder(path)
    if kind is None:
        raise ReleaseError(f"{path}: is no file that can be explained; {_REMEDY}")
    return kind


def _kind_of_text(lines: Sequence[Sequence[str]]) -> str | None:
    """By the first line with more than one word; if that says nothing, by any other line."""
    first = next((words for words in lines if len(words) > 1), [])
    if len(first) == 2 and all(_NUMBER.fullmatch(word) for word in first):
        return "label"
    if any(_META_KEY.match(" ".join(words)) for words in lines) or (len(first) == 9 and first[0] not in CATEGORIES):
        return "meta"
    if any(words[0] in CATEGORIES and len(words) == len(FIELDS) for words in lines):
        return "label"
    return None


def _kind_of_folder(path: Path) -> str | None:
    """Where text is not to be recognised: what its folder is called."""
    if path.suffix != ".txt":
        return None
    if path.parent.name == "meta":
        return "meta"
    return "label" if path.parent.parent.name == "label" else None
