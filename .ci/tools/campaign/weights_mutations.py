"""What strangers do to files of weights: headers, storages, shapes, names, pickles. Some need
PyTorch to be made.
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
    Rng,
    any_of,
    by_content,
    by_path,
    members_of,
    packed,
    replace,
)

_TORCH = ("pt", "pth")
_GIGABYTES = 6 << 30
_NAME = 5_000_000


# ---- safetensors: the length of a header of JSON, the header, and the bytes of all tensors


def _header_of(content: bytes) -> tuple[dict[str, Any], bytes]:
    length = int.from_bytes(content[:8], "little")
    header: dict[str, Any] = json.loads(content[8 : 8 + length])
    return header, content[8 + length :]


def _with_header(header: Any, data: bytes) -> bytes:
    text = json.dumps(header).encode("utf-8", "surrogatepass")
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data


def _tensor_of(header: dict[str, Any], rng: Rng) -> str:
    name: str = any_of(rng, [each for each in header if each != "__metadata__"])
    return name


@by_content("numbers", "safetensors")
def header_of_another_length(content: bytes, rng: Rng) -> bytes:
    length = int.from_bytes(content[:8], "little")
    odd = (
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
    return struct.pack("<Q", any_of(rng, odd)) + content[8:]


@by_content("numbers", "safetensors")
def tensor_of_another_size(content: bytes, rng: Rng) -> bytes:
    """Its shape, or where its bytes lie, is another."""
    header, data = _header_of(content)
    odd = (
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
    tensor = header[_tensor_of(header, rng)]
    numbers = tensor[any_of(rng, ("shape", "data_offsets"))]
    if numbers and rng.integers(3):
        numbers[int(rng.integers(len(numbers)))] = any_of(rng, odd)
    else:
        numbers += any_of(rng, ([1], [0], [1] * 100, [1 << 31, 1 << 31], [[1]]))
    return _with_header(header, data)


@by_content("numbers", "safetensors")
def numbers_of_a_tensor_are_odd(content: bytes, rng: Rng) -> bytes:
    """All of them are NaN, infinite or huge."""
    header, data = _header_of(content)
    begin, end = header[_tensor_of(header, rng)]["data_offsets"]
    value = any_of(
        rng,
        (np.float32("nan"), np.float32("inf"), np.float32(3e38), np.float32(-1), np.float32(1e-45)),
    )
    filled = (value.tobytes() * ((end - begin) // 4 + 1))[: end - begin]
    return _with_header(header, data[:begin] + filled + data[end:])


@by_content("types", "safetensors")
def tensor_of_another_dtype(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    tensor = header[_tensor_of(header, rng)]
    size = tensor["data_offsets"][1] - tensor["data_offsets"][0]
    kinds = {
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
    name = any_of(rng, list(kinds))
    tensor["dtype"] = any_of(rng, (name, name, "F32", "X", "", 1, None, "f32"))
    if rng.integers(2):
        tensor["shape"] = [size // kinds[name]]
    return _with_header(header, data)


@by_content("types", "safetensors")
def header_of_other_values(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    odd = (None, True, 1, -1.5, "", "x", [], {}, [[]], {"a": 1}, {"dtype": "F32"}, float("nan"))
    if rng.integers(4) == 0:
        return _with_header(any_of(rng, odd), data)
    inside = any_of(rng, (header, header[_tensor_of(header, rng)]))
    inside[any_of(rng, (*inside, "another"))] = any_of(rng, odd)
    return _with_header(header, data)


@by_content("types", "safetensors")
def tensor_lost_or_added(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    last = max(each["data_offsets"][1] for name, each in header.items() if name != "__metadata__")
    name = any_of(
        rng,
        (
            "another",
            "optimizer.0.exp_avg",
            "optimizer.x.step",
            "optimizer.",
            "optimizer.99999999.step",
        ),
    )
    added = {"dtype": "F32", "shape": [4], "data_offsets": [last, last + 16]}
    if rng.integers(2):
        return _with_header(header | {name: added}, data + bytes(16))
    lost = header.pop(_tensor_of(header, rng))
    if lost["data_offsets"][1] == last:
        data = data[: lost["data_offsets"][0]]
    elif rng.integers(2):
        header["another"] = lost
    return _with_header(header, data)


@by_content("types", "safetensors")
def notes_of_other_values(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    notes = json.loads(header["__metadata__"]["deepaccident"])
    odd = (
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
    notes[any_of(rng, (*notes, "step", "best", "preset", "another"))] = any_of(rng, odd)
    texts = (
        json.dumps(notes),
        json.dumps(notes),
        json.dumps(notes),
        "",
        "[]",
        "null",
        "x",
        "{" * 5000,
        "[" * 200_000,
    )
    header["__metadata__"] = any_of(
        rng,
        (
            {"deepaccident": any_of(rng, texts)},
            {"deepaccident": any_of(rng, texts)},
            {},
            {"deepaccident": {}},
            "x",
        ),
    )
    return _with_header(header, data)


@by_content("bombs", "safetensors")
def header_of_many_tensors(content: bytes, rng: Rng) -> bytes:
    """50,000 empty tensors, a deep header, or shapes whose product is huge though no byte is
    there.
    """
    header, data = _header_of(content)
    last = max(each["data_offsets"][1] for name, each in header.items() if name != "__metadata__")
    empty = {"dtype": "F32", "shape": [0], "data_offsets": [last, last]}
    if (way := int(rng.integers(3))) == 0:
        return _with_header(header | {f"{number}": empty for number in range(50_000)}, data)
    if way == 1:
        shape = any_of(
            rng, ([0, 1 << 40], [1 << 40, 0], [1 << 31, 1 << 31, 0], [0] * 10_000, [1] * 100_000)
        )
        return _with_header(header | {"another": empty | {"shape": shape}}, data)
    nest = b"[" * any_of(rng, (5000, 200_000))
    return struct.pack("<Q", len(nest) + 6) + b'{"a": ' + nest + data


@by_content("bombs", "safetensors")
def notes_of_5_mb(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    notes = json.loads(header["__metadata__"]["deepaccident"])
    text = any_of(rng, ("x", "\x1b[2J", "\u202e")) * (_NAME // 4)
    notes[any_of(rng, (*notes, "preset", "step", text))] = text
    header["__metadata__"]["deepaccident"] = json.dumps(notes)
    return _with_header(header, data)


@by_content("names", "safetensors")
def tensor_with_another_name(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    odd = (
        "",
        "0",
        "__metadata__ ",
        "module.",
        "optimizer.x",
        "\x1b[2J" * 1_000_000,
        "x" * _NAME,
        "\u202e" * 1000,
        "a\0b",
        "..",
    )
    header[any_of(rng, (*odd, *ODD_NAMES))] = header.pop(_tensor_of(header, rng))
    return _with_header(header, data)


@by_content("names", "safetensors")
def notes_with_odd_names(content: bytes, rng: Rng) -> bytes:
    header, data = _header_of(content)
    notes = json.loads(header["__metadata__"]["deepaccident"])
    notes[any_of(rng, (*notes, "preset", "fusion", *ODD_NAMES))] = any_of(rng, ODD_NAMES)
    header["__metadata__"]["deepaccident"] = json.dumps(notes)
    return _with_header(header, data)


# ---- checkpoints of PyTorch: a pickle of what is where, and storages; in a zip, or one after the
# other


@by_path("types", *_TORCH)
def checkpoint_runs_code(path: Path, rng: Rng) -> None:
    _saved(
        path, lambda state: state | {any_of(rng, ("another", *state)): Bomb(path.parent / MARKER)}
    )


@by_path("types", *_TORCH)
def checkpoint_of_odd_tensors(path: Path, rng: Rng) -> None:
    """A tensor is a view, sparse, quantized, without numbers, of another type; or no tensor."""
    import torch

    def change(state: dict[str, Any]) -> Any:
        name = any_of(rng, list(state))
        here = state[name].float() if state[name].ndim else torch.ones(3)
        dtypes = (
            torch.float64,
            torch.float16,
            torch.bfloat16,
            torch.int64,
            torch.int8,
            torch.bool,
            torch.complex64,
        )
        odd: tuple[Callable[[], Any], ...] = (
            *(lambda dtype=dtype: here.to(dtype) for dtype in dtypes),
            lambda: here.to("meta"),
            here.to_sparse,
            lambda: torch.quantize_per_tensor(here, 0.1, 0, torch.qint8),
            lambda: torch.nn.Parameter(here),
            lambda: here.transpose(0, -1),
            lambda: here[:0],
            here.numpy,
            here.tolist,
            lambda: np.float64(1),
            lambda: {"state_dict": here},
            lambda: torch.nn.Linear(2, 2),
            lambda: torch.device("cpu"),
            lambda: None,
        )
        state[name] = any_of(rng, odd)()
        return state

    _saved(path, change)


@by_path("types", *_TORCH)
def checkpoint_of_other_things(path: Path, rng: Rng) -> None:
    """What is saved is no state dict, or lies deeper, or has numbers for names."""
    import torch

    ways: tuple[Callable[[dict[str, Any]], Any], ...] = (
        lambda state: {"state_dict": state},
        lambda state: {
            "model": OrderedDict(state),
            "optimizer": {"state": {0: torch.ones(2)}},
            "epoch": 3,
        },
        lambda state: {f"module.{name}": each for name, each in state.items()},
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
    _saved(path, any_of(rng, ways))


@by_path("bombs", *_TORCH)
def tensor_of_stride_0(path: Path, rng: Rng) -> None:
    """A view that says gigabytes of one number; or many of them."""
    import torch

    def change(state: dict[str, Any]) -> Any:
        name = any_of(rng, list(state))
        if rng.integers(2):
            state[name] = torch.zeros(1).expand(any_of(rng, (1 << 29, 1 << 31, 1 << 40)))
        else:
            one = torch.zeros(1)
            state.update({f"{name}.{number}": one.expand(1 << 24) for number in range(100)})
        return state

    _saved(path, change)


@by_path("bombs", *_TORCH)
def checkpoint_of_many_tensors(path: Path, rng: Rng) -> None:
    """20,000 views of one storage, or a deep dict."""
    import torch

    def change(state: dict[str, Any]) -> Any:
        if rng.integers(2):
            one = torch.zeros(4)
            return state | {f"{number}": one[:1] for number in range(20_000)}
        deep: Any = state
        for _ in range(200):
            deep = {"state_dict": deep}
        return deep

    _saved(path, change)


@by_content("bombs", *_TORCH)
def pickle_of_gigabytes(content: bytes, rng: Rng) -> bytes:
    """Some ten bytes that ask for 6 GB, or for time without end."""
    size = b"\x8a\5" + _GIGABYTES.to_bytes(5, "little")
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
    return _with_pickle(content, lambda _: b"\x80\2" + any_of(rng, calls))


@by_content("types", *_TORCH)
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
    )
    more = (
        b"torch.serialization\nload",
        b"torch._utils\n_rebuild_parameter",
        b"torch.jit\nload",
        b"\x1b[31m\n\xe2\x80\xae",
    )
    end = any_of(
        rng, (b"(X\2\0\0\0lstR.", b".", b"(tR.", b"}b.", b")\x81.", b"X\2\0\0\0lsQ.", b"0")
    )
    name = any_of(rng, (*names, *more))
    return _with_pickle(
        content,
        lambda before: b"\x80\2c" + name + b"\n" + (end if end != b"0" else b"0" + before[2:]),
    )


@by_content("numbers", *_TORCH)
def number_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    """An offset, a size, a stride or the length of a storage is another."""

    def change(before: bytes) -> bytes:
        number = any_of(
            rng, (0, 1, 2, 255, 1 << 16, 1 << 31, 1 << 40, (1 << 63) - 1, 1 << 70, -1, -(1 << 40))
        )
        length = max((number.bit_length() + 8) // 8, 1)
        return _edited(
            before,
            rng,
            ("BININT", "BININT1", "BININT2", "LONG1"),
            b"\x8a%c" % length + number.to_bytes(length, "little", signed=True),
        )

    return _with_pickle(content, change)


@by_content("names", *_TORCH)
def text_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    """The name of a tensor, of a storage or of a device is another; of a tensor it may have 5
    MB.
    """
    odd = (
        "",
        "0",
        "cuda:0",
        "meta",
        "storage",
        "../data",
        "x" * _NAME,
        "\x1b[2J" * 1_000_000,
        "\u202e" * 1000,
        *ODD_NAMES,
    )
    text = any_of(rng, odd).encode()
    other = b"X" + struct.pack("<I", len(text)) + text
    return _with_pickle(
        content, lambda before: _edited(before, rng, ("BINUNICODE", "SHORT_BINUNICODE"), other)
    )


@by_content("types", *_TORCH)
def global_of_a_pickle(content: bytes, rng: Rng) -> bytes:
    names = (
        b"torch\nDoubleStorage",
        b"torch\nBoolStorage",
        b"torch\nQInt8Storage",
        b"torch\nComplexFloatStorage",
        b"torch\nfloat32",
    )
    more = (
        b"torch._utils\n_rebuild_sparse_tensor",
        b"collections\nCounter",
        b"builtins\ndict",
        b"builtins\nset",
        b"torch\nTensor",
    )
    name = any_of(rng, (*names, *more))
    return _with_pickle(
        content, lambda before: _edited(before, rng, ("GLOBAL",), b"c" + name + b"\n")
    )


@by_content("bombs", "pt")
def storages_deflated(content: bytes, rng: Rng) -> bytes:
    """The archive is compressed; perhaps with a storage of 300 MB of zeros, of which a tensor is
    made.
    """
    members = members_of(content)
    if rng.integers(2):
        name = any_of(rng, [each for each in members if "/data/" in each])
        members[name] = bytes(300 << 20)
    return packed(members, zipfile.ZIP_DEFLATED)


@by_content("types", "pt")
def storage_lost_or_cut(content: bytes, rng: Rng) -> bytes:
    members = members_of(content)
    name = any_of(rng, list(members))
    way = int(rng.integers(4))
    if way == 0:
        del members[name]
    elif way == 1:
        members[name] = members[name][: len(members[name]) // 2]
    elif way == 2:
        members[name] += bytes(64)
    else:
        head = name.partition("/")[0]
        members |= any_of(
            rng,
            (
                {f"{head}/byteorder": b"big"},
                {f"{head}/version": b"99"},
                {f"{head}/constants.pkl": b"\x80\2N."},
            ),
        )
    return packed(members, zipfile.ZIP_STORED)


@by_content("numbers", "pth")
def storage_of_another_length(content: bytes, rng: Rng) -> bytes:
    """The number of elements before a storage of an old file is another."""
    begin = _pickles(content)[-1][1]
    number = any_of(rng, (0, 1, 1 << 31, 1 << 33, 1 << 62, -1, -(1 << 62)))
    return content[:begin] + struct.pack("<q", number) + content[begin + 8 :]


def _saved(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Save again with something else, in the same format."""
    import torch

    content = path.read_bytes()
    state = dict(torch.load(io.BytesIO(content), weights_only=True))
    buffer = io.BytesIO()
    torch.save(change(state), buffer, _use_new_zipfile_serialization=content.startswith(b"PK"))
    replace(path, buffer.getvalue())


def _with_pickle(content: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """A checkpoint with another pickle of what is where."""
    if not content.startswith(b"PK"):
        begin, end = _pickles(content)[
            3
        ]  # after a number, a version, and what kind of machine wrote it
        return content[:begin] + change(content[begin:end]) + content[end:]
    members = members_of(content)
    name = next(each for each in members if each.endswith("data.pkl"))
    members[name] = change(members[name])
    return packed(members, zipfile.ZIP_STORED)


def _pickles(content: bytes) -> list[tuple[int, int]]:
    """Where the pickles of an old file begin and end; its storages follow them."""
    file, spans = io.BytesIO(content), []
    for _ in range(5):
        begin = file.tell()
        for _ in pickletools.genops(file):
            pass
        spans.append((begin, file.tell()))
    return spans


def _edited(before: bytes, rng: Rng, kinds: tuple[str, ...], other: bytes) -> bytes:
    """A pickle in which one instruction of these kinds is another."""
    places = [(place, code.name) for code, _, place in pickletools.genops(before)] + [
        (len(before), "")
    ]
    number = any_of(rng, [number for number, (_, name) in enumerate(places) if name in kinds])
    return before[: places[number][0]] + other + before[places[number + 1][0] :]
