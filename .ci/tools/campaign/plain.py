"""Plain readers of the same files, with only Python, numpy and Pillow and without the devkit."""

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
NUSCENES_SIZE_ORDER = (1, 0, 2)
"""Positions of length, width and height in a size of nuScenes."""
LabelRow = tuple[Any, ...]
"""The 13 fields of a box in a label file."""
FlatTensor = tuple[tuple[int, ...], np.ndarray]
"""The shape of a tensor and its flattened numbers, as numpy has at most 64 dimensions."""
_MAX_MEMBER_BYTES = 64 << 20
_RELEASE_PATH = re.compile(
    r"(?<![^/])(type\d+_subtype\d+_(accident|normal)/(meta|[a-z_]+/(label|calib))/.*\.(txt|pkl)|[a-z_]+\.txt)$"
)
"""The part of a path that belongs to a release without sensors."""
_LOCAL_HEADER_BYTES = 30
"""Length of a zip member's own header without its name and extra field."""
_IMAGES_HEADER_BYTES = 24
_ALLOWED_GLOBALS = {
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    *(("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")),
}
_NUMPY_DTYPES = {
    "BF16": "<u2",
    "BOOL": "?",
    **{f"{kind}{8 * size}": f"<{kind.lower()}{size}" for kind in "IFU" for size in (1, 2, 4, 8)},
}
"""numpy's data types by their names in safetensors files."""


def read_label(path: Path) -> tuple[tuple[float, ...], list[LabelRow]]:
    """Return the speed of the first line and the 13 fields of each box.

    Lines with fewer than two words are skipped.
    """
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf").decode()
    lines = content.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    words_of_lines = [line.split() for line in lines]
    head, *rows = [words for words in words_of_lines if len(words) > 1]
    speed = tuple(float(word) for word in head)
    boxes = []
    for row in rows:
        assert len(row) >= 13, row
        category, *numbers, actor_id, point_count, visible = row[:13]
        is_visible = {"True": True, "False": False}[visible]
        boxes.append((category, *map(float, numbers), int(actor_id), int(point_count), is_visible))
    return speed, boxes


def read_meta(path: Path) -> dict[str, Any]:
    """Return the nine words of the first line, and the texts of the other lines by their keys."""
    lines = path.read_bytes().decode("utf-8-sig", errors="surrogateescape").splitlines()
    first, *other_lines = [line.strip() for line in lines if line.strip()]
    words = first.split()
    assert len(words) == 9, words
    meta: dict[str, Any] = {"first": words}
    for line in other_lines:
        key, _, text = line.partition(":")
        meta[key.strip()] = text.strip()
    return meta


def read_split(path: Path) -> list[str]:
    """Return the scenarios of a split file; bytes that are not UTF-8 become surrogates."""
    lines = path.read_bytes().decode("utf-8-sig", errors="surrogateescape").splitlines()
    scenarios = ["/".join(line.split()) for line in lines if line.strip()]
    return list(dict.fromkeys(scenarios))


class _Unpickler(pickle.Unpickler):
    """Unpickler that loads numpy's arrays and no other classes or functions."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED_GLOBALS:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return super().find_class(module, name)


def read_calib(path: Path) -> dict[str, Any]:
    """Return the arrays of a calib file."""
    arrays: dict[str, Any] = _Unpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    return arrays


def read_array(path: Path, name: str = "data") -> np.ndarray:
    """Return an array of an `.npz` file by its name, or the first one if there is no such name."""
    with np.load(path, allow_pickle=False) as arrays:
        return arrays[name if name in arrays.files else arrays.files[0]]


def read_image(path: Path) -> np.ndarray:
    """Return the pixels of a JPEG or PNG file, shape (H, W, 3), uint8 RGB."""
    from PIL import Image

    with Image.open(path, formats=("JPEG", "PNG")) as image:
        return np.asarray(image.convert("RGB"))


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(path.read_bytes().decode("utf-8"))


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file."""
    return yaml.safe_load(path.read_bytes().decode("utf-8"))


def read_cached_image(path: Path, agent: int, camera: int, height: int, width: int) -> np.ndarray:
    """Return an agent's first frame in a file of uncompressed cached images.

    Args:
        path: File of cached images.
        agent: Position of the agent in the cache's settings.
        camera: Position of the camera in the cache's settings.
        height: Height of the image in pixels.
        width: Width of the image in pixels.

    Returns:
        Pixels, shape (height, width, 3), uint8.
    """
    content = path.read_bytes()
    assert content[:8] == b"DAimages"
    rows, cameras = np.frombuffer(content, "<i8", 2, offset=8).tolist()
    numbers = np.frombuffer(content, "<i8", rows * cameras * 2, offset=_IMAGES_HEADER_BYTES)
    table = numbers.reshape(rows, cameras, 2)
    begin, length = table[agent * rows if agent else 0, camera].tolist()
    pixels = np.frombuffer(content[begin : begin + length], np.uint8)
    return pixels.reshape(3, height, width).transpose(1, 2, 0)


def read_members(archive: Path) -> dict[str, tuple[bytes, bool]]:
    """Return an archive's members by their paths in a release.

    It does not matter which folders lead to the release, nor what the members' own headers hold.

    Returns:
        For each path, the bytes of the member, and whether its checksum and size are right. The
        bytes are empty if the member cannot be unpacked.
    """
    content = archive.read_bytes()
    members = {}
    with zipfile.ZipFile(archive) as zip_file:
        entries = zip_file.infolist()
    for entry in entries:
        path = PurePosixPath(entry.filename.replace("\\", "/"))
        match = _RELEASE_PATH.search(str(path))
        if match is not None:
            member = _read_member(content, entry)
            is_right_checksum = zlib.crc32(member) == entry.CRC
            members[match[0]] = (member, is_right_checksum and len(member) == entry.file_size)
    return members


def _read_member(content: bytes, entry: zipfile.ZipInfo) -> bytes:
    """Return the bytes of an archive's member; empty if it is damaged or too large."""
    lengths = struct.unpack_from("<HH", content, entry.header_offset + 26)
    begin = entry.header_offset + _LOCAL_HEADER_BYTES + sum(lengths)
    member = content[begin : begin + entry.compress_size]
    if entry.compress_type != zipfile.ZIP_STORED:
        limit = min(entry.file_size, _MAX_MEMBER_BYTES) + 1
        try:
            member = zlib.decompressobj(-zlib.MAX_WBITS).decompress(member, limit)
        except zlib.error:
            return b""
    if entry.file_size < _MAX_MEMBER_BYTES:
        return member
    return b""


def unpack(archive: Path, folder: Path) -> Path:
    """Unpack the files of a release, including members with a wrong checksum; return the folder."""
    for name, (member, _) in read_members(archive).items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(member)
    return folder


def read_safetensors(path: Path) -> tuple[dict[str, FlatTensor], dict[str, Any]]:
    """Return the tensors of a safetensors file, and the notes that the devkit wrote into it."""
    content = path.read_bytes()
    data_begin = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:data_begin])
    data = content[data_begin:]
    notes = header.pop("__metadata__", {}).get("deepaccident", "{}")
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        numbers = np.frombuffer(data[begin:end], _NUMPY_DTYPES[entry["dtype"]])
        if entry["dtype"] == "BF16":
            numbers = (numbers.astype("<u4") << 16).view("<f4")
        tensors[name] = tuple(entry["shape"]), numbers
    return tensors, json.loads(notes)


def read_checkpoint(path: Path) -> dict[str, FlatTensor]:
    """Return the tensors of a checkpoint, read by PyTorch itself without running its code.

    The checkpoint may also hold numbers and arrays of numpy.
    """
    import torch

    numpy_globals: list[Any] = [
        np.float64(1).__reduce__()[0],
        np.zeros(1).__reduce__()[0],
        np.ndarray,
        np.dtype,
        type(np.dtype("f8")),
        type(np.dtype("f4")),
    ]
    with torch.serialization.safe_globals(numpy_globals):
        state = torch.load(path, map_location="cpu", weights_only=True)
    for name in ("state_dict", "model"):
        if isinstance(state.get(name), dict):
            state = state[name]
    tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
    return {name: flatten(tensor) for name, tensor in tensors.items()}


def flatten(tensor: Any) -> FlatTensor:
    """Return the shape and the flattened numbers of a tensor of PyTorch."""
    shape = tuple(tensor.shape)
    if str(tensor.dtype) == "torch.bfloat16":
        tensor = tensor.float()
    return shape, tensor.detach().reshape(-1).numpy()
