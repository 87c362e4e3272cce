"""Reading of files: only regular ones, none above the limit of its kind, no waiting, and errors of
bounded length.
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
from support.expected_errors import assert_raises

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


@pytest.mark.parametrize("failing_calls", [(), ("pyarrow.memory_map",)])
def test_a_file_is_mapped_or_otherwise_read(
    tmp_path: Path,
    failing_calls: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Some file systems over FUSE cannot map files (ENODEV)."""
    for name in failing_calls:
        monkeypatch.setattr(name, Mock(side_effect=OSError(errno.ENODEV, "No such device")))
    for name, content in (("one", os.urandom(70_000)), ("two", b"\xff")):
        (tmp_path / name).write_bytes(content)
        assert memoryview(mapped_file(tmp_path / name)) == memoryview(content).cast("b")
    messages = [record.getMessage() for record in caplog.records]

    assert len(messages) == len(failing_calls)
    for message in messages:
        assert str(tmp_path) in message
        assert "--index-dir" in message
    assert_raises((lambda: mapped_file(tmp_path / "gone"), FileNotFoundError, "gone"))


def test_a_link_and_a_file_that_claims_to_be_empty_are_read(path: Path, tmp_path: Path) -> None:
    (tmp_path / "there").write_bytes(b"content")
    path.symlink_to("there")
    assert read_bytes(path, "meta") == b"content"
    assert read_bytes(Path("/proc/self/status"), "meta").startswith(b"Name:")


@pytest.mark.parametrize(
    ("make_path", "message"),
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
def test_a_path_that_is_no_file_is_refused_at_once(
    path: Path, make_path, message: str, read
) -> None:
    make_path(path)
    assert_raises((lambda: read(path), OSError, message))


@pytest.mark.parametrize("name", ["a\0b", "\ud800"])
@pytest.mark.parametrize("read", [lambda path: read_bytes(path, "label"), open_file, file_checksum])
def test_a_text_that_cannot_be_a_files_name_is_refused(tmp_path: Path, name: str, read) -> None:
    assert_raises(
        (
            lambda: read(tmp_path / name),
            OSError,
            "cannot be a file name: it contains a NUL character, or half of a surrogate pair",
        )
    )


@pytest.mark.parametrize("kind", BYTE_LIMITS)
def test_a_file_above_its_limit_is_refused_before_it_is_read(path: Path, kind) -> None:
    with path.open("wb") as file:
        file.truncate(BYTE_LIMITS[kind] + 1)  # a sparse file takes no room
    assert_raises(
        (
            lambda: read_bytes(path, kind),
            OSError,
            rf"{BYTE_LIMITS[kind] + 1:,} bytes, more than .* set {LIMITS_VARIABLE}={kind}=\d+M",
        )
    )


def test_following_the_remedy_of_an_error_helps(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with path.open("wb") as file:
        file.truncate(BYTE_LIMITS["meta"] + 1)
    with pytest.raises(OSError, match="limit for meta") as raised:
        read_bytes(path, "meta")
    remedy = raised.value.strerror.rsplit(" ", 1)[1]
    monkeypatch.setenv(*remedy.split("=", 1))
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
    text = shortened("begin" + "x" * 10**6 + "end")
    assert shortened("short") == "short"
    assert text.startswith("begin")
    assert text.endswith("end")
    assert len(text) <= 100


DIRECT_READ = re.compile(
    r"""\.read_(bytes|text)\(|\bnp\.load\(
    |\.open\((?!BytesIO|.*["'][wa]b?["'])|\bZipFile\((?!.*"w")""",
    re.VERBOSE,
)
TRUSTED_READS = {
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
    "support/human_names.py": "the package's own names",
    "support/nuscenes_names.py": "the package's own hints",
    "support/pages.py": "the package's own templates",
    "support/parallel/store.py": "locks, whose content is not trusted",
    "validation/codes.py": "the package's own kinds of findings",
    "validation/croissant.py": "the package's own copy of a context",
    "release/images.py": "the head of an image that the gate opened",
    "release/store/store.py": "the cache's own copies",
    "release/store/sources.py": "fsspec, and the directory of an archive that the "
    "gate or fsspec opened",
    "plugins/synth/benchmark.py": "the package's own benchmarks",
    "plugins/synth/spec/catalogue.py": "the package's own designs",
}


def test_only_the_reading_module_opens_files_of_strangers() -> None:
    package = Path(deepaccident_devkit.__file__).parent
    modules = set()
    for path in package.rglob("*.py"):
        if path.parts[-2] == "testing" or "breakages" in path.parts:
            continue
        lines = path.read_text(encoding="utf-8").splitlines()
        if any(DIRECT_READ.search(line) for line in lines):
            modules.add(path.relative_to(package).as_posix())

    assert modules == set(TRUSTED_READS)


# Archives of strangers: bombs are refused before they unpack, and inconsistent bytes are errors.

ARRAY = np.arange(12, dtype=np.float32).reshape(3, 4)
MAX_MEMORY_BYTES = 100 << 20


def make_npz(array: np.ndarray = ARRAY, compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    return zip_member(make_npy(array), compression)


def make_npy(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array(content, array)
    return content.getvalue()


def zip_member(member: bytes, compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", compression) as archive:
        archive.writestr("data.npy", member)
    return content.getvalue()


def make_npy_with_header(shape: str, dtype: str = "<f4", body: bytes = b"") -> bytes:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    magic = b"\x93NUMPY\x01\x00"
    return magic + struct.pack("<H", len(header)) + header + body


def patch_directory(content: bytes, offset: int, number: int, length: int = 4) -> bytes:
    """Write a number at an offset of the entry in the directory."""
    start = content.rindex(b"PK\x01\x02") + offset
    return content[:start] + number.to_bytes(length, "little") + content[start + length :]


def flip_bit(content: bytes, offset: int) -> bytes:
    changed = bytearray(content)
    changed[offset] ^= 1
    return bytes(changed)


def read_npz(content: bytes) -> np.ndarray:
    with open_zip(content) as archive:
        return read_array(archive, "data", "lidar")


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize(
    "array",
    [ARRAY, ARRAY.T, ARRAY[:0], np.array(3), np.array("words"), ARRAY.astype(">i8"), ARRAY > 3],
)
def test_a_sound_array_is_read_as_numpy_reads_it(array: np.ndarray, compression: int) -> None:
    content = make_npz(array, compression)
    result = read_npz(content)
    expected = np.load(io.BytesIO(content))["data"]
    np.testing.assert_array_equal(result, expected, strict=True)
    assert result.flags.writeable
    assert result.flags.f_contiguous == array.flags.f_contiguous


HOSTILE_ARCHIVES = {
    "zeros that unpack to 256 MB": lambda: zip_member(b"\x93NUMPY" + bytes(1 << 28)),
    "a shape of a gigabyte": lambda: zip_member(make_npy_with_header("(268435456,)")),
    "a shape of many exabytes": lambda: zip_member(
        make_npy_with_header("(4611686018427387904, 4611686018427387904)")
    ),
    "a shape below zero": lambda: zip_member(make_npy_with_header("(-1, 4)")),
    "a shape that is no number": lambda: zip_member(make_npy_with_header("('x',)")),
    "a nested head": lambda: zip_member(make_npy_with_header("(" * 5000 + ")" * 5000)),
    "objects": lambda: zip_member(make_npy_with_header("(1,)", "|O", bytes(8))),
    "fields": lambda: zip_member(make_npy_with_header("(1,)", "<f4', '<f8", bytes(8))),
    "bytes after the array": lambda: zip_member(make_npy(ARRAY) + b"more"),
    "too few bytes": lambda: zip_member(make_npy(ARRAY)[:-1]),
    "a stored size that is too small": lambda: patch_directory(make_npz(), 24, 100),
    "a stored size that is too large": lambda: patch_directory(make_npz(), 24, 10**6),
    "a stored size of gigabytes": lambda: patch_directory(make_npz(), 24, 0xFFFFFFF0),
    "compressed bytes that end early": lambda: patch_directory(make_npz(), 20, 30),
    "another checksum": lambda: patch_directory(make_npz(), 16, 7),
    "another byte": lambda: flip_bit(make_npz(compression=zipfile.ZIP_STORED), 180),
    "an unknown compression": lambda: patch_directory(make_npz(), 10, 14, 2),
    "LZMA": lambda: make_npz(compression=zipfile.ZIP_LZMA),
    "encrypted": lambda: patch_directory(make_npz(), 8, 1, 2),
    "another name": lambda: make_npz().replace(b"data.npy", b"date.npy", 1),
    "a place outside": lambda: patch_directory(make_npz(), 42, 10**6),
    "bytes after the archive": lambda: make_npz() + b"more",
    "bytes before the archive": lambda: b"more" + make_npz(),
    "a directory of a gigabyte": lambda: (
        make_npz()[:-10] + struct.pack("<L", 1 << 30) + make_npz()[-6:]
    ),
    "no archive": lambda: b"PK\x03\x04" + bytes(100),
    "nothing": lambda: b"",
    "only an end": lambda: make_npz()[-22:],
}


@pytest.mark.parametrize("name", HOSTILE_ARCHIVES)
def test_a_hostile_archive_is_refused_in_little_memory(name: str) -> None:
    content = HOSTILE_ARCHIVES[name]()
    tracemalloc.start()

    with pytest.raises((*DAMAGED_ARCHIVE,)) as raised:
        read_npz(content)
    assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY_BYTES
    tracemalloc.stop()
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize(
    "content",
    [patch_directory(zip_member(b""), 16, 7), patch_directory(make_npz(), 24, 0)],
    ids=["another", "no size"],
)
def test_a_member_without_bytes_has_a_checksum_as_well(content: bytes) -> None:
    with open_zip(content) as archive, pytest.raises(zipfile.BadZipFile, match="CRC"):
        read_member(archive, archive.infolist()[0], "lidar")


def test_an_archive_of_many_members_is_refused() -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for number in range(90_000):
            archive.writestr(f"{number}", b"")
    assert_raises((lambda: open_zip(content.getvalue()), OSError, "directory has"))


def test_an_end_that_leads_to_a_larger_directory_is_refused() -> None:
    content = make_npz()
    end_offset = content.rindex(b"PK\x05\x06")
    large_end = b"PK\x06\x06" + struct.pack("<QHHLLQQQQ", 44, 45, 45, 0, 0, 1, 1, 1 << 32, 0)
    last_bytes = b"PK\x06\x07" + struct.pack("<LQL", 0, end_offset, 1) + content[end_offset:]

    assert_raises(
        (
            lambda: open_zip(content[:end_offset] + large_end + last_bytes),
            OSError,
            ("directory has 4,294,967,296 bytes",),
        ),
        (
            lambda: open_zip(content[:end_offset] + large_end[:-1] + last_bytes),
            zipfile.BadZipFile,
            ("its end is damaged",),
        ),
        (
            lambda: array_of(b"\x93NUMPY\x09\x00" + bytes(20), "lidar"),
            ValueError,
            ("version (9, 0)",),
        ),
    )
