"""Plain readers of the same files: what stands in them by Python, numpy and Pillow alone, without
the devkit.
"""

import io
import json
import pickle
import re
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import yaml

LEFT_TO_RIGHT = np.diag([1.0, -1.0, 1.0, 1.0])
_LARGE = 64 << 20
_OF_RELEASE = re.compile(
    r"(?<![^/])(type\d+_subtype\d+_(accident|normal)/(meta|[a-z_]+/(label|calib))/.*\.(txt|pkl)|[a-z_]+\.txt)$"
)
"""The part of a path that is of a release without sensors."""
_ALLOWED = {
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    *(("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")),
}


def label(path: Path) -> tuple[tuple[float, ...], list[tuple[Any, ...]]]:
    """The first line's speed, and the 13 fields of each box; a line with one word or none counts
    for nothing.
    """
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode()
    words = [line.split() for line in content.replace("\r\n", "\n").replace("\r", "\n").split("\n")]
    head, *rows = [line for line in words if len(line) > 1]
    speed = tuple(float(word) for word in head)
    return speed, [
        (
            row[0],
            *map(float, row[1:10]),
            int(row[10]),
            int(row[11]),
            {"True": True, "False": False}[row[12]],
        )
        for row in rows
    ]


def meta(path: Path) -> dict[str, Any]:
    """The first line's nine words and the further lines by their keys."""
    lines = path.read_bytes().decode("utf-8-sig", errors="surrogateescape").splitlines()
    first, *others = [line.strip() for line in lines if line.strip()]
    words = first.split()
    assert len(words) == 9, words
    return {
        "first": words,
        **{key.strip(): text.strip() for key, _, text in (line.partition(":") for line in others)},
    }


def split_file(path: Path) -> list[str]:
    """The scenarios of a split file, whose bytes that are not UTF-8 are those of file names."""
    lines = path.read_bytes().decode("utf-8-sig", errors="surrogateescape").splitlines()
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
    """The pixels (height, width, 3) of the first frame of an agent, of a file of uncompressed
    cached images.
    """
    content = path.read_bytes()
    assert content[:8] == b"DAimages"
    rows, cameras = np.frombuffer(content, "<i8", 2, offset=8).tolist()
    table = np.frombuffer(content, "<i8", rows * cameras * 2, offset=24).reshape(rows, cameras, 2)
    begin, length = table[agent * rows if agent else 0, camera].tolist()
    return (
        np.frombuffer(content[begin : begin + length], np.uint8)
        .reshape(3, height, width)
        .transpose(1, 2, 0)
    )


def members(archive: Path) -> dict[str, tuple[bytes, bool]]:
    """Path in a release → the bytes of an archive's member, and whether its checksum is right;
    empty if none come out.

    Which folders lead to the release does not matter, nor what the member's own head says.
    """
    content, found = archive.read_bytes(), {}
    with zipfile.ZipFile(archive) as opened:
        entries = opened.infolist()
    for entry in entries:
        inside = _OF_RELEASE.search(str(PurePosixPath(entry.filename.replace("\\", "/"))))
        if inside is None:
            continue
        begin = (
            entry.header_offset
            + 30
            + sum(struct.unpack_from("<HH", content, entry.header_offset + 26))
        )
        stored = content[begin : begin + entry.compress_size]
        try:
            if entry.compress_type != zipfile.ZIP_STORED:
                stored = zlib.decompressobj(-zlib.MAX_WBITS).decompress(
                    stored, min(entry.file_size, _LARGE) + 1
                )
            member = stored if entry.file_size < _LARGE else b""
        except zlib.error:
            member = b""
        found[inside[0]] = (
            member,
            zlib.crc32(member) == entry.CRC and len(member) == entry.file_size,
        )
    return found


def unpacked(archive: Path, folder: Path) -> Path:
    """The files of a release in an archive, also those whose checksum is another."""
    for name, (member, _) in members(archive).items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(member)
    return folder


_NUMPY = {
    "BF16": "<u2",
    "BOOL": "?",
    **{f"{kind}{8 * size}": f"<{kind.lower()}{size}" for kind in "IFU" for size in (1, 2, 4, 8)},
}


Flat = tuple[tuple[int, ...], np.ndarray]
"""The shape of a tensor, and its numbers one after the other: numpy has no more than 64 dimensions.
"""


def safetensors(path: Path) -> tuple[dict[str, Flat], dict[str, Any]]:
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
        tensors[name] = tuple(told["shape"]), wide
    return tensors, json.loads(notes)


def checkpoint(path: Path) -> dict[str, Flat]:
    """The tensors of a checkpoint, by PyTorch itself, which runs no code of it; numpy's numbers may
    be beside them.
    """
    import torch

    numpy = (
        np.float64(1).__reduce__()[0],
        np.zeros(1).__reduce__()[0],
        np.ndarray,
        np.dtype,
        type(np.dtype("f8")),
    )
    with torch.serialization.safe_globals([*numpy, type(np.dtype("f4"))]):
        found = torch.load(path, map_location="cpu", weights_only=True)
    for name in ("state_dict", "model"):
        if isinstance(found.get(name), dict):
            found = found[name]
    return {name: flat(each) for name, each in found.items() if isinstance(each, torch.Tensor)}


def flat(tensor: Any) -> Flat:
    """A tensor of PyTorch."""
    wide = tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor
    return tuple(tensor.shape), wide.detach().reshape(-1).numpy()
