"""Foreign checkpoints: usual forms load, and hostile files are refused in little memory."""

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
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model import load_model
from deepaccident_devkit.plugins.model.checkpoint import read_weights, write_weights

TENSOR_NAME = "img_neck.weight"
SHORT_MESSAGE = r"\A.{,600}\Z"


def make_network() -> torch.nn.Module:
    torch.manual_seed(0)
    return torch.nn.Sequential(
        OrderedDict(img_neck=torch.nn.Conv2d(3, 4, 3), transformer=torch.nn.BatchNorm2d(4))
    )


def train_one_step(model: torch.nn.Module) -> dict[str, Any]:
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.zeros(1, 3, 8, 8)).sum().backward()
    optimizer.step()
    return optimizer.state_dict()


def make_mmcv_checkpoint() -> Any:
    """Make a checkpoint as mmcv's runner does: notes, an optimizer, and numpy's numbers."""
    model, numbers = make_network(), np.arange(3.0)
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
    return {"meta": meta, "state_dict": model.state_dict(), "optimizer": train_one_step(model)}


NUMBERS = torch.arange(12.0)
CHECKPOINT_FORMS = {
    "a state dict, with versions of layers": lambda: make_network().state_dict(),
    "mmcv": make_mmcv_checkpoint,
    "Swin": lambda: {"model": dict(make_network().state_dict())},
    "parameters": lambda: dict(make_network().named_parameters()),
    "kinds of numbers": lambda: {
        f"img_neck.{kind}": NUMBERS.to(getattr(torch, kind))
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
        "img_neck.whole": NUMBERS,
        "img_neck.part": NUMBERS[3:],
        "img_neck.transposed": NUMBERS.view(3, 4).t(),
    },
    "scalars and empty ones": lambda: {
        "img_neck.a": torch.tensor(3.0),
        "img_neck.b": torch.zeros(0, 4),
    },
    "other things beside": lambda: {
        **make_network().state_dict(),
        "epoch": 3,
        4: NUMBERS,
        "none": None,
    },
}


def make_zip_file(
    pickled: bytes, storage: bytes = bytes(16), method: int = zipfile.ZIP_STORED
) -> bytes:
    """Make a file as torch writes it, with this pickle and one storage."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + pickled)
        archive.writestr("archive/version", b"3\n")
        archive.writestr("archive/data/0", storage)
    return file.getvalue()


def tensor_opcodes(shape: bytes, strides: bytes, offset: bytes = b"K\0") -> bytes:
    """Return the opcodes of a tensor of storage 0; shape and strides are opcodes too."""
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


def dict_opcodes(value: bytes, name: bytes = b"U\x0fimg_neck.weight") -> bytes:
    return b"}" + name + value + b"s."


def make_old_file(
    pickled: bytes, names: bytes = b"](U\x010e.", storages: bytes = struct.pack("<q", 4) + bytes(16)
) -> bytes:
    """Make a file as torch wrote it before 1.6."""
    header = (
        b"\x80\x02\x8a\nl\xfc\x9cF\xf9 "
        b"j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}U\x0dlittle_endian\x88s."
    )
    pickled = pickled.replace(b"K\x04tQ", b"K\x04NtQ")  # the storage is no view of another one
    return header + b"\x80\x02" + pickled + b"\x80\x02" + names + storages


def save_to_bytes(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def make_safetensors(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def tensor_header(dtype: str, shape: list[int], size: int) -> Any:
    return {
        TENSOR_NAME: {
            "dtype": dtype,
            "shape": shape,
            "data_offsets": [0, size],
        }
    }


LONG_NUMBER = b"\x8a\x08" + struct.pack("<q", 1 << 60)
ONE_TUPLE = b"K\x01\x85"
HUGE_TUPLE = b"\x8a\x05" + struct.pack("<q", 1 << 34)[:5] + b"\x85"
HEALTHY_PICKLE = dict_opcodes(tensor_opcodes(ONE_TUPLE, ONE_TUPLE))
DOUBLING_TUPLES = b")" + b"".join(b"q%ch%c\x86" % (slot, slot) for slot in range(200))
PAIR_LIST = b"](" + b"](U\x01aNe" * 50_000 + b"eq\0"
EXPANDED_TENSOR = tensor_opcodes(b"J\0\0\x10\0\x85", b"K\0\x85")
EXPANDED_ITEMS = b"".join(b"U\x02%02d" % number + EXPANDED_TENSOR for number in range(20))
SWIN_TENSORS = {"patch_embed.proj.weight": torch.zeros(3)}
MERGING_NAME = "layers.0.downsample.norm.bias"
HEADER_ENTRY = b'{"dtype":"U8","shape":[1],"data_offsets":[0,1]}'


@pytest.mark.parametrize("form", CHECKPOINT_FORMS)
@pytest.mark.parametrize(
    "options", [{}, {"pickle_protocol": 4}, {"_use_new_zipfile_serialization": False}]
)
def test_forms_in_use_load(tmp_path: Path, form: str, options: dict[str, Any]) -> None:
    path = tmp_path / "weights.pth"
    content = CHECKPOINT_FORMS[form]()
    torch.save(content, path, **options)

    weights = read_weights(path)

    entries = content.get("state_dict", content.get("model", content))
    expected = {
        name: value
        for name, value in entries.items()
        if isinstance(name, str) and isinstance(value, torch.Tensor)
    }
    torch.testing.assert_close(dict(weights.tensors), expected, rtol=0, atol=0)


@pytest.mark.parametrize("make_file", [make_zip_file, make_old_file])
def test_the_healthy_file_of_the_hostile_forms_loads(tmp_path: Path, make_file: Any) -> None:
    path = tmp_path / "weights.pth"
    path.write_bytes(make_file(HEALTHY_PICKLE))
    for tensors in (
        read_weights(path).tensors,
        torch.load(path, weights_only=True),
    ):
        assert tensors[TENSOR_NAME].tolist() == [0.0]


def test_items_as_python_2_wrote_them(tmp_path: Path) -> None:
    path = tmp_path / "old.pth"
    items = b"]](U\x0fimg_neck.weight" + tensor_opcodes(b"K\x02\x85", b"K\x01\x85") + b"ea"
    path.write_bytes(make_zip_file(b"ccollections\nOrderedDict\n" + items + b"\x85R."))
    assert list(read_weights(path).tensors) == [TENSOR_NAME]


HOSTILE_VALUES: dict[str, bytes] = {
    "bytearray": b"c__builtin__\nbytearray\n\x8a\x05\0\0\0\0\x02\x85R",
    "a stride of 0": tensor_opcodes(HUGE_TUPLE, b"K\0\x85"),
    "beyond the storage": tensor_opcodes(b"K\x05\x85", ONE_TUPLE),
    "an offset beyond the storage": tensor_opcodes(ONE_TUPLE, ONE_TUPLE, LONG_NUMBER),
    "strides beyond the storage": tensor_opcodes(b"K\x02\x85", LONG_NUMBER + b"\x85"),
    "lengths that overflow": tensor_opcodes(
        b"(" + LONG_NUMBER * 8 + b"t", b"(" + LONG_NUMBER * 8 + b"t"
    ),
    "a length below 0": tensor_opcodes(b"J\xff\xff\xff\xff\x85", ONE_TUPLE),
    "a shape of fractions": tensor_opcodes(b"G" + bytes(8) + b"\x85", ONE_TUPLE),
    "no shape": tensor_opcodes(b"N", ONE_TUPLE),
    "other strides": tensor_opcodes(ONE_TUPLE, b")"),
    "100 dimensions": tensor_opcodes(b"(" + b"K\x01" * 100 + b"t", b"(" + b"K\x01" * 100 + b"t"),
    "code": b"cos\nsystem\nU\x04true\x85R",
    "quantized": b"ctorch._utils\n_rebuild_qtensor\n)R",
    "a whole model": b"ctorch.nn.modules.conv\nConv2d\n)R",
}
"""Opcodes of values in a dict."""
HOSTILE_PICKLES: dict[str, bytes] = {
    "many expanded tensors": b"}(" + EXPANDED_ITEMS + b"u.",
    "another storage": HEALTHY_PICKLE.replace(b"FloatStorage", b"QInt8Storage"),
    "no storage": HEALTHY_PICKLE.replace(b"U\x010U\x03cpu", b"U\x011U\x03cpu"),
    "a view of a storage": HEALTHY_PICKLE.replace(b"K\x04tQ", b"K\x04K\x01tQ"),
    "keys that double": b"}" + DOUBLING_TUPLES + b"Ns.",
    "deep tuples as a key": b"}" + b")" + b"\x85" * 300_000 + b"Ns.",
    "a storage whose name doubles": DOUBLING_TUPLES + HEALTHY_PICKLE.replace(b"U\x010U", b"h\xc7U"),
    "a storage whose kind doubles": (
        DOUBLING_TUPLES + HEALTHY_PICKLE.replace(b"ctorch\nFloatStorage\n", b"h\xc7")
    ),
    "items that double": b"ccollections\nOrderedDict\n]](" + DOUBLING_TUPLES + b"Nea\x85R.",
    "items given to many": PAIR_LIST + b"ccollections\nOrderedDict\nh\0\x85R" * 60_000 + b".",
    "many opcodes": b"]" * 3_000_000 + b".",
    "long numbers as keys": b"}(" + b"\x8a\x20" + b"\x01" * 32 + b"Nu.",
    "text of 1 GiB": b"X\0\0\0\x40x.",
    "text of 2**60 bytes": b"\x8d" + struct.pack("<Q", 1 << 60) + b"x.",
    "a whole number of 2 GiB": b"\x8b\xff\xff\xff\x7f1.",
    "digits": b"I" + b"9" * 4_000_000 + b"\n.",
    "a bytearray of the pickle": b"\x96" + struct.pack("<Q", 1 << 36) + b"x.",
    "a place in the memo": b"Nr\xff\xff\xff\x7fj\xff\xff\xff\x7e.",
    "nothing to take": b"0R.",
    "no end": b"N",
    "a name of a megabyte": b"c" + b"x" * 1_000_000 + b"\ny\n.",
    "what is no function": b"ctorch\nFloatStorage\n)R.",
    "no tensors": b"}.",
    "nested": b"}U\x01a" * 100_000 + b"N" + b"s" * 100_000 + b".",
}
"""Opcodes of whole pickles."""
HOSTILE_FILES: dict[str, bytes] = {
    **{name: make_zip_file(dict_opcodes(value)) for name, value in HOSTILE_VALUES.items()},
    "deflated": make_zip_file(
        dict_opcodes(tensor_opcodes(ONE_TUPLE, ONE_TUPLE)), bytes(1 << 30), zipfile.ZIP_DEFLATED
    ),
    "old, storages that end early": make_old_file(
        HEALTHY_PICKLE, storages=struct.pack("<q", 1 << 40) + bytes(16)
    ),
    "old, storages below 0": make_old_file(
        HEALTHY_PICKLE, storages=struct.pack("<q", -4) + bytes(16)
    ),
    "old, the same storage again": make_old_file(HEALTHY_PICKLE, b"](" + b"U\x010" * 99 + b"e."),
    "old, an unknown storage": make_old_file(HEALTHY_PICKLE, b"](U\x011e."),
    "old, no names": make_old_file(HEALTHY_PICKLE, b"K\x01."),
    "old, bytes that follow": make_old_file(HEALTHY_PICKLE) + b"1",
    "old, cut off": make_old_file(HEALTHY_PICKLE)[:40],
    "old, big-endian": make_old_file(HEALTHY_PICKLE).replace(b"endian\x88", b"endian\x89"),
    "old, storage names that double": make_old_file(
        HEALTHY_PICKLE, b"](" + DOUBLING_TUPLES + b"e."
    ),
    **{name: make_zip_file(pickled) for name, pickled in HOSTILE_PICKLES.items()},
    "no pickle": make_zip_file(b"").replace(b"data.pkl", b"data.txt"),
    "meta": save_to_bytes({TENSOR_NAME: torch.zeros(3, device="meta")}),
    "sparse": save_to_bytes({TENSOR_NAME: torch.eye(3).to_sparse()}),
    "complex": save_to_bytes({TENSOR_NAME: torch.zeros(3, dtype=torch.complex64)}),
    "names that are numbers": save_to_bytes({0: torch.zeros(3), 1: torch.ones(2)}),
    "names that are bytes": save_to_bytes({b"img_neck.weight": torch.zeros(3)}),
    "Swin's, of other shapes": save_to_bytes(SWIN_TENSORS | {MERGING_NAME: torch.zeros(3)}),
    "Swin's, without a shape": save_to_bytes(SWIN_TENSORS | {MERGING_NAME: torch.tensor(1.0)}),
    "Swin's, a long name": save_to_bytes(SWIN_TENSORS | {"x" * 1_000_000: torch.zeros(3)}),
    "a header of 100 MB": make_safetensors(b" " * 100_000_000),
    "a header that is not there": make_safetensors({})[:8] + b"{",
    "a header beyond the file": struct.pack("<Q", 1 << 60) + b"{}",
    "a nested header": make_safetensors(b"[" * 100_000),
    "a header that is no object": make_safetensors([1]),
    "notes of numbers": make_safetensors({"__metadata__": {"deepaccident": 3}}),
    "notes in a list": make_safetensors({"__metadata__": {"deepaccident": "[1]"}}),
    "numbers of an unknown kind": make_safetensors(tensor_header("F4", [2], 1), b"1"),
    "numbers of no kind": make_safetensors(tensor_header("X" * 1_000_000, [2], 2), b"12"),
    "complex safetensors": make_safetensors(tensor_header("C64", [1], 8), bytes(8)),
    "eight bits": make_safetensors(tensor_header("F8_E4M3", [1], 1), bytes(1)),
    "a huge shape": make_safetensors(tensor_header("F32", [1 << 60], 4), bytes(4)),
    "a shape that overflows": make_safetensors(tensor_header("F32", [1 << 40] * 4, 4), bytes(4)),
    "the same name twice": make_safetensors(
        b'{"a":%s,"a":%s}' % (HEADER_ENTRY, HEADER_ENTRY), b"1"
    ),
}

READER_SCRIPT = """
import json, resource, sys, time
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.checkpoint import read_weights
def peak_mb(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
limit = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + (2 << 30)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sys.argv[1:]:
    before, message = peak_mb(), None
    try:
        read_weights(path)
    except ConfigError as error:
        message = str(error)
    except BaseException as error:
        message = repr(error)[:300]
    print(json.dumps([path, message, peak_mb() - before]))
"""


def test_bombs_and_nonsense_are_refused_in_little_memory(tmp_path: Path) -> None:
    """The reader's process has 2 GiB, and no file may raise its peak by more than 300 MB."""
    paths = [str(tmp_path / f"{number}.pth") for number in range(len(HOSTILE_FILES))]
    for path, content in zip(paths, HOSTILE_FILES.values(), strict=True):
        Path(path).write_bytes(content)

    result = subprocess.run(
        [sys.executable, "-c", READER_SCRIPT, *paths],
        capture_output=True,
        text=True,
        check=True,
    )

    refusal = re.compile(r"(?P<path>.*\.pth): (is not|contains no) .*; give .*")
    wrong_reports = {}
    for name, line in zip(HOSTILE_FILES, result.stdout.splitlines(), strict=True):
        path, message, growth_mb = json.loads(line)
        match = refusal.fullmatch(message or "")
        if not match or match["path"] != path or len(message) > 700 or growth_mb > 300:
            wrong_reports[name] = (message, growth_mb)
    assert wrong_reports == {}


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
    write_weights(
        path, {TENSOR_NAME: NUMBERS}, {"preset": "tiny", "fusion": None, "horizon": None, **change}
    )
    assert_raises(
        (
            lambda: load_model(path),
            ConfigError,
            r"does not say which model its weights are for \([^\n]*\); give",
        ),
        (lambda: load_model(path), ConfigError, SHORT_MESSAGE),
    )
