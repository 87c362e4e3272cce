"""The gate: regular files only, none above its kind's limit, no waiting, messages of bounded length."""

import os
import re
import stat
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

import deepaccident_devkit
from deepaccident_devkit.errors import shortened
from deepaccident_devkit.support.reading import (
    LIMITS,
    LIMITS_VARIABLE,
    check_size,
    file_checksum,
    limit_of,
    open_file,
    read_bytes,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file"


@pytest.mark.parametrize("size", [0, 1, 70_000])
def test_a_regular_file_is_read_whole(path: Path, size: int) -> None:
    path.write_bytes(os.urandom(size))
    assert read_bytes(path, "label") == path.read_bytes()
    with open_file(path) as file:
        assert file.read() == path.read_bytes()


def test_a_link_to_a_file_is_read(path: Path, tmp_path: Path) -> None:
    (tmp_path / "there").write_bytes(b"content")
    path.symlink_to("there")
    assert read_bytes(path, "meta") == b"content"


def test_a_file_that_says_it_is_empty_is_read() -> None:
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
@pytest.mark.parametrize("read", [lambda path: read_bytes(path, "label"), open_file])
def test_what_is_no_file_is_refused_at_once(path: Path, make, said: str, read) -> None:
    make(path)
    with pytest.raises(OSError, match=said):
        read(path)


@pytest.mark.parametrize("name", ["a\0b", "\ud800"])
@pytest.mark.parametrize("read", [lambda path: read_bytes(path, "label"), open_file, file_checksum])
def test_what_can_be_no_name_is_said_in_our_words(tmp_path: Path, name: str, read) -> None:
    with pytest.raises(OSError, match="cannot be a file's name: it holds a NUL character, or half of a pair"):
        read(tmp_path / name)


@pytest.mark.parametrize("kind", LIMITS)
def test_a_file_above_its_limit_is_refused_before_it_is_read(path: Path, kind) -> None:
    with path.open("wb") as file:
        file.truncate(LIMITS[kind] + 1)  # a sparse file takes no room
    with pytest.raises(OSError, match=rf"{LIMITS[kind] + 1:,} bytes, more than .* set {LIMITS_VARIABLE}={kind}=\d+M"):
        read_bytes(path, kind)


def test_a_remedy_that_is_followed_helps(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with path.open("wb") as file:
        file.truncate(LIMITS["meta"] + 1)
    with pytest.raises(OSError, match="limit for meta") as raised:
        read_bytes(path, "meta")
    monkeypatch.setenv(*raised.value.strerror.rsplit(" ", 1)[1].split("=", 1))
    assert len(read_bytes(path, "meta")) == LIMITS["meta"] + 1


def test_the_limits_of_the_environment_reach_spawned_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, "label=2K, lidar=3M bev=7")
    assert [limit_of(kind) for kind in ("label", "lidar", "bev", "meta")] == [2048, 3 << 20, 7, LIMITS["meta"]]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(limit_of, "label").result() == 2048


@pytest.mark.parametrize("text", ["label", "label=", "label=0", "labels=3M", "label=3X", "label=-1", "x" * 10_000])
def test_limits_that_cannot_be_read_are_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, text)
    with pytest.raises(OSError, match=LIMITS_VARIABLE) as raised:
        check_size(1, "label")
    assert len(raised.value.strerror) < 400


def test_a_long_text_loses_its_middle() -> None:
    assert shortened("short") == "short"
    assert len(shortened("x" * 10**6)) <= 100
    assert shortened("begin" + "x" * 1000 + "end").startswith("begin")
    assert shortened("begin" + "x" * 1000 + "end").endswith("end")


OTHER_WAYS_TO_READ = re.compile(
    r"""\.read_(bytes|text)\(|\bnp\.load\(
    |\.open\((?!BytesIO|.*["'][wa]b?["'])|\bZipFile\((?!.*"w")""",
    re.VERBOSE,
)
NOT_OF_STRANGERS = {
    "support/reading.py": "the gate",
    "support/files.py": "the system's processes",
    "cli/process.py": "nothing: the null device",
    "synth/demo.py": "the mark of the demo's own folder",
    "evaluation/runs/bundles.py": "counts that were written a line before",
    "explore/pages/release.py": "the split file that was written a line before",
    "explore/pages/responses.py": "the package's own styles and scripts",
    "explore/serving.py": "a browser",
    "export/questions/questions.py": "the parts that the export wrote",
    "support/pages.py": "the package's own templates",
    "parallel/store.py": "locks, of which nothing is believed",
    "release/images.py": "the head of an image that the gate opened",
    "release/store/store.py": "the cache's own copies",
    "release/store/sources.py": "fsspec, and the directory of an archive that the gate or fsspec opened",
    "synth/spec/catalogue.py": "the package's own designs",
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
