"""The gate: regular files only, none above its kind's limit, no waiting, messages of bounded
length.
"""

import errno
import io
import os
import re
import stat
import struct
import tracemalloc
import zipfile
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from refusals import assert_refused

import deepaccident_devkit
from deepaccident_devkit.errors import shortened
from deepaccident_devkit.support.reading import (
    BYTE_LIMITS,
    DAMAGED_ARCHIVE,
    LIMITS_VARIABLE,
    array_of,
    check_size,
    file_checksum,
    mapped_file,
    open_file,
    open_zip,
    read_array,
    read_bytes,
    read_member,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file"


@pytest.mark.parametrize("impossible", [(), ("pyarrow.memory_map",)])
def test_a_file_is_mapped_or_else_read(
    tmp_path: Path,
    impossible: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Some file systems over FUSE cannot map files (ENODEV)."""
    for name in impossible:
        monkeypatch.setattr(name, Mock(side_effect=OSError(errno.ENODEV, "No such device")))
    for name, content in (("one", os.urandom(70_000)), ("two", b"\xff")):
        (tmp_path / name).write_bytes(content)
        assert memoryview(mapped_file(tmp_path / name)) == memoryview(content).cast("b")
    said = [record.getMessage() for record in caplog.records]
    assert [(str(tmp_path) in each, "--index-dir" in each) for each in said] == [
        (True, True)
    ] * len(impossible)
    assert_refused((lambda: mapped_file(tmp_path / "gone"), FileNotFoundError, "gone"))


def test_a_link_to_a_file_and_one_that_says_it_is_empty_are_read(
    path: Path, tmp_path: Path
) -> None:
    (tmp_path / "there").write_bytes(b"content")
    path.symlink_to("there")
    assert read_bytes(path, "meta") == b"content"
    assert read_bytes(Path("/proc/self/status"), "meta").startswith(b"Name:")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (os.mkfifo, r"not a regular file \(a named pipe\)"),
        (os.mkdir, r"not a regular file \(a folder\)"),
        (lambda path: path.symlink_to("/dev/zero"), r"not a regular file \(a device\)"),
        (lambda path: path.symlink_to(path.name), "symbolic links"),
        (lambda path: os.mknod(path, stat.S_IFSOCK | 0o600), "address|socket"),
    ],
    ids=["pipe", "folder", "device", "loop", "socket"],
)
@pytest.mark.parametrize("read", [lambda path: read_bytes(path, "label"), open_file, mapped_file])
def test_what_is_no_file_is_refused_at_once(path: Path, make, said: str, read) -> None:
    make(path)
    assert_refused((lambda: read(path), OSError, said))


@pytest.mark.parametrize("name", ["a\0b", "\ud800"])
@pytest.mark.parametrize("read", [lambda path: read_bytes(path, "label"), open_file, file_checksum])
def test_what_can_be_no_name_is_said_in_our_words(tmp_path: Path, name: str, read) -> None:
    assert_refused(
        (
            lambda: read(tmp_path / name),
            OSError,
            "cannot be a file's name: it holds a NUL character, or half of a pair",
        )
    )


@pytest.mark.parametrize("kind", BYTE_LIMITS)
def test_a_file_above_its_limit_is_refused_before_it_is_read(path: Path, kind) -> None:
    with path.open("wb") as file:
        file.truncate(BYTE_LIMITS[kind] + 1)  # a sparse file takes no room
    assert_refused(
        (
            lambda: read_bytes(path, kind),
            OSError,
            rf"{BYTE_LIMITS[kind] + 1:,} bytes, more than .* set {LIMITS_VARIABLE}={kind}=\d+M",
        )
    )


def test_a_remedy_that_is_followed_helps(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with path.open("wb") as file:
        file.truncate(BYTE_LIMITS["meta"] + 1)
    with pytest.raises(OSError, match="limit for meta") as raised:
        read_bytes(path, "meta")
    monkeypatch.setenv(*raised.value.strerror.rsplit(" ", 1)[1].split("=", 1))
    assert len(read_bytes(path, "meta")) == BYTE_LIMITS["meta"] + 1


@pytest.mark.parametrize(
    "text", ["label", "label=", "label=0", "labels=3M", "label=3X", "label=-1", "x" * 10_000]
)
def test_limits_that_cannot_be_read_are_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, text)
    with pytest.raises(OSError, match=LIMITS_VARIABLE) as raised:
        check_size(1, "label")
    assert len(raised.value.strerror) < 400


def test_a_long_text_loses_its_middle() -> None:
    long = shortened("begin" + "x" * 10**6 + "end")
    assert (shortened("short"), long[:5], long[-3:], len(long) <= 100) == (
        "short",
        "begin",
        "end",
        True,
    )


OTHER_WAYS_TO_READ = re.compile(
    r"""\.read_(bytes|text)\(|\bnp\.load\(
    |\.open\((?!BytesIO|.*["'][wa]b?["'])|\bZipFile\((?!.*"w")""",
    re.VERBOSE,
)
NOT_OF_STRANGERS = {
    "support/reading.py": "the gate",
    "support/files.py": "the system's processes",
    "plugins/audit/reader.py": "labels that were written a line before",
    "cli/process.py": "nothing: the null device",
    "plugins/synth/demo.py": "the mark of the demo's own folder",
    "evaluation/runs/bundles.py": "counts that were written a line before",
    "plugins/explore/pages/release.py": "the split file that was written a line before",
    "plugins/explore/pages/responses.py": "the package's own styles and scripts",
    "plugins/explore/serving.py": "a browser",
    "export/questions/questions.py": "the parts that the export wrote",
    "statistics/real_facts.py": "the package's own facts",
    "support/cores.py": "the system's limits",
    "support/nuscenes_names.py": "the package's own hints",
    "support/pages.py": "the package's own templates",
    "support/parallel/store.py": "locks, of which nothing is believed",
    "validation/codes.py": "the package's own kinds of findings",
    "validation/croissant.py": "the package's own copy of a context",
    "release/images.py": "the head of an image that the gate opened",
    "release/store/store.py": "the cache's own copies",
    "release/store/sources.py": "fsspec, and the directory of an archive that the "
    "gate or fsspec opened",
    "plugins/synth/benchmark.py": "the package's own benchmarks",
    "plugins/synth/spec/catalogue.py": "the package's own designs",
}


def test_files_are_opened_by_the_gate_alone() -> None:
    package = Path(deepaccident_devkit.__file__).parent
    found = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if path.parts[-2] != "testing" and "breakages" not in path.parts
        for line in path.read_text(encoding="utf-8").splitlines()
        if OTHER_WAYS_TO_READ.search(line)
    }
    assert found == set(NOT_OF_STRANGERS)


# Archives of strangers: bombs are refused before they grow, and bytes that do not agree are told.

ARRAY = np.arange(12, dtype=np.float32).reshape(3, 4)
MOST_MEMORY = 100 << 20


def npz(array: np.ndarray = ARRAY, way: int = zipfile.ZIP_DEFLATED) -> bytes:
    return zipped(npy(array), way)


def npy(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array(content, array)
    return content.getvalue()


def zipped(member: bytes, way: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", way) as archive:
        archive.writestr("data.npy", member)
    return content.getvalue()


def headed(shape: str, dtype: str = "<f4", body: bytes = b"") -> bytes:
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body


def patched(content: bytes, place: int, number: int, length: int = 4) -> bytes:
    """A number written at a place of the entry in the directory."""
    start = content.rindex(b"PK\x01\x02") + place
    return content[:start] + number.to_bytes(length, "little") + content[start + length :]


def flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


def read_npz(content: bytes) -> np.ndarray:
    with open_zip(content) as archive:
        return read_array(archive, "data", "lidar")


@pytest.mark.parametrize("way", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize(
    "array",
    [ARRAY, ARRAY.T, ARRAY[:0], np.array(3), np.array("words"), ARRAY.astype(">i8"), ARRAY > 3],
)
def test_a_sound_array_is_read_as_numpy_reads_it(array: np.ndarray, way: int) -> None:
    content = npz(array, way)
    found = read_npz(content)
    np.testing.assert_array_equal(found, np.load(io.BytesIO(content))["data"], strict=True)
    assert (found.flags.writeable, found.flags.f_contiguous) == (True, array.flags.f_contiguous)


HOSTILE = {
    "zeros that unpack to 256 MB": lambda: zipped(b"\x93NUMPY" + bytes(1 << 28)),
    "a shape of a gigabyte": lambda: zipped(headed("(268435456,)")),
    "a shape of many exabytes": lambda: zipped(
        headed("(4611686018427387904, 4611686018427387904)")
    ),
    "a shape below zero": lambda: zipped(headed("(-1, 4)")),
    "a shape that is no number": lambda: zipped(headed("('x',)")),
    "a nested head": lambda: zipped(headed("(" * 5000 + ")" * 5000)),
    "objects": lambda: zipped(headed("(1,)", "|O", bytes(8))),
    "fields": lambda: zipped(headed("(1,)", "<f4', '<f8", bytes(8))),
    "bytes after the array": lambda: zipped(npy(ARRAY) + b"more"),
    "too few bytes": lambda: zipped(npy(ARRAY)[:-1]),
    "a stored size that is too small": lambda: patched(npz(), 24, 100),
    "a stored size that is too large": lambda: patched(npz(), 24, 10**6),
    "a stored size of gigabytes": lambda: patched(npz(), 24, 0xFFFFFFF0),
    "compressed bytes that end early": lambda: patched(npz(), 20, 30),
    "another checksum": lambda: patched(npz(), 16, 7),
    "another byte": lambda: flipped(npz(way=zipfile.ZIP_STORED), 180),
    "an unknown compression": lambda: patched(npz(), 10, 14, 2),
    "LZMA": lambda: npz(way=zipfile.ZIP_LZMA),
    "encrypted": lambda: patched(npz(), 8, 1, 2),
    "another name": lambda: npz().replace(b"data.npy", b"date.npy", 1),
    "a place outside": lambda: patched(npz(), 42, 10**6),
    "bytes after the archive": lambda: npz() + b"more",
    "bytes before the archive": lambda: b"more" + npz(),
    "a directory of a gigabyte": lambda: npz()[:-10] + struct.pack("<L", 1 << 30) + npz()[-6:],
    "no archive": lambda: b"PK\x03\x04" + bytes(100),
    "nothing": lambda: b"",
    "an end alone": lambda: npz()[-22:],
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_archive_is_refused_in_little_memory(name: str) -> None:
    content = HOSTILE[name]()
    tracemalloc.start()
    with pytest.raises((*DAMAGED_ARCHIVE,)) as raised:
        read_npz(content)
    assert tracemalloc.get_traced_memory()[1] < MOST_MEMORY
    tracemalloc.stop()
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize(
    "content", [patched(zipped(b""), 16, 7), patched(npz(), 24, 0)], ids=["another", "no size"]
)
def test_a_member_without_bytes_has_a_checksum_as_well(content: bytes) -> None:
    with open_zip(content) as archive, pytest.raises(zipfile.BadZipFile, match="CRC"):
        read_member(archive, archive.infolist()[0], "lidar")


def test_an_archive_of_many_members_is_refused() -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for number in range(90_000):
            archive.writestr(f"{number}", b"")
    assert_refused((lambda: open_zip(content.getvalue()), OSError, "directory has"))


def test_an_end_that_leads_to_a_larger_directory_is_refused() -> None:
    content = npz()
    end = content.rindex(b"PK\x05\x06")
    large = b"PK\x06\x06" + struct.pack("<QHHLLQQQQ", 44, 45, 45, 0, 0, 1, 1, 1 << 32, 0)
    rest = b"PK\x06\x07" + struct.pack("<LQL", 0, end, 1) + content[end:]
    assert_refused(
        (
            lambda: open_zip(content[:end] + large + rest),
            OSError,
            ("directory has 4,294,967,296 bytes",),
        ),
        (
            lambda: open_zip(content[:end] + large[:-1] + rest),
            zipfile.BadZipFile,
            ("its end is damaged",),
        ),
        (
            lambda: array_of(b"\x93NUMPY\x09\x00" + bytes(20), "lidar"),
            ValueError,
            ("version (9, 0)",),
        ),
    )
