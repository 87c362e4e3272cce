"""Plain readers of the same files: what stands in them by Python, numpy and Pillow alone, without the devkit."""

import io
import json
import pickle
import zipfile
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


def cached_image(path: Path, agent: int, camera: int, height: int, width: int) -> np.ndarray:
    """The pixels (height, width, 3) of the first frame of an agent, of a file of uncompressed cached images."""
    content = path.read_bytes()
    assert content[:8] == b"DAimages"
    rows, cameras = np.frombuffer(content, "<i8", 2, offset=8).tolist()
    table = np.frombuffer(content, "<i8", rows * cameras * 2, offset=24).reshape(rows, cameras, 2)
    begin, length = table[agent * rows if agent else 0, camera].tolist()
    return np.frombuffer(content[begin : begin + length], np.uint8).reshape(3, height, width).transpose(1, 2, 0)


def unpacked(archive: Path, folder: Path) -> Path:
    """The members of an archive as files, also those whose checksum is another."""
    folder.mkdir(exist_ok=True)
    with zipfile.ZipFile(archive) as opened:
        for entry in opened.infolist():
            if entry.is_dir() or any(part == ".." or len(part) > 255 for part in entry.filename.split("/")):
                continue
            target = folder / entry.filename.lstrip("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            with opened.open(entry) as file:
                file._expected_crc = None  # type: ignore[attr-defined]
                target.write_bytes(file.read())
    return folder


_NUMPY = {"BF16": "<u2", "BOOL": "?", **{f"{kind}{8 * size}": f"<{kind.lower()}{size}" for kind in "IFU" for size in (1, 2, 4, 8)}}


def safetensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The tensors of a safetensors file, and the notes of the devkit."""
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    notes = header.pop("__metadata__", {}).get("deepaccident", "{}")
    tensors = {}
    for name, told in header.items():
        begin, end = told["data_offsets"]
        flat = np.frombuffer(content[8 + length + begin : 8 + length + end], _NUMPY[told["dtype"]])
        wide = (flat.astype("<u4") << 16).view("<f4") if told["dtype"] == "BF16" else flat
        tensors[name] = wide.reshape(told["shape"])
    return tensors, json.loads(notes)


def checkpoint(path: Path) -> dict[str, Any]:
    """The tensors of a checkpoint, by PyTorch itself, which runs no code of it."""
    import torch

    found = torch.load(path, map_location="cpu", weights_only=True)
    for name in ("state_dict", "model"):
        if isinstance(found.get(name), dict):
            found = found[name]
    return {name: each for name, each in found.items() if isinstance(each, torch.Tensor)}
