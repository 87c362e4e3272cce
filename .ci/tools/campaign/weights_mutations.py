"""Mutations of files of weights: headers, storages, shapes, names and pickles.

Some of them need PyTorch.
"""

import io
import json
import pickletools
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from fault_injection.mutations.calib import Bomb

from campaign.mutations import (
    MARKER,
    ODD_NAMES,
    JsonObject,
    Rng,
    choose,
    choose_index,
    content_mutation,
    pack_archive,
    path_mutation,
    read_members,
    replace_bytes,
    replace_file,
)

StateDict = dict[str, Any]
"""Tensors of a network by their names."""
_TORCH = ("pt", "pth")
_HUGE_SIZE_BYTES = 6 << 30
_LONG_TEXT_BYTES = 5_000_000
_OLD_STATE_POSITION = 3
"""Position of the state's pickle in an old file, after a number, a version and the machine."""


# ---- safetensors: the length of the JSON header, the header, and the bytes of all tensors


def _read_header(content: bytes) -> tuple[JsonObject, bytes]:
    """Return the header of a safetensors file, and the bytes of its tensors."""
    length = int.from_bytes(content[:8], "little")
    header: JsonObject = json.loads(content[8 : 8 + length])
    return header, content[8 + length :]


def _write_header(header: Any, data: bytes) -> bytes:
    """Return a safetensors file of a header and the bytes of its tensors."""
    text = json.dumps(header).encode("utf-8", "surrogatepass")
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data


def _choose_tensor(header: JsonObject, rng: Rng) -> str:
    """Return the name of a tensor at random."""
    tensor_name: str = choose(rng, _tensor_names(header))
    return tensor_name


def _tensor_names(header: JsonObject) -> list[str]:
    return [name for name in header if name != "__metadata__"]


def _find_data_end(header: JsonObject) -> int:
    """Return the position after the bytes of the last tensor."""
    return max(header[name]["data_offsets"][1] for name in _tensor_names(header))


def _read_notes(header: JsonObject) -> JsonObject:
    """Return the notes that the devkit wrote into a header."""
    notes: JsonObject = json.loads(header["__metadata__"]["deepaccident"])
    return notes


@content_mutation("numbers", "safetensors")
def header_of_another_length(content: bytes, rng: Rng) -> bytes:
    length = int.from_bytes(content[:8], "little")
    lengths = (
        0,
        1,
        length - 1,
        length + 1,
        length + 8,
        len(content),
        100_000_001,
        1 << 40,
        (1 << 63) - 1,
        (1 << 64) - 1,
    )
    return struct.pack("<Q", choose(rng, lengths)) + content[8:]


@content_mutation("numbers", "safetensors")
def tensor_of_another_size(content: bytes, rng: Rng) -> bytes:
    """Change the shape of a tensor, or the place of its bytes."""
    header, data = _read_header(content)
    values = (
        0,
        1,
        -1,
        1 << 32,
        1 << 62,
        (1 << 64) - 1,
        1.5,
        "1",
        None,
        True,
        len(data),
        len(data) + 1,
    )
    tensor = header[_choose_tensor(header, rng)]
    numbers = tensor[choose(rng, ("shape", "data_offsets"))]
    if numbers and rng.integers(3):
        value = choose(rng, values)
        numbers[choose_index(rng, numbers)] = value
    else:
        numbers += choose(rng, ([1], [0], [1] * 100, [1 << 31, 1 << 31], [[1]]))
    return _write_header(header, data)


@content_mutation("numbers", "safetensors")
def numbers_of_a_tensor_are_odd(content: bytes, rng: Rng) -> bytes:
    """Set all numbers of a tensor to NaN, infinity, or a huge, negative or tiny number."""
    header, data = _read_header(content)
    begin, end = header[_choose_tensor(header, rng)]["data_offsets"]
    number = np.float32(choose(rng, (np.nan, np.inf, 3e38, -1, 1e-45)))
    count = (end - begin) // number.nbytes + 1
    filled = (number.tobytes() * count)[: end - begin]
    return _write_header(header, replace_bytes(data, begin, end, filled))


@content_mutation("types", "safetensors")
def tensor_of_another_dtype(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    tensor = header[_choose_tensor(header, rng)]
    begin, end = tensor["data_offsets"]
    bytes_by_dtype = {
        "F64": 8,
        "I64": 8,
        "U64": 8,
        "C64": 8,
        "I32": 4,
        "F16": 2,
        "BF16": 2,
        "BOOL": 1,
        "F8_E4M3": 1,
        "U8": 1,
        "F4": 1,
    }
    dtype = choose(rng, list(bytes_by_dtype))
    tensor["dtype"] = choose(rng, (dtype, dtype, "F32", "X", "", 1, None, "f32"))
    if rng.integers(2):
        tensor["shape"] = [(end - begin) // bytes_by_dtype[dtype]]
    return _write_header(header, data)


@content_mutation("types", "safetensors")
def header_of_other_values(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    values = (None, True, 1, -1.5, "", "x", [], {}, [[]], {"a": 1}, {"dtype": "F32"}, float("nan"))
    if rng.integers(4) == 0:
        return _write_header(choose(rng, values), data)
    mapping = choose(rng, (header, header[_choose_tensor(header, rng)]))
    value = choose(rng, values)
    mapping[choose(rng, (*mapping, "another"))] = value
    return _write_header(header, data)


@content_mutation("types", "safetensors")
def tensor_lost_or_added(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    end = _find_data_end(header)
    names = (
        "another",
        "optimizer.0.exp_avg",
        "optimizer.x.step",
        "optimizer.",
        "optimizer.99999999.step",
    )
    name = choose(rng, names)
    if rng.integers(2):
        header[name] = {"dtype": "F32", "shape": [4], "data_offsets": [end, end + 16]}
        return _write_header(header, data + bytes(16))
    lost_tensor = header.pop(_choose_tensor(header, rng))
    tensor_begin, tensor_end = lost_tensor["data_offsets"]
    if tensor_end == end:
        data = data[:tensor_begin]
    elif rng.integers(2):
        header["another"] = lost_tensor
    return _write_header(header, data)


@content_mutation("types", "safetensors")
def notes_of_other_values(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    notes = _read_notes(header)
    values = (
        None,
        True,
        -1,
        1 << 70,
        1.5,
        "",
        "x",
        [],
        {},
        [1],
        {"a": 1},
        float("nan"),
        "tiny",
        "\ud800",
    )
    value = choose(rng, values)
    notes[choose(rng, (*notes, "step", "best", "preset", "another"))] = value
    text = json.dumps(notes)
    texts = (text, text, text, "", "[]", "null", "x", "{" * 5000, "[" * 200_000)
    first = {"deepaccident": choose(rng, texts)}
    second = {"deepaccident": choose(rng, texts)}
    header["__metadata__"] = choose(rng, (first, second, {}, {"deepaccident": {}}, "x"))
    return _write_header(header, data)


@content_mutation("bombs", "safetensors")
def header_of_many_tensors(content: bytes, rng: Rng) -> bytes:
    """Add 50,000 empty tensors or one of a huge shape without data, or return a deep header."""
    header, data = _read_header(content)
    end = _find_data_end(header)
    choice = rng.integers(3)
    if choice == 0:
        for number in range(50_000):
            header[f"{number}"] = {"dtype": "F32", "shape": [0], "data_offsets": [end, end]}
        return _write_header(header, data)
    if choice == 1:
        shapes = ([0, 1 << 40], [1 << 40, 0], [1 << 31, 1 << 31, 0], [0] * 10_000, [1] * 100_000)
        shape = choose(rng, shapes)
        header["another"] = {"dtype": "F32", "shape": shape, "data_offsets": [end, end]}
        return _write_header(header, data)
    text = b'{"a": ' + b"[" * choose(rng, (5000, 200_000))
    return struct.pack("<Q", len(text)) + text + data


@content_mutation("bombs", "safetensors")
def notes_of_5_mb(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    notes = _read_notes(header)
    text = choose(rng, ("x", "\x1b[2J", "\u202e")) * (_LONG_TEXT_BYTES // 4)
    notes[choose(rng, (*notes, "preset", "step", text))] = text
    header["__metadata__"]["deepaccident"] = json.dumps(notes)
    return _write_header(header, data)


@content_mutation("names", "safetensors")
def tensor_with_another_name(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    names = (
        "",
        "0",
        "__metadata__ ",
        "module.",
        "optimizer.x",
        "\x1b[2J" * 1_000_000,
        "x" * _LONG_TEXT_BYTES,
        "\u202e" * 1000,
        "a\0b",
        "..",
        *ODD_NAMES,
    )
    tensor = header.pop(_choose_tensor(header, rng))
    header[choose(rng, names)] = tensor
    return _write_header(header, data)


@content_mutation("names", "safetensors")
def notes_with_odd_names(content: bytes, rng: Rng) -> bytes:
    header, data = _read_header(content)
    notes = _read_notes(header)
    name = choose(rng, ODD_NAMES)
    notes[choose(rng, (*notes, "preset", "fusion", *ODD_NAMES))] = name
    header["__metadata__"]["deepaccident"] = json.dumps(notes)
    return _write_header(header, data)


# ---- checkpoints of PyTorch: a pickle of the state and the storages, in a zip or in sequence


@path_mutation("types", *_TORCH)
def checkpoint_runs_code(path: Path, rng: Rng) -> None:
    def change(state: StateDict) -> Any:
        state[choose(rng, ("another", *state))] = Bomb(path.parent / MARKER)
        return state

    _save_changed(path, change)


@path_mutation("types", *_TORCH)
def checkpoint_of_odd_tensors(path: Path, rng: Rng) -> None:
    """Replace a tensor by a view, a sparse, quantised or empty one, another type, or no tensor."""
    import torch

    def change(state: StateDict) -> Any:
        name = choose(rng, list(state))
        tensor = state[name].float() if state[name].ndim else torch.ones(3)
        dtypes = (
            torch.float64,
            torch.float16,
            torch.bfloat16,
            torch.int64,
            torch.int8,
            torch.bool,
            torch.complex64,
        )
        options: tuple[Callable[[], Any], ...] = (
            *(lambda dtype=dtype: tensor.to(dtype) for dtype in dtypes),
            lambda: tensor.to("meta"),
            tensor.to_sparse,
            lambda: torch.quantize_per_tensor(tensor, 0.1, 0, torch.qint8),
            lambda: torch.nn.Parameter(tensor),
            lambda: tensor.transpose(0, -1),
            lambda: tensor[:0],
            tensor.numpy,
            tensor.tolist,
            lambda: np.float64(1),
            lambda: {"state_dict": tensor},
            lambda: torch.nn.Linear(2, 2),
            lambda: torch.device("cpu"),
            lambda: None,
        )
        make_value = choose(rng, options)
        state[name] = make_value()
        return state

    _save_changed(path, change)


@path_mutation("types", *_TORCH)
def checkpoint_of_other_things(path: Path, rng: Rng) -> None:
    """Save something that is no state dict, is nested deeper, or has keys that are no texts."""
    import torch

    changes: tuple[Callable[[StateDict], Any], ...] = (
        lambda state: {"state_dict": state},
        lambda state: {
            "model": OrderedDict(state),
            "optimizer": {"state": {0: torch.ones(2)}},
            "epoch": 3,
        },
        lambda state: {f"module.{name}": tensor for name, tensor in state.items()},
        lambda state: dict(enumerate(state.values())),
        lambda state: {**state, 0: torch.ones(1), None: 1, (1, 2): torch.ones(1)},
        lambda state: list(state.values()),
        lambda state: next(iter(state.values())),
        lambda state: {"state_dict": {"state_dict": state}},
        lambda state: {**state, "self": [state]},
        lambda _state: torch.nn.Linear(2, 2),
        lambda _state: {},
        lambda _state: 7,
    )
    _save_changed(path, choose(rng, changes))


@path_mutation("bombs", *_TORCH)
def tensor_of_stride_0(path: Path, rng: Rng) -> None:
    """Replace a tensor by a view of gigabytes of one number, or add many such views."""
    import torch

    def change(state: StateDict) -> Any:
        name = choose(rng, list(state))
        tensor = torch.zeros(1)
        if rng.integers(2):
            state[name] = tensor.expand(choose(rng, (1 << 29, 1 << 31, 1 << 40)))
        else:
            for number in range(100):
                state[f"{name}.{number}"] = tensor.expand(1 << 24)
        return state

    _save_changed(path, change)


@path_mutation("bombs", *_TORCH)
def checkpoint_of_many_tensors(path: Path, rng: Rng) -> None:
    """Add 20,000 views of one storage, or nest the state in 200 dictionaries."""
    import torch

    def change(state: StateDict) -> Any:
        if rng.integers(2):
            tensor = torch.zeros(4)
            return state | {f"{number}": tensor[:1] for number in range(20_000)}
        nested: Any = state
        for _ in range(200):
            nested = {"state_dict": nested}
        return nested

    _save_changed(path, change)


@content_mutation("bombs", *_TORCH)
def pickle_of_gigabytes(content: bytes, rng: Rng) -> bytes:
    """Replace the pickle by a few bytes that request 6 GB, or endless time."""
    size = b"\x8a\5" + _HUGE_SIZE_BYTES.to_bytes(5, "little")
    calls = (
        b"c__builtin__\nbytearray\n" + size + b"\x85R.",
        b"cbuiltins\nbytearray\n(" + size + b"tR.",
        b"c_codecs\nencode\n(X\1\0\0\0xX\6\0\0\0latin1tR" + b"2" * 1000 + b".",
        b"ccollections\nOrderedDict\n)R" + b"2" * 1_000_000 + b".",
        b"]" + b"q\0" + b"".join(b"0]h%ch%c\x86q%c" % (n, n, n + 1) for n in range(60)) + b".",
        b")" + b"\x85" * 1_000_000 + b".",
        b"(" * 1_000_000 + b"t" * 1_000_000 + b".",
        b"Nr\xff\xff\xff\x7f.",
        b"Np999999999\n.",
        b"L" + b"9" * 2_000_000 + b"L\n.",
        b"ctorch\nzeros\n" + size + b"\x85R.",
        b"ctorch\nempty\n" + size + b"\x85R.",
        b"ctorch._utils\n_rebuild_tensor\n(N" + size + b"(tttR.",
        b"ctorch.storage\nUntypedStorage\n" + size + b"\x85R.",
        b"ctorch\nFloatStorage\n" + size + b"\x85R.",
        b"N" * 5_000_000 + b".",
    )
    return _edit_pickle(content, lambda _: b"\x80\2" + choose(rng, calls))


@content_mutation("types", *_TORCH)
def checkpoint_asks_for_a_name(content: bytes, rng: Rng) -> bytes:
    names = (
        b"os\nsystem",
        b"builtins\neval",
        b"torch\nload",
        b"torch.hub\nload",
        b"numpy\nfromfile",
        b"posix\nfork",
        b"a.b\nc.d",
        b"\n",
        b"torch.serialization\nload",
        b"torch._utils\n_rebuild_parameter",
        b"torch.jit\nload",
        b"\x1b[31m\n\xe2\x80\xae",
    )
    ends = (b"(X\2\0\0\0lstR.", b".", b"(tR.", b"}b.", b")\x81.", b"X\2\0\0\0lsQ.", b"0")
    end = choose(rng, ends)
    name = choose(rng, names)

    def change(pickled: bytes) -> bytes:
        rest = pickled[2:] if end == b"0" else b""
        return b"\x80\2c" + name + b"\n" + end + rest

    return _edit_pickle(content, change)


@content_mutation("numbers", *_TORCH)
def number_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    """Change an offset, a size, a stride or the length of a storage."""
    numbers = (0, 1, 2, 255, 1 << 16, 1 << 31, 1 << 40, (1 << 63) - 1, 1 << 70, -1, -(1 << 40))

    def change(pickled: bytes) -> bytes:
        number = choose(rng, numbers)
        length = max((number.bit_length() + 8) // 8, 1)
        instruction = b"\x8a%c" % length + number.to_bytes(length, "little", signed=True)
        kinds = ("BININT", "BININT1", "BININT2", "LONG1")
        return _replace_instruction(pickled, rng, kinds, instruction)

    return _edit_pickle(content, change)


@content_mutation("names", *_TORCH)
def text_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    """Change the name of a tensor, of a storage or of a device, perhaps to one of 5 MB."""
    names = (
        "",
        "0",
        "cuda:0",
        "meta",
        "storage",
        "../data",
        "x" * _LONG_TEXT_BYTES,
        "\x1b[2J" * 1_000_000,
        "\u202e" * 1000,
        *ODD_NAMES,
    )
    text = choose(rng, names).encode()
    instruction = b"X" + struct.pack("<I", len(text)) + text
    kinds = ("BINUNICODE", "SHORT_BINUNICODE")
    return _edit_pickle(
        content, lambda pickled: _replace_instruction(pickled, rng, kinds, instruction)
    )


@content_mutation("types", *_TORCH)
def global_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    names = (
        b"torch\nDoubleStorage",
        b"torch\nBoolStorage",
        b"torch\nQInt8Storage",
        b"torch\nComplexFloatStorage",
        b"torch\nfloat32",
        b"torch._utils\n_rebuild_sparse_tensor",
        b"collections\nCounter",
        b"builtins\ndict",
        b"builtins\nset",
        b"torch\nTensor",
    )
    instruction = b"c" + choose(rng, names) + b"\n"
    return _edit_pickle(
        content, lambda pickled: _replace_instruction(pickled, rng, ("GLOBAL",), instruction)
    )


@content_mutation("bombs", "pt")
def storages_deflated(content: bytes, rng: Rng) -> bytes:
    """Compress the archive, perhaps with a tensor's storage of 300 MB of zeros."""
    members = read_members(content)
    if rng.integers(2):
        name = choose(rng, [name for name in members if "/data/" in name])
        members[name] = bytes(300 << 20)
    return pack_archive(members, zipfile.ZIP_DEFLATED)


@content_mutation("types", "pt")
def storage_lost_or_cut(content: bytes, rng: Rng) -> bytes:
    """Remove, cut or extend a member, or add one that states another format."""
    members = read_members(content)
    name = choose(rng, list(members))
    choice = rng.integers(4)
    if choice == 0:
        del members[name]
    elif choice == 1:
        members[name] = members[name][: len(members[name]) // 2]
    elif choice == 2:
        members[name] += bytes(64)
    else:
        folder = name.partition("/")[0]
        options = (("byteorder", b"big"), ("version", b"99"), ("constants.pkl", b"\x80\2N."))
        file_name, member = choose(rng, options)
        members[f"{folder}/{file_name}"] = member
    return pack_archive(members, zipfile.ZIP_STORED)


@content_mutation("numbers", "pth")
def storage_of_another_length(content: bytes, rng: Rng) -> bytes:
    """Change the number of elements before a storage of an old file."""
    _, begin = _find_pickles(content)[-1]
    number = choose(rng, (0, 1, 1 << 31, 1 << 33, 1 << 62, -1, -(1 << 62)))
    return replace_bytes(content, begin, begin + 8, struct.pack("<q", number))


def _save_changed(path: Path, change: Callable[[StateDict], Any]) -> None:
    """Save a checkpoint again with a changed state, in the same format."""
    import torch

    content = path.read_bytes()
    is_zip = content.startswith(b"PK")
    state = dict(torch.load(io.BytesIO(content), weights_only=True))
    buffer = io.BytesIO()
    torch.save(change(state), buffer, _use_new_zipfile_serialization=is_zip)
    replace_file(path, buffer.getvalue())


def _edit_pickle(content: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Return a checkpoint with a changed pickle of its state."""
    if not content.startswith(b"PK"):
        begin, end = _find_pickles(content)[_OLD_STATE_POSITION]
        return replace_bytes(content, begin, end, change(content[begin:end]))
    members = read_members(content)
    name = next(name for name in members if name.endswith("data.pkl"))
    members[name] = change(members[name])
    return pack_archive(members, zipfile.ZIP_STORED)


def _find_pickles(content: bytes) -> list[tuple[int, int]]:
    """Return the begin and the end of each pickle of an old file; its storages follow them."""
    file = io.BytesIO(content)
    spans = []
    for _ in range(5):
        begin = file.tell()
        for _ in pickletools.genops(file):
            pass
        spans.append((begin, file.tell()))
    return spans


def _replace_instruction(
    pickled: bytes, rng: Rng, kinds: tuple[str, ...], instruction: bytes
) -> bytes:
    """Return a pickle in which one instruction of some kinds is replaced."""
    begins = []
    matches = []
    for number, (opcode, _, begin) in enumerate(pickletools.genops(pickled)):
        begins.append(begin)
        if opcode.name in kinds:
            matches.append(number)
    begins.append(len(pickled))
    number = choose(rng, matches)
    return replace_bytes(pickled, begins[number], begins[number + 1], instruction)
