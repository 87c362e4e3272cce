"""Checkpoints of strangers: the forms that are in use load; bombs and nonsense are refused, in
little memory.
"""

import io
import json
import pathlib
import re
import struct
import subprocess
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model import load_model
from deepaccident_devkit.plugins.model.checkpoint import read_weights, write_weights

NAME = "img_neck.weight"
SHORT = r"\A.{,600}\Z"


def network() -> torch.nn.Module:
    torch.manual_seed(0)
    return torch.nn.Sequential(
        OrderedDict(img_neck=torch.nn.Conv2d(3, 4, 3), transformer=torch.nn.BatchNorm2d(4))
    )


def trained(model: torch.nn.Module) -> dict[str, Any]:
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.zeros(1, 3, 8, 8)).sum().backward()
    optimizer.step()
    return optimizer.state_dict()


def mmcv() -> Any:
    """What its runner saves: notes, an optimizer, and numbers of numpy."""
    model, numbers = network(), np.arange(3.0)
    meta = {
        "config": "x = 1\n" * 9,
        "CLASSES": ("car", "van"),
        "PALETTE": [(1, 2, 3)],
        "hook_msgs": {},
        "iter": 1 << 40,
        "best": np.float64(0.3),
        "numbers": numbers,
        "again": numbers,
        "size": torch.Size([3, 4]),
        "flag": True,
        "dtype": torch.float32,
        "device": torch.device("cpu"),
        "path": pathlib.PosixPath("/a/b/c/d/e/f/g/h/i/epoch.pth"),
    }
    return {"meta": meta, "state_dict": model.state_dict(), "optimizer": trained(model)}


BASE = torch.arange(12.0)
FORMS = {
    "a state dict, with versions of layers": lambda: network().state_dict(),
    "mmcv": mmcv,
    "Swin": lambda: {"model": dict(network().state_dict())},
    "parameters": lambda: dict(network().named_parameters()),
    "kinds of numbers": lambda: {
        f"img_neck.{kind}": BASE.to(getattr(torch, kind))
        for kind in (
            "float64",
            "float16",
            "bfloat16",
            "int64",
            "int32",
            "int16",
            "int8",
            "uint8",
            "bool",
        )
    },
    "shared storages": lambda: {
        f"img_neck.{n}": each for n, each in enumerate((BASE, BASE[3:], BASE.view(3, 4).t()))
    },
    "scalars and empty ones": lambda: {
        "img_neck.a": torch.tensor(3.0),
        "img_neck.b": torch.zeros(0, 4),
    },
    "other things beside": lambda: {**network().state_dict(), "epoch": 3, 4: BASE, "none": None},
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "way", [{}, {"pickle_protocol": 4}, {"_use_new_zipfile_serialization": False}]
)
def test_forms_in_use_load(tmp_path: Path, form: str, way: dict[str, Any]) -> None:
    path, content = tmp_path / "weights.pth", FORMS[form]()
    torch.save(content, path, **way)
    tensors = content.get("state_dict", content.get("model", content))
    wanted = {
        name: each
        for name, each in tensors.items()
        if isinstance(name, str) and isinstance(each, torch.Tensor)
    }
    torch.testing.assert_close(dict(read_weights(path).tensors), wanted, rtol=0, atol=0)


@pytest.mark.parametrize("old_form", [False, True])
def test_the_healthy_file_beside_the_hostile_ones(tmp_path: Path, *, old_form: bool) -> None:
    path = tmp_path / "weights.pth"
    path.write_bytes(old(GOOD) if old_form else pt(GOOD))
    assert (
        read_weights(path).tensors[NAME].tolist()
        == torch.load(path, weights_only=True)[NAME].tolist()
        == [0.0]
    )


def test_items_as_python_2_wrote_them(tmp_path: Path) -> None:
    path, items = (
        tmp_path / "old.pth",
        b"]](U\x0fimg_neck.weight" + tensor(b"K\x02\x85", b"K\x01\x85") + b"ea",
    )
    path.write_bytes(pt(b"ccollections\nOrderedDict\n" + items + b"\x85R."))
    assert list(read_weights(path).tensors) == [NAME]


def pt(pickled: bytes, storage: bytes = bytes(16), way: int = zipfile.ZIP_STORED) -> bytes:
    """A file as torch writes it, with this pickle and one storage."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", way) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + pickled)
        archive.writestr("archive/version", b"3\n")
        archive.writestr("archive/data/0", storage)
    return file.getvalue()


def tensor(shape: bytes, strides: bytes, offset: bytes = b"K\0") -> bytes:
    """A tensor of the storage 0; shape and strides as opcodes."""
    storage = b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04tQ"
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + storage
        + offset
        + shape
        + strides
        + b"\x89Nt"
        + b"R"
    )


def named(value: bytes, name: bytes = b"U\x0fimg_neck.weight") -> bytes:
    """A dict with one value."""
    return b"}" + name + value + b"s."


def old(
    held: bytes, names: bytes = b"](U\x010e.", storages: bytes = struct.pack("<q", 4) + bytes(16)
) -> bytes:
    """A file as torch wrote it before 1.6."""
    begin = (
        b"\x80\x02\x8a\nl\xfc\x9cF\xf9 "
        b"j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}U\x0dlittle_endian\x88s."
    )
    held = held.replace(b"K\x04tQ", b"K\x04NtQ")  # and not a view of another storage
    return begin + b"\x80\x02" + held + b"\x80\x02" + names + storages


def saved(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def safetensors(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def stored(dtype: str, shape: list[int], size: int) -> Any:
    return {NAME: {"dtype": dtype, "shape": shape, "data_offsets": [0, size]}}


LONG = b"\x8a\x08" + struct.pack("<q", 1 << 60)
ONE, HUGE = b"K\x01\x85", b"\x8a\x05" + struct.pack("<q", 1 << 34)[:5] + b"\x85"
GOOD = named(tensor(ONE, ONE))
KEYS = b")" + b"".join(b"q%ch%c\x86" % (n, n) for n in range(200))
LISTED = b"](" + b"](U\x01aNe" * 50_000 + b"eq\0"
MANY = tensor(b"J\0\0\x10\0\x85", b"K\0\x85")
SWIN, MERGED = {"patch_embed.proj.weight": torch.zeros(3)}, "layers.0.downsample.norm.bias"
ENTRY = b'{"dtype":"U8","shape":[1],"data_offsets":[0,1]}'
HOSTILE: dict[str, bytes] = {
    "bytearray": pt(named(b"c__builtin__\nbytearray\n\x8a\x05\0\0\0\0\x02\x85R")),
    "a stride of 0": pt(named(tensor(HUGE, b"K\0\x85"))),
    "many expanded tensors": pt(b"}(" + b"".join(b"U\x02%02d" % n + MANY for n in range(20)) + b"u."),  # noqa: E501
    "beyond the storage": pt(named(tensor(b"K\x05\x85", ONE))),
    "an offset beyond the storage": pt(named(tensor(ONE, ONE, LONG))),
    "strides beyond the storage": pt(named(tensor(b"K\x02\x85", LONG + b"\x85"))),
    "lengths that overflow": pt(named(tensor(b"(" + LONG * 8 + b"t", b"(" + LONG * 8 + b"t"))),
    "a length below 0": pt(named(tensor(b"J\xff\xff\xff\xff\x85", ONE))),
    "a shape of fractions": pt(named(tensor(b"G" + bytes(8) + b"\x85", ONE))),
    "no shape": pt(named(tensor(b"N", ONE))),
    "other strides": pt(named(tensor(ONE, b")"))),
    "100 dimensions": pt(named(tensor(b"(" + b"K\x01" * 100 + b"t", b"(" + b"K\x01" * 100 + b"t"))),
    "another storage": pt(GOOD.replace(b"FloatStorage", b"QInt8Storage")),
    "no storage": pt(GOOD.replace(b"U\x010U\x03cpu", b"U\x011U\x03cpu")),
    "a view of a storage": pt(GOOD.replace(b"K\x04tQ", b"K\x04K\x01tQ")),
    "deflated": pt(named(tensor(ONE, ONE)), bytes(1 << 30), zipfile.ZIP_DEFLATED),
    "old, storages that end early": old(GOOD, storages=struct.pack("<q", 1 << 40) + bytes(16)),
    "old, storages below 0": old(GOOD, storages=struct.pack("<q", -4) + bytes(16)),
    "old, the same storage again": old(GOOD, b"](" + b"U\x010" * 99 + b"e."),
    "old, an unknown storage": old(GOOD, b"](U\x011e."),
    "old, no names": old(GOOD, b"K\x01."),
    "old, bytes that follow": old(GOOD) + b"1",
    "old, cut off": old(GOOD)[:40],
    "old, big-endian": old(GOOD).replace(b"endian\x88", b"endian\x89"),
    "keys that double": pt(b"}" + KEYS + b"Ns."),
    "deep tuples as a key": pt(b"}" + b")" + b"\x85" * 300_000 + b"Ns."),
    "a storage whose name doubles": pt(KEYS + GOOD.replace(b"U\x010U", b"h\xc7U")),
    "a storage whose kind doubles": pt(KEYS + GOOD.replace(b"ctorch\nFloatStorage\n", b"h\xc7")),
    "old, storage names that double": old(GOOD, b"](" + KEYS + b"e."),
    "items that double": pt(b"ccollections\nOrderedDict\n]](" + KEYS + b"Nea\x85R."),
    "items given to many": pt(LISTED + b"ccollections\nOrderedDict\nh\0\x85R" * 60_000 + b"."),
    "many opcodes": pt(b"]" * 3_000_000 + b"."),
    "long numbers as keys": pt(b"}(" + b"\x8a\x20" + b"\x01" * 32 + b"Nu."),
    "text of 1 GiB": pt(b"X\0\0\0\x40x."),
    "text of 2**60 bytes": pt(b"\x8d" + struct.pack("<Q", 1 << 60) + b"x."),
    "a whole number of 2 GiB": pt(b"\x8b\xff\xff\xff\x7f1."),
    "digits": pt(b"I" + b"9" * 4_000_000 + b"\n."),
    "a bytearray of the pickle": pt(b"\x96" + struct.pack("<Q", 1 << 36) + b"x."),
    "a place in the memo": pt(b"Nr\xff\xff\xff\x7fj\xff\xff\xff\x7e."),
    "nothing to take": pt(b"0R."),
    "no end": pt(b"N"),
    "code": pt(named(b"cos\nsystem\nU\x04true\x85R")),
    "a name of a megabyte": pt(b"c" + b"x" * 1_000_000 + b"\ny\n."),
    "what is no function": pt(b"ctorch\nFloatStorage\n)R."),
    "no pickle": pt(b"").replace(b"data.pkl", b"data.txt"),
    "meta": saved({NAME: torch.zeros(3, device="meta")}),
    "sparse": saved({NAME: torch.eye(3).to_sparse()}),
    "complex": saved({NAME: torch.zeros(3, dtype=torch.complex64)}),
    "quantized": pt(named(b"ctorch._utils\n_rebuild_qtensor\n)R")),
    "a whole model": pt(named(b"ctorch.nn.modules.conv\nConv2d\n)R")),
    "no tensors": pt(b"}."),
    "names that are numbers": saved({0: torch.zeros(3), 1: torch.ones(2)}),
    "names that are bytes": saved({b"img_neck.weight": torch.zeros(3)}),
    "nested": pt(b"}U\x01a" * 100_000 + b"N" + b"s" * 100_000 + b"."),
    "Swin's, of other shapes": saved(SWIN | {MERGED: torch.zeros(3)}),
    "Swin's, without a shape": saved(SWIN | {MERGED: torch.tensor(1.0)}),
    "Swin's, a long name": saved(SWIN | {"x" * 1_000_000: torch.zeros(3)}),
    "a header of 100 MB": safetensors(b" " * 100_000_000),
    "a header that is not there": safetensors({})[:8] + b"{",
    "a header beyond the file": struct.pack("<Q", 1 << 60) + b"{}",
    "a nested header": safetensors(b"[" * 100_000),
    "a header that is no object": safetensors([1]),
    "notes of numbers": safetensors({"__metadata__": {"deepaccident": 3}}),
    "notes in a list": safetensors({"__metadata__": {"deepaccident": "[1]"}}),
    "numbers of an unknown kind": safetensors(stored("F4", [2], 1), b"1"),
    "numbers of no kind": safetensors(stored("X" * 1_000_000, [2], 2), b"12"),
    "complex safetensors": safetensors(stored("C64", [1], 8), bytes(8)),
    "eight bits": safetensors(stored("F8_E4M3", [1], 1), bytes(1)),
    "a huge shape": safetensors(stored("F32", [1 << 60], 4), bytes(4)),
    "a shape that overflows": safetensors(stored("F32", [1 << 40] * 4, 4), bytes(4)),
    "the same name twice": safetensors(b'{"a":%s,"a":%s}' % (ENTRY, ENTRY), b"1"),
}  # fmt: skip

CODE = """
import json, resource, sys, time
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.checkpoint import read_weights
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
limit = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + (2 << 30)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sys.argv[1:]:
    before, said = peak(), None
    try:
        read_weights(path)
    except ConfigError as error:
        said = str(error)
    except BaseException as error:
        said = repr(error)[:300]
    print(json.dumps([path, said, peak() - before]))
"""


def test_bombs_and_nonsense_are_refused_in_little_memory(tmp_path: Path) -> None:
    """In a process with 2 GiB; each takes at most what its file has several times, and some 300
    MB.
    """
    paths = [str(tmp_path / f"{number}.pth") for number in range(len(HOSTILE))]
    for path, content in zip(paths, HOSTILE.values(), strict=True):
        Path(path).write_bytes(content)
    ended = subprocess.run(
        [sys.executable, "-c", CODE, *paths], capture_output=True, text=True, check=True
    )
    told = dict(zip(HOSTILE, map(json.loads, ended.stdout.splitlines()), strict=True))
    refusal = re.compile(r"(?P<path>.*\.pth): (is no|holds no) .*; give .*")
    wrong = {
        what: (said, taken)
        for what, (path, said, taken) in told.items()
        for refused in [refusal.fullmatch(said or "")]
        if not refused or refused["path"] != path or len(said) > 700 or taken > 300
    }
    assert wrong == {}


@pytest.mark.parametrize(
    "change",
    [
        {"preset": "x" * 1_000_000},
        {"preset": ["tiny"]},
        {"fusion": {}},
        {"horizon": 10**400},
        {"horizon": "2"},
        {"horizon": -1},
        {"horizon": 2.2},
    ],
)
def test_notes_of_no_model_are_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "weights.safetensors"
    write_weights(path, {NAME: BASE}, {"preset": "tiny", "fusion": None, "horizon": None, **change})
    told = r"does not say which model its weights are of \([^\n]*\); give"
    assert_refused(
        (lambda: load_model(path), ConfigError, told),
        (lambda: load_model(path), ConfigError, SHORT),
    )
