"""Plain readers of the same files: what stands in them by Python, numpy and Pillow alone, without the devkit."""

import io
import json
import pickle
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

LEFT_TO_RIGHT = np.diag([1.0, -1.0, 1.0, 1.0])
_ALLOWED = {
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    *(("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")),
}


def label(path: Path) -> tuple[tuple[float, ...], list[tuple[Any, ...]]]:
    """The first line's speed, and the 13 fields of each box; a line with one word or none counts for nothing."""
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode()
    words = [line.split() for line in content.replace("\r\n", "\n").replace("\r", "\n").split("\n")]
    head, *rows = [line for line in words if len(line) > 1]
    speed = tuple(float(word) for word in head)
    return speed, [
        (row[0], *map(float, row[1:10]), int(row[10]), int(row[11]), {"True": True, "False": False}[row[12]])
        for row in rows
    ]


def meta(path: Path) -> dict[str, Any]:
    """The first line's nine words and the further lines by their keys."""
    lines = path.read_bytes().decode("utf-8-sig").splitlines()
    first, *others = [line.strip() for line in lines if line.strip()]
    words = first.split()
    assert len(words) == 9, words
    return {"first": words, **{key.strip(): text.strip() for key, _, text in (line.partition(":") for line in others)}}


def split_file(path: Path) -> list[str]:
    """The scenarios of a split file."""
    lines = path.read_bytes().decode("utf-8-sig").splitlines()
    return list(dict.fromkeys("/".join(line.split()) for line in lines if line.strip()))


class _Unpickler(pickle.Unpickler):
    """Numpy's own arrays, and nothing else by name."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return super().find_class(module, name)


def calib(path: Path) -> dict[str, Any]:
    """The arrays of a calib file."""
    loaded: dict[str, Any] = _Unpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    return loaded


def array(path: Path, name: str = "data") -> np.ndarray:
    """An array of an `.npz` file, or the only one."""
    with np.load(path, allow_pickle=False) as found:
        return found[name if name in found.files else found.files[0]]


def image(path: Path) -> np.ndarray:
    """The pixels of a JPEG or PNG file."""
    from PIL import Image

    with Image.open(path, formats=("JPEG", "PNG")) as found:
        return np.asarray(found.convert("RGB"))


def json_file(path: Path) -> Any:
    """What a JSON file says."""
    return json.loads(path.read_bytes().decode("utf-8"))


def yaml_file(path: Path) -> Any:
    """What a YAML file says."""
    return yaml.safe_load(path.read_bytes().decode("utf-8"))


def cached_image(path: Path) -> bytes:
    """The first image of a scenario's file in an images cache."""
    content = path.read_bytes()
    begin, size = np.frombuffer(content, "<i8", 2, offset=24)
    return content[begin : begin + size]


def unpack(path: Path, folder: Path) -> None:
    """Write the members of an archive that can be read below a folder, damaged or not; backslashes part folders."""
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            place = folder / entry.filename.replace("\\", "/").lstrip("/")
            if entry.is_dir() or ".." in place.parts:
                continue
            with suppress(zipfile.BadZipFile, OSError), archive.open(entry) as member:
                member._expected_crc = None  # type: ignore[attr-defined]
                content = member.read()
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)
