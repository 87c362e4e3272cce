"""Check that pickles as old and new numpy write them are read, and that pickles that ask for
anything else run nothing.
"""

import functools
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hypothesis_numpy
from support.expected_errors import assert_raises
from support.strategies import mutations

from deepaccident_devkit.errors import CalibError
from deepaccident_devkit.release import pickles, read_calib
from deepaccident_devkit.release.pickles import load_arrays

PROTOCOLS = range(6)
Calibs = dict[str, np.ndarray]


def assert_read_back(path: Path, content: bytes, expected: Calibs) -> None:
    path.write_bytes(content)
    calib = read_calib(path, raw=True)
    assert calib.keys() == expected.keys()
    for key, array in expected.items():
        np.testing.assert_array_equal(calib[key], array, err_msg=key, strict=True)
        assert calib[key].dtype.isnative


def rename_numpy(content: bytes, core: str) -> bytes:
    """Return the pickle as the numpy with this private package (`numpy.core` or `numpy._core`)
    writes it.
    """
    other = "numpy._core" if core == "numpy.core" else "numpy.core"
    for module in ("multiarray", "numeric"):
        old = f"{other}.{module}".encode()
        new = f"{core}.{module}".encode()
        content = content.replace(b"c" + old + b"\n", b"c" + new + b"\n")

        # protocols 4 and 5 write the lengths of the name and of the frame
        old_with_length = b"\x8c" + bytes([len(old)]) + old
        new_with_length = b"\x8c" + bytes([len(new)]) + new
        growth = content.count(old_with_length) * (len(new) - len(old))
        if growth:
            frame_length = int.from_bytes(content[3:11], "little") + growth
            rest = content[11:].replace(old_with_length, new_with_length)
            content = content[:3] + frame_length.to_bytes(8, "little") + rest
    return content


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_protocol_of_both_numpys(
    tmp_path: Path, raw_calib: Calibs, protocol: int, core: str
) -> None:
    content = rename_numpy(pickle.dumps(raw_calib, protocol), core)
    assert f"{core}.".encode() in content
    assert_read_back(tmp_path / "calib.pkl", content, raw_calib)


def make_python2_pickle(raw: Calibs) -> bytes:
    """Write protocol 2 as Python 2 and its numpy did: keys, dtypes and contents are byte
    strings.
    """

    def dump_string(text: bytes) -> bytes:
        return b"T" + len(text).to_bytes(4, "little") + text

    def dump_array(array: np.ndarray) -> bytes:
        rows, columns = array.shape
        dtype = b"cnumpy\ndtype\n" + dump_string(b"f8") + b"K\x00K\x01\x87R"
        dtype += b"(K\x03" + dump_string(b"<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        empty = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85"
        empty += dump_string(b"b") + b"\x87R"
        shape = b"K" + bytes([rows]) + b"K" + bytes([columns]) + b"\x86"
        numbers = dump_string(array.astype("<f8").tobytes())
        return empty + b"(K\x01" + shape + dtype + b"\x89" + numbers + b"tb"

    items = [dump_string(key.encode()) + dump_array(array) for key, array in raw.items()]
    return b"\x80\x02}(" + b"".join(items) + b"u."


def test_a_python_2_pickle(tmp_path: Path, raw_calib: Calibs) -> None:
    content = make_python2_pickle(raw_calib)
    by_python = pickle.loads(rename_numpy(content, "numpy.core"), encoding="latin1")
    np.testing.assert_array_equal(by_python["ego_to_world"], raw_calib["ego_to_world"])
    assert_read_back(tmp_path / "calib.pkl", content, raw_calib)


class Call:
    """Call a function when the pickle of this object is read."""

    def __init__(self, function: Callable, *arguments: object) -> None:
        self.function = function
        self.arguments = arguments

    def __reduce__(self) -> tuple:
        return self.function, self.arguments

    def __call__(self) -> None:
        """Do nothing; a call's result may be called in turn."""


def make_attacks(flag: str) -> dict[str, Call]:
    """Return objects that make the file `flag` when a plain unpickler reads them."""
    code = f"open({flag!r}, 'w').close()"
    system = Call(getattr, Call(__import__, "os"), "system")
    return {
        "os.system": Call(os.system, f"touch '{flag}'"),
        "builtins.eval": Call(eval, code),
        "builtins.exec": Call(exec, code),
        "subprocess": Call(subprocess.call, ["touch", flag]),
        "os.mkdir": Call(os.mkdir, flag),
        "numpy.save": Call(np.save, flag + ".npy", 1),
        "numpy.ndarray.tofile": Call(np.ndarray.tofile, np.zeros(1), flag),
        "getattr-chain": Call(system, f"touch '{flag}'"),
        "functools.partial": Call(functools.partial(os.system, f"touch '{flag}'")),
        "nested-in-an-array": Call(list, [Call(os.system, f"touch '{flag}'")]),
    }


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", list(make_attacks("")))
def test_an_attack_runs_nothing(
    tmp_path: Path, raw_calib: Calibs, name: str, protocol: int
) -> None:
    folder = tmp_path / "made"
    folder.mkdir()
    path = tmp_path / "calib.pkl"
    attack = make_attacks(str(folder / "flag"))[name]
    pattern = rf"^{path}: not a readable calibration \(.*not allowed\); restore"
    for raw in ({**raw_calib, "more": attack}, {"first": attack, **raw_calib}, attack, [attack]):
        path.write_bytes(pickle.dumps(raw, protocol))
        with pytest.raises(CalibError, match=pattern):
            read_calib(path)
        assert list(folder.iterdir()) == []

    pickle.loads(path.read_bytes())
    assert list(folder.iterdir()), "the attack itself does not work, so refusing it shows nothing"


# opcodes: c name, S text, V unicode, ( mark, t tuple, R call, i and o call a class, b build, 0 pop,
# . stop
SYSTEM = b"cposix\nsystem\n"
RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
NDARRAY = b"cnumpy\nndarray\n"
DTYPE = b"cnumpy\ndtype\n"
FROMBUFFER = b"cnumpy.core.numeric\n_frombuffer\n"
ENCODE = b"c_codecs\nencode\n"
EMPTY_ARRAY = RECONSTRUCT + b"(" + NDARRAY + b"(I0\ntVb\ntR"
F8 = DTYPE + b"(Vf8\ntR"


def make_array_pickle(*shape: bytes, content: bytes = b"C\x08eight ok") -> bytes:
    """Pickle a dict with an array of float64; its shape is given in opcodes."""
    lengths = b"".join(shape)
    state = b"(K\x01(" + lengths + b"t" + F8 + b"\x89" + content + b"tb"
    return b"}Va\n" + EMPTY_ARRAY + state + b"s."


HOSTILE = {
    "system": SYSTEM + b"(Vtouch FLAG\ntR.",
    "system by INST": b"(Vtouch FLAG\niposix\nsystem\n.",
    "system by OBJ": b"(" + SYSTEM + b"Vtouch FLAG\no.",
    "system by STACK_GLOBAL": b"\x80\x04\x8c\x05posix\x8c\x06system\x93(Vtouch FLAG\ntR.",
    "dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0fndarray.tofile\x93.",
    "dotted to globals": b"\x80\x04\x8c\x07_codecs\x8c\x0fencode.__self__\x93.",
    "extension registry": b"\x80\x02\x82\x01.",
    "extension registry, four bytes": b"\x80\x02\x84\x01\x00\x00\x00.",
    "persistent id": b"Pposix.system\n.",
    "persistent id, binary": b"\x80\x02Vposix.system\nQ.",
    "out-of-band buffer": b"\x80\x05\x97.",
    "read-only buffer": b"\x80\x05C\x01x\x98.",
    "class of a stand-in": b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.",
    "copyreg": b"ccopyreg\n_reconstructor\n(" + NDARRAY + b"c__builtin__\nobject\nNtR.",
    "copy_reg": b"ccopy_reg\n_reconstructor\n(" + NDARRAY + b"c__builtin__\nobject\nNtR.",
    "add_extension": b"ccopyreg\nadd_extension\n(Vposix\nVsystem\nI1\ntR.",
    "partial": b"cfunctools\npartial\n(" + SYSTEM + b"Vtouch FLAG\ntR(tR.",
    "numpy.load": b"cnumpy\nload\n(VFLAG\ntR.",
    "numpy scalar": b"cnumpy.core.multiarray\nscalar\n(" + F8 + b"Vxxxxxxxx\ntR.",
    "numpy.core.multiarray.fromfile": b"cnumpy.core.multiarray\nfromfile\n(VFLAG\ntR.",
    "calling ndarray": NDARRAY + b"((I2\ntVf8\ntR.",
    "calling ndarray by NEWOBJ": b"\x80\x02" + NDARRAY + b"(I2\n\x85\x81.",
    "calling a stand-in by NEWOBJ": b"\x80\x02" + DTYPE + b"(Vf8\nt\x81.",
    "calling a stand-in by NEWOBJ_EX": b"\x80\x04" + DTYPE + b"(Vf8\nt}\x92.",
    "calling the array": EMPTY_ARRAY + b"(tR.",
    "calling the dtype": F8 + b"(tR.",
    "calling text": b"Vtext\n(tR.",
    "rebuilding another class": RECONSTRUCT + b"(c__builtin__\nobject\n(I0\ntVb\ntR.",
    "rebuilding a dtype": RECONSTRUCT + b"(" + F8 + b"(I0\ntVb\ntR.",
    "object dtype": DTYPE + b"(VO\ntR.",
    "object dtype, numpy's spelling": DTYPE + b"(VO8\nI00\nI01\ntR.",
    "record with objects": DTYPE + b"(Vf8,O\ntR.",
    "dtype from a list": DTYPE + b"((lp0\n(Va\nVO\ntatR.",
    "dtype from a dict": DTYPE + b"((dVnames\n(lstR.",
    "dtype from a name": DTYPE + b"(" + NDARRAY + b"tR.",
    "dtype with a shape": DTYPE + b"(V(1000000,1000000)f8\ntR.",
    "dtype with a leading zero": DTYPE + b"(V010f8\ntR.",
    "dtype of commas": DTYPE + b"(V,\ntR.",
    "dtype with two counts": DTYPE + b"(V1 2f8\ntR.",
    "dtype of an old alias": DTYPE + b"(Va8\ntR.",
    "dates": DTYPE + b"(VM8[s]\ntR.",
    "encode by another codec": ENCODE + b"(Vtext\nVidna\ntR.",
    "encode to bytes by a path": ENCODE + b"(Vtext\nV../../evil\ntR.",
    "encode an array": ENCODE + b"(" + EMPTY_ARRAY + b"Vlatin1\ntR.",
    "array of a list": EMPTY_ARRAY + b"(I1\n(I1\nt" + F8 + b"I00\n(lI1\natb.",
    "array state too short": EMPTY_ARRAY + b"(I1\ntb.",
    "array state no tuple": EMPTY_ARRAY + b"I1\nb.",
    "dtype state too short": F8 + b"(I3\ntb.",
    "dtype state no byte order": F8 + b"(I3\nVsideways\ntb.",
    "setting an attribute of a function": RECONSTRUCT + b"(dV__call__\n" + SYSTEM + b"sb.",
    "setting a slot of a function": RECONSTRUCT + b"(N(dV__call__\nVx\nstb.",
    "setting a slot of ndarray": NDARRAY + b"(N(dV__class__\nVx\nstb.",
    "setting a slot of dtype": DTYPE + b"(N(dV__setstate__\nVx\nstb.",
    "setting the class of the encoder": ENCODE + b"(N(dV__class__\n" + NDARRAY + b"stb.",
    "building a dict": b"(d(dV__class__\nVx\nsb.",
    "building text": b"Vtext\n(N(dV__class__\nVx\nstb.",
    "frombuffer of an array": FROMBUFFER + b"(" + EMPTY_ARRAY + F8 + b"(I1\ntVC\ntR.",
    "frombuffer of objects": FROMBUFFER + b"(C\x08xxxxxxxx" + DTYPE + b"(VO\ntR(I1\ntVC\ntR.",
    "too few arguments": DTYPE + b"(tR.",
    "too many arguments": RECONSTRUCT + b"(" + NDARRAY * 9 + b"tR.",
    "pop from nothing": b"0000.",
    "no stop": b"(d",
    "nothing but a stop": b".",
    "unknown protocol": b"\x80\xff}.",
    "a frame longer than the file": b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f}.",
    "bytes longer than the file": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "many nested lists": b"(" + b"]" * 100_000 + b"t.",
    "no module": b"c\n\n.",
    "no text": b"cnumpy\n\xff\xfe\n.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_opcodes(tmp_path: Path, raw_calib: Calibs, name: str) -> None:
    flag = tmp_path / "flag"
    path = tmp_path / "calib.pkl"
    path.write_bytes(HOSTILE[name].replace(b"FLAG", bytes(flag)))

    pattern = rf"(?s)^{path}: .*; restore the file from its archive$"
    assert_raises((lambda: read_calib(path), CalibError, pattern))
    assert not flag.exists()
    # nothing of it stays behind in the stand-ins
    assert_read_back(path, pickle.dumps(raw_calib, 2), raw_calib)


@pytest.mark.parametrize(
    "array",
    [
        np.array([None]),
        np.array(["text"]),
        np.array([b"x"]),
        np.zeros(2, "f8,f8"),
        np.zeros(2, "M8[s]"),
        np.array([1j]),
    ],
    ids=lambda array: array.dtype.str,
)
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays_of_other_than_numbers_are_refused(
    tmp_path: Path, raw_calib: Calibs, array: np.ndarray, protocol: int
) -> None:
    path = tmp_path / "calib.pkl"
    path.write_bytes(pickle.dumps({**raw_calib, "ego_to_world": array}, protocol))
    assert_raises((lambda: read_calib(path), CalibError, rf"^{path}: .*restore"))


def pack_int4(number: int) -> bytes:
    return number.to_bytes(4, "little")


def wrap_in_dict(*values: bytes) -> bytes:
    """Return a protocol 4 pickle of a dict of these values."""
    items = [b"V%d\n" % key + value for key, value in enumerate(values)]
    return b"\x80\x04}(" + b"".join(items) + b"u."


LONG_TEXT = b"X" + pack_int4(800_000) + b"x" * 800_000
LONG_BYTES = b"B" + pack_int4(800_000) + bytes(800_000)
# the hash of the last one, and its text in a message, visit 2 ** 60 tuples
DOUBLING = b"N\x85q\x00" + b"".join(b"h%ch%c\x86q%c" % (n, n, n + 1) for n in range(60))
MEMO_BOMB = b"r\xff\xff\xff\x0f"
# A reader of frames that has 1 byte left in one, and needs 4, goes to the 4 bytes after the frame:
# it would take the number's last 3 bytes and the opcode C, and then run C's contents.
FRAME_TRICK = b"V0\n\x95\x02" + bytes(7) + b"J\x00" + bytes(3) + b"C(N" + MEMO_BOMB.ljust(39, b"0")
BOMBS = {
    "deep key": (
        b"\x80\x02})" + b"\x85" * 1_000_000 + b"Ns.",
        "byte 10,000: more than 10,000 opcodes",
    ),
    "deep key, short": (
        b"\x80\x02})" + b"\x85" * 9_000 + b"Ns.",
        "a key that is neither text nor a whole number",
    ),
    "deep list": (
        wrap_in_dict(b"]" * 4_900 + b"a" * 4_899),
        "more than 20 containers within each other",
    ),
    "deep dict": (
        wrap_in_dict(b"}Va\n" * 3_000 + b"N" + b"s" * 3_000),
        "more than 20 containers within each other",
    ),
    "tuple as a key": (b"})Ns.", "a key that is neither text nor a whole number"),
    "array as a key": (
        b"}" + EMPTY_ARRAY + b"Ns.",
        "a key that is neither text nor a whole number",
    ),
    "number as a key within": (wrap_in_dict(b"}K\x01K\x02s"), "a key that is not text, or"),
    "doubling key": (
        b"}(Va\n(" + DOUBLING + b"th\x3cNu.",
        "a key that is neither text nor a whole number",
    ),
    "doubling dtype": (
        b"}(Va\n(" + DOUBLING + b"tVb\n" + DTYPE + b"h\x3c\x85Ru.",
        "an array of a value that is not text",
    ),
    "doubling value": (
        b"}(Va\n(" + DOUBLING + b"h\x10tu.",
        "values that are far larger than their pickle",
    ),
    "list in itself": (wrap_in_dict(b"]q\x00h\x00a"), "more than 20 containers within each other"),
    "dict in itself": (b"}q\x00Va\nh\x00s.", "more than 20 containers within each other"),
    "list in itself twice": (
        wrap_in_dict(b"]q\x00(h\x00h\x00e"),
        "more than 20 containers within each other",
    ),
    "memo": (b"\x80\x02}" + MEMO_BOMB + b".", "lacks lidar_to_ego"),
    "memo by text": (b"}p99999999999\n.", "lacks lidar_to_ego"),
    "memo by a word": (b"}pno\n.", "not a readable calibration"),
    "empty place": (b"}g0\n.", "taking from an empty place in the memo"),
    "frame trick": (b"\x80\x04}(" + FRAME_TRICK + b"\x86u.", "lacks lidar_to_ego"),
    "many marks": (b"(" * 1_000_000, "byte 9,999: more than 10,000 opcodes"),
    "many nones": (b"(" + b"N" * 1_000_000 + b"l.", "more than 10,000 opcodes"),
    "many lists": (b"(" + b"]" * 1_000_000 + b"l.", "more than 10,000 opcodes"),
    "many entries": (b"}(" + b"Vkey\nN" * 100_000 + b"u.", "more than 10,000 opcodes"),
    "long whole number": (
        b"I" + b"7" * 1_000_000 + b"\n.",
        "byte 0: a number of 1,000,000 characters",
    ),
    "long Python 2 number": (b"L" + b"7" * 1_000_000 + b"L\n.", "a number of 1,000,001 characters"),
    "long fraction": (b"F" + b"7" * 1_000_000 + b"\n.", "a number of 1,000,000 characters"),
    "number of bytes": (
        b"\x8b" + pack_int4(1_000_000) + b"\x7f" * 1_000_000 + b".",
        "the opcode LONG4 is not allowed",
    ),
    "text of 8 GiB": (
        b"\x8d" + (1 << 33).to_bytes(8, "little") + b".",
        "the opcode BINUNICODE8 is not allowed",
    ),
    "bytes of 8 GiB": (
        b"\x8e" + (1 << 33).to_bytes(8, "little") + b".",
        "the opcode BINBYTES8 is not allowed",
    ),
    "bytes of 4 GiB": (b"B" + pack_int4(0xFFFFFFFF) + b".", "byte 0: the pickle ends too early"),
    "text of 4 GiB": (b"X" + pack_int4(0xFFFFFFFF) + b".", "byte 0: the pickle ends too early"),
    "byte array of 800 MB": (
        b"\x96" + (800_000_000).to_bytes(8, "little") + b".",
        "byte 0: the pickle ends too early",
    ),
    "frame of 800 MB": (
        b"\x95" + (800_000_000).to_bytes(8, "little") + b"}.",
        "not a readable calibration",
    ),
    "name without end": (b"c" + b"x" * 1_000_000, "byte 0: the pickle ends too early"),
    "set": (b"\x80\x04\x8f.", "the opcode EMPTY_SET is not allowed"),
    "duplicate": (b"}2.", "the opcode DUP is not allowed"),
    "text encoded again and again": (
        wrap_in_dict(ENCODE + b"q\x00" + LONG_TEXT + b"q\x01\x85R", *[b"h\x00h\x01\x85R"] * 1_900),
        "values that are far larger than their pickle",
    ),
    "array again and again": (
        wrap_in_dict(
            EMPTY_ARRAY
            + b"(K\x01(J"
            + pack_int4(100_000)
            + b"t"
            + F8
            + b"\x89"
            + LONG_BYTES
            + b"tbq\x00",
            *[b"h\x00"] * 4_900,
        ),
        "values that are far larger than their pickle",
    ),
    "dict of a long key again and again": (
        wrap_in_dict(b"}q\x00" + LONG_TEXT + b"Ns", *[b"h\x00"] * 4_900),
        "values that are far larger than their pickle",
    ),
    "shape of text": (
        wrap_in_dict(
            EMPTY_ARRAY + b"(K\x01X" + pack_int4(800_000) + b"x" * 800_000 + F8 + b"\x89C\x00tb"
        ),
        "not a readable calibration",
    ),
    "long name": (b"cposix\n" + b"x" * 1_000_000 + b"\n.", "the pickle asks for posix.xxx"),
    "long dtype": (DTYPE + b"(" + LONG_TEXT + b"tR.", "an array of 'xxx"),
    "long attribute": (
        wrap_in_dict(F8 + b"(N(d" + LONG_TEXT + b"Nstb"),
        "an array of numbers with parts",
    ),
    "name that changes the screen": (
        b"cposix\n\x1b[2J\n.",
        r"the pickle asks for posix.\x1b[2J, which",
    ),
    "name with half a character": (
        b"\x80\x04\x8c\x05posix\x8c\x03\xed\xa0\x80\x93.",
        r"asks for posix.\ud800, which",
    ),
    "key that changes the screen": (
        b"}V\x1b[2J\nNs.",
        "a key that is not text, or cannot be printed",
    ),
    "shape with a hole": (
        make_array_pickle(b"J\xff\xff\xff\xff"),
        "shape that does not match its bytes",
    ),
    "shape beyond its bytes": (
        make_array_pickle(b"J\xff\xff\xff\x7f", b"J\xff\xff\xff\x7f"),
        "cannot reshape array of size 1",
    ),
    "shape of a huge number": (
        make_array_pickle(b"\x8a\xff" + b"\x7f" * 255),
        "not a readable calibration",
    ),
    "shape of nothing": (make_array_pickle(b"N"), "not a readable calibration"),
    "shape of fractions": (make_array_pickle(b"F1.0\n"), "not a readable calibration"),
    "shape of many lengths": (make_array_pickle(*[b"K\x01"] * 9_000), "not a readable calibration"),
    "part of a number": (
        make_array_pickle(b"K\x01", content=b"C\x07sevenoh"),
        "buffer size must be a multiple",
    ),
    "array without numbers": (
        wrap_in_dict(EMPTY_ARRAY),
        "an array without its numbers is not allowed",
    ),
    "dtype as a value": (wrap_in_dict(F8), "a part of numpy instead of a value is not allowed"),
    "class as a value": (
        wrap_in_dict(NDARRAY),
        "a part of numpy instead of a value is not allowed",
    ),
}


@pytest.fixture(scope="module")
def bomb_outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """Read each bomb in a process with 1 GiB and a minute, and return what became of it."""
    pytest.importorskip("resource")
    folder = tmp_path_factory.mktemp("bombs")
    paths = []
    for number, (content, _) in enumerate(BOMBS.values()):
        path = folder / f"{number}.pkl"
        path.write_bytes(content)
        paths.append(path)

    script = Path(__file__).parents[2] / "support" / "calib_reader_process.py"
    process = subprocess.run(
        [sys.executable, script, *paths], capture_output=True, text=True, check=True
    )
    outcomes = [json.loads(line) for line in process.stdout.splitlines()]
    return dict(zip(BOMBS, outcomes, strict=True))


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_named_in_little_memory(bomb_outcomes: dict[str, dict], name: str) -> None:
    outcome = bomb_outcomes[name]
    assert outcome["status"] == 0, "the process has crashed, or was killed after a minute"
    assert BOMBS[name][1] in outcome["message"]
    assert len(outcome["message"]) < 600
    assert outcome["message"].isprintable()
    assert outcome["peak"] < 50e6


@pytest.fixture
def _little_memory():
    """Limit the memory, so that a damaged length fails instead of filling the machine's."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    used_bytes = pages * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used_bytes + 2**30, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


PIECES = [
    *(RECONSTRUCT, NDARRAY, DTYPE, FROMBUFFER, ENCODE, SYSTEM, EMPTY_ARRAY, F8),
    *(
        b"(",
        b"t",
        b"R",
        b"b",
        b"d",
        b"l",
        b"s",
        b"a",
        b"u",
        b"e",
        b"0",
        b"1",
        b"2",
        b".",
        b"N",
        b"\x81",
        b"\x92",
        b"o",
    ),
    *(
        b"Vlatin1\n",
        b"Vf8\n",
        b"V__class__\n",
        b"I1\n",
        b"I01\n",
        b"C\x08abcdefgh",
        b"p0\n",
        b"g0\n",
        b"\x85",
        b"\x86",
    ),
    *(
        b"\x80\x04",
        b"\x8c\x05numpy",
        b"\x8c\x05dtype",
        b"\x93",
        b"}",
        b"]",
        b")",
        b"\x8f",
        b"\x90",
        b"\x91",
        b"\x98",
    ),
]


@pytest.mark.usefixtures("_little_memory")
@settings(max_examples=150)
@given(data=st.data(), protocol=st.sampled_from(PROTOCOLS))
def test_damage_raises_our_error_or_nothing(
    tmp_path_factory: pytest.TempPathFactory,
    raw_calib: Calibs,
    outcome,
    data: st.DataObject,
    protocol: int,
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.pkl"
    path.write_bytes(data.draw(mutations(pickle.dumps(raw_calib, protocol))))
    _, message = outcome(CalibError, read_calib, path)
    assert message is None or message.startswith(f"{path}: ")


@pytest.mark.usefixtures("_little_memory")
@settings(max_examples=200)
@given(pieces=st.lists(st.sampled_from(PIECES), max_size=25))
def test_random_programs_raise_our_error(
    tmp_path_factory: pytest.TempPathFactory, pieces: list[bytes]
) -> None:
    path = tmp_path_factory.getbasetemp() / "program.pkl"
    path.write_bytes(b"".join(pieces) + b".")
    assert_raises((lambda: read_calib(path), CalibError, r"program\.pkl: "))


@settings(max_examples=60)
@given(
    arrays=st.dictionaries(
        st.text(st.characters(exclude_categories=["C", "Z"])),
        hypothesis_numpy.arrays(
            st.sampled_from(
                [
                    order + code
                    for order in "<>"
                    for code in ("f2", "f4", "f8", "i2", "i8", "u4", "u1", "b1")
                ]
            ),
            hypothesis_numpy.array_shapes(max_dims=4, max_side=4),
        ),
        max_size=5,
    ),
    protocol=st.sampled_from(PROTOCOLS),
    fortran=st.booleans(),
)
def test_all_arrays_are_read_back(arrays: Calibs, protocol: int, *, fortran: bool) -> None:
    if fortran:
        arrays = {key: np.asfortranarray(array) for key, array in arrays.items()}
    content = pickle.dumps({**arrays, "again": list(arrays.values())}, protocol)

    loaded = load_arrays(content)

    for copy, key in zip(loaded.pop("again"), arrays, strict=True):
        np.testing.assert_array_equal(copy, loaded[key], strict=True)
        assert not np.shares_memory(copy, loaded[key])
    assert list(loaded) == list(arrays)
    for key, array in arrays.items():
        native = array.astype(array.dtype.newbyteorder("="))
        np.testing.assert_array_equal(loaded[key], native, strict=True)


def try_loading(content: bytes) -> Calibs | str:
    try:
        return load_arrays(content)
    except pickle.UnpicklingError as error:
        return str(error)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_changed_bytes_are_refused_or_read_as_python_reads_them(
    raw_calib: Calibs, monkeypatch: pytest.MonkeyPatch, protocol: int
) -> None:
    raw = {key: raw_calib[key] for key in ("ego_to_world", "intrinsic_Camera_Back")}
    content = pickle.dumps(raw, protocol)
    load_arrays(content)
    known_layouts = list(pickles.layouts)
    generator = np.random.default_rng(protocol)
    readable_count = 0
    for _ in range(200):
        damaged = bytearray(content)
        for position in generator.integers(len(content), size=generator.integers(1, 3)):
            damaged[position] = generator.integers(256)
        monkeypatch.setattr(pickles, "layouts", [])
        without_layouts = try_loading(bytes(damaged))
        monkeypatch.setattr(pickles, "layouts", list(known_layouts))
        with_layouts = try_loading(bytes(damaged))

        if isinstance(without_layouts, str):
            assert with_layouts == without_layouts
        elif isinstance(without_layouts, dict):
            readable_count += 1
            try:
                by_python = pickle.loads(bytes(damaged), encoding="latin1")
            except (TypeError, ValueError, Warning):
                continue  # what numpy writes of empty arrays is not looked at here
            assert list(without_layouts) == list(with_layouts) == list(by_python)
            for key, array in by_python.items():
                np.testing.assert_array_equal(without_layouts[key], array)
                np.testing.assert_array_equal(with_layouts[key], array)
    assert readable_count > 10
