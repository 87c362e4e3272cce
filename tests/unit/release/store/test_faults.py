"""Archives and URLs that cannot be read: the devkit's own errors, which name the archive and the
remedy.
"""

import json
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

import fsspec
import pytest
import tiny
from packing import packed
from refusals import assert_refused
from tiny_index import OTHER
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ConfigError,
    DatarootError,
    DeepAccidentError,
    IndexStoreError,
    NotAvailableError,
    SensorFileError,
)
from deepaccident_devkit.release.store import open_dataroot, opening, real_path
from deepaccident_devkit.release.store.members import Members
from deepaccident_devkit.release.store.store import opened_store
from deepaccident_devkit.support.reading import open_file
from deepaccident_devkit.validation import validate_release

pytestmark = pytest.mark.slow

_NAME = "type1_subtype1_accident/ego_vehicle/calib/a/a_001.pkl"


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A zip of one small stored file."""
    path = tmp_path / "small.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(_NAME, b"0123456789")
    return path


def _opened(path: Path | str, tmp_path: Path) -> object:
    return open_dataroot(path, tmp_path / "index", workers=1)


def _changed(path: Path, where: bytes, offset: int, form: str, value: int) -> None:
    """Change a number of the archive's head or directory that begins with `where`."""
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, content.index(where) + offset, value)
    path.write_bytes(content)


BAD: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda whole: whole[: len(whole) // 2], "its end is missing"),
    "empty": (lambda _: b"", "the file is empty"),
    "a web page": (lambda _: b"\n<!DOCTYPE html><html>Sign in</html>", "a web page"),
    "without a directory": (lambda whole: whole.replace(b"PK\x01\x02", b"PK\x01\x00"), "directory"),
    "zeros": (lambda whole: bytes(len(whole)), "not a zip archive"),
}


@pytest.fixture
def zips(tmp_path: Path) -> Path:
    """A release of two scenarios, a zip each, and bad archives of all kinds in a folder below."""
    for name in (tiny.NAME, OTHER):
        root = tiny.write_tiny_release(tmp_path / name, name=name)
        packed(root, tmp_path / "zips" / f"{name}.zip")
    whole = (tmp_path / "zips" / f"{OTHER}.zip").read_bytes()
    (tmp_path / "zips" / "more").mkdir()
    for name, (damage, _) in BAD.items():
        (tmp_path / "zips" / "more" / f"{name}.zip").write_bytes(damage(whole))
    return tmp_path / "zips"


def test_all_bad_archives_are_named_at_once_with_the_ways_out(zips: Path) -> None:
    named = (
        "5 of 7 archives cannot be read",
        *(f"more/{name}.zip: " for name in BAD),
        *(said for _, said in BAD.values()),
    )
    ways = ("fetch the archive again", "move them out of the folder", "--on-error skip")
    assert_refused(
        (lambda: DeepAccident(dataroot=zips, verbose=False), DatarootError, (*named, *ways))
    )


def test_bad_archives_can_be_left_out(zips: Path, caplog: pytest.LogCaptureFixture) -> None:
    release = DeepAccident(dataroot=zips, on_error="skip", verbose=False)
    assert len(release.scenario) == 2
    assert all(f"more/{name}.zip: " in caplog.text for name in BAD)
    assert_refused(
        (lambda: DeepAccident(dataroot=zips, verbose=False), DatarootError, "5 of 7 archives")
    )


def test_validate_lists_bad_archives_and_goes_on(zips: Path) -> None:
    (zips / "half.zip.part").write_bytes(b"PK")
    report = validate_release(zips, workers=1)
    found = {
        Path(each.where).name: each for each in report.findings if each.code.startswith("archive-")
    }
    assert report.scenarios == 2
    assert found.keys() == {*(f"{name}.zip" for name in BAD), "half.zip.part"}
    for name, (_, said) in BAD.items():
        finding = found[f"{name}.zip"]
        assert (finding.severity, finding.code, finding.scenario) == (
            "error",
            "archive-unreadable",
            None,
        )
        assert said in finding.what
        assert f"{(zips / 'more' / f'{name}.zip').stat().st_size:,} bytes" in finding.what
        assert finding.remedy == "fetch the archive again"
    assert (found["half.zip.part"].severity, found["half.zip.part"].code) == (
        "warning",
        "archive-unfinished",
    )
    assert (
        len(
            json.loads(called("validate", zips, "--files", "--json", status=1).stdout)[
                "unreadable_archives"
            ]
        )
        == 5
    )


def test_an_archive_that_cannot_be_opened_is_one_of_them(
    zips: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path) -> BinaryIO:
        if path.name == f"{OTHER}.zip":
            raise PermissionError(13, "Permission denied")
        return open_file(path)

    monkeypatch.setattr(opening, "open_file", refused)
    report = validate_release(zips, workers=1)
    assert (report.scenarios, len(report.files.unreadable_archives)) == (1, 6)
    assert any(
        f"{OTHER}.zip: cannot be read (Permission denied)" in each
        for each in report.files.unreadable_archives
    )


@pytest.mark.parametrize("way", ["in place", "in its place"])
def test_an_archive_of_the_same_size_and_time_is_seen(tmp_path: Path, way: str) -> None:
    root = tiny.write_tiny_release(tmp_path / "release")
    zips = packed(root, tmp_path / "zips" / "all.zip").parent
    before = DeepAccident(dataroot=zips, verbose=False)
    label = next((root / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME).glob("*_002.txt"))
    label.write_text(label.read_text().replace(" 1300 12 ", " 1300 72 "))
    other, archive = packed(root, tmp_path / "other.zip"), zips / "all.zip"
    status = archive.stat()
    shutil.copyfile(other, archive) if way == "in place" else other.replace(archive)
    os.utime(archive, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert archive.stat().st_size == status.st_size
    after = DeepAccident(dataroot=zips, verbose=False)
    token = f"{tiny.TOKEN}/ego_vehicle/002/1"
    assert [each.get("annotation", token)["num_lidar_pts"] for each in (before, after)] == [12, 72]


def test_two_archives_with_the_same_member_are_refused(small: Path, tmp_path: Path) -> None:
    for name in ("a.zip", "b.zip"):
        (tmp_path / "zips").mkdir(exist_ok=True)
        shutil.copy(small, tmp_path / "zips" / name)
    named = (f"{_NAME}: is in a.zip and in b.zip", "keep one of them")
    assert_refused((lambda: _opened(tmp_path / "zips", tmp_path), DatarootError, named))


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
def test_a_member_that_is_twice_in_an_archive_is_refused(small: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(small, "a") as archive:
        archive.writestr(_NAME, b"other")
    assert_refused(
        (lambda: _opened(small, tmp_path), DatarootError, rf"{_NAME}: is twice in small\.zip")
    )


@pytest.mark.parametrize(
    ("offset", "form", "value", "said"),
    [
        (8, "<H", 1, "is encrypted; unpack the archive with its password"),
        (10, "<H", 14, "is compressed by method 14; unpack the archive, or pack it again"),
        (20, "<I", 10_000, "is said to lie beyond the archive; fetch the archive again"),
        (24, "<I", 11, "is stored with two sizes"),
    ],
)
def test_members_that_cannot_be_read_in_place_are_refused(
    small: Path, tmp_path: Path, offset: int, form: str, value: int, said: str
) -> None:
    _changed(small, b"PK\x01\x02", offset, form, value)
    assert_refused(
        (lambda: _opened(small, tmp_path), DatarootError, rf"small\.zip: its member {_NAME} {said}")
    )


def test_a_member_whose_head_is_gone_is_refused_when_it_is_read(
    small: Path, tmp_path: Path
) -> None:
    root = open_dataroot(small, tmp_path / "index", workers=1)
    small.write_bytes(small.read_bytes().replace(b"PK\x03\x04", b"KP\x03\x04"))
    assert_refused(
        (
            lambda: (root / _NAME).content("calib"),
            OSError,
            ("damaged in its archive (no head at its place)",),
        )
    )


def test_validate_compares_checksums_and_reading_does_not(
    release_root: Path, tmp_path: Path
) -> None:
    path = packed(release_root, tmp_path / "all.zip")
    dataset = DeepAccident(dataroot=path, workers=1, verbose=False)
    token = f"{dataset.sample[0]['token']}/Camera_Front"
    image = dataset.local_path(token).read_bytes()
    position = path.read_bytes().index(image) + len(image) // 2
    with path.open("r+b") as file:
        file.seek(position)
        file.write(bytes([image[len(image) // 2] ^ 1]))
    scenario = dataset.scenario[0]["token"]
    report = validate_release(path, deep=True, workers=1, scenarios=[scenario])
    found = [finding for finding in report.findings if "checksum" in finding.what]
    assert [finding.code for finding in found] == ["sensor-unreadable"]
    assert "damaged in its archive (its bytes do not agree with its checksum)" in found[0].what
    dataset.load_image(token)


def test_a_label_of_another_checksum_is_a_finding(release_root: Path, tmp_path: Path) -> None:
    path = packed(release_root, tmp_path / "all.zip")
    label = next(release_root.rglob("label/*/*.txt")).read_bytes()
    content = path.read_bytes()
    assert content.count(label) == 1
    path.write_bytes(content.replace(label, label.replace(b"car", b"van", 1)))
    codes = {finding.code for finding in validate_release(path, workers=1).findings}
    assert "label-unreadable" in codes


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"

    def read(index: str) -> object:
        return (open_dataroot(path, tmp_path / index, workers=1) / _NAME).content("calib")  # type: ignore[union-attr]

    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_NAME, bytes(5 << 20))
    assert_refused(
        (
            lambda: read("one"),
            OSError,
            "has 5,242,880 bytes, more than 1,048,576, the limit for calib",
        )
    )
    _changed(path, b"PK\x01\x02", 24, "<I", 1000)
    assert_refused((lambda: read("other"), OSError, "1,001 bytes in place of 1,000"))


def test_a_list_of_members_that_is_too_large_is_refused(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEEPACCIDENT_LIMITS", "archive=10")
    named = ("small.zip: ", "directory has ", "more than 10", "set DEEPACCIDENT_LIMITS=archive=4G")
    assert_refused((lambda: _opened(small, tmp_path), DatarootError, named))


def test_names_that_lead_out_of_an_archive_are_of_no_release(tmp_path: Path) -> None:
    path = tmp_path / "odd.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"../{_NAME}", b"x")
        archive.writestr(f"__MACOSX/{_NAME}", b"x")
        archive.writestr("README.txt", b"x")
    assert len(open_dataroot(path, tmp_path / "index", workers=1).store.members) == 0  # type: ignore[union-attr]
    with pytest.raises(DatarootError, match=r"odd\.zip: no scenario found"):
        DeepAccident(dataroot=path, workers=1, verbose=False)


def test_archives_with_backslashes_in_their_names_are_read(tmp_path: Path) -> None:
    root = tiny.write_tiny_release(tmp_path / "release")
    path = packed(
        root,
        tmp_path / "windows.zip",
        written=lambda name: f"DeepAccident/{name}".replace("/", "\\"),
    )
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("type1_subtype1_accident\\", b"")
        archive.writestr("..\\" + _NAME.replace("/", "\\"), b"x")
    release = DeepAccident(dataroot=path, workers=1, verbose=False)
    assert len(release.annotation) == len(
        DeepAccident(dataroot=root, workers=1, verbose=False).annotation
    )
    assert [each["token"] for each in release.scenario] == [tiny.TOKEN]


@pytest.mark.parametrize(
    ("url", "said"),
    [
        (
            "memory://nothing/here",
            r"memory://nothing/here: (does not exist|no file of a release found)",
        ),
        (
            "nosuch://bucket",
            r"nosuch://bucket: cannot be read \(Protocol not known: nosuch\); check the URL",
        ),
        ("s3://name:secret@bucket/x", r"s3://bucket…: holds a name, a password or a signature"),
        (
            "https://host/x?signature=secret",
            r"https://host…: holds a name, a password or a signature",
        ),
        (
            "memory://nothing/all.zip",
            r"memory://nothing/all\.zip: does not exist, or may not be listed",
        ),
    ],
)
def test_wrong_urls_are_refused_without_their_secrets(url: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(DatarootError, match=said) as raised:
        _opened(url, tmp_path)
    assert "secret" not in str(raised.value)


def test_a_url_of_a_truncated_archive_is_refused(small: Path, tmp_path: Path) -> None:
    memory, url = fsspec.filesystem("memory"), "memory://broken/all.zip"
    memory.pipe_file("/broken/all.zip", small.read_bytes()[:-10])
    assert_refused(
        (lambda: _opened(url, tmp_path), DatarootError, (f"{url}: not a readable zip archive",))
    )
    memory.pipe_file("/broken/small.zip", small.read_bytes())
    for _ in range(2):
        root = open_dataroot("memory://broken", tmp_path / "index", on_error="skip")
        assert (len(root.store.members), root.store.members.lacking) == (1, ["all.zip"])  # type: ignore[union-attr]
    memory.rm("/broken", recursive=True)


def test_a_changed_archive_at_a_url_is_noticed_and_loose_files_when_asked(
    small: Path, tmp_path: Path
) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/changing/small.zip", small.read_bytes())
    first = open_dataroot("memory://changing", tmp_path / "index")
    with zipfile.ZipFile(small, "a") as archive:
        archive.writestr(_NAME.replace("001", "002"), b"more")
    memory.pipe_file("/changing/small.zip", small.read_bytes())
    second = open_dataroot("memory://changing", tmp_path / "index")
    assert [len(root.store.members) for root in (first, second)] == [1, 2]  # type: ignore[union-attr]
    memory.pipe_file(f"/loose2/{_NAME}", b"x")
    open_dataroot("memory://loose2", tmp_path / "index2")
    memory.pipe_file(f"/loose2/{_NAME.replace('001', '002')}", b"x")
    kept, asked = (
        open_dataroot("memory://loose2", tmp_path / "index2", refresh=each)
        for each in (False, True)
    )
    assert [len(root.store.members) for root in (kept, asked)] == [1, 2]  # type: ignore[union-attr]
    assert kept.store.state != asked.store.state  # type: ignore[union-attr]


def test_a_damaged_list_is_made_again(small: Path, tmp_path: Path) -> None:
    _opened(small, tmp_path)
    (file,) = (tmp_path / "index").glob("files-*")
    content = file.read_bytes()
    file.write_bytes(content[:200])
    opened_store.cache_clear()
    assert_refused(
        (
            lambda: Members(file),
            IndexStoreError,
            ("cannot be read", "deepaccident index DATAROOT --clear"),
        )
    )
    _opened(small, tmp_path)
    assert file.read_bytes() == content


def test_full_disks_are_told(
    release_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = packed(release_root, tmp_path / "all.zip")
    dataset = DeepAccident(dataroot=path, workers=1, verbose=False)
    monkeypatch.setattr(Path, "write_bytes", _no_room)
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "full"))
    named = ("cannot be kept in ", "full: ", "No space left", "DEEPACCIDENT_CACHE")
    assert_refused(
        (lambda: dataset.local_path(dataset.sample[0], "lidar01"), SensorFileError, named)
    )
    assert [each for each in (tmp_path / "full").rglob("*") if each.is_file()] == []


def _no_room(path: Path, _content: bytes) -> int:
    path.touch()
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("size", ["0", "x", "-1", "3X"])
def test_a_wrong_size_of_the_cache_is_told(
    release_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: str
) -> None:
    monkeypatch.setenv("DEEPACCIDENT_CACHE_SIZE", size)
    dataset = DeepAccident(
        dataroot=packed(release_root, tmp_path / "all.zip"), workers=1, verbose=False
    )
    read = partial(dataset.local_path, dataset.sample[0], "lidar01")
    assert_refused((read, ConfigError, "DEEPACCIDENT_CACHE_SIZE: expected bytes"))


def test_every_error_is_the_devkits(small: Path, tmp_path: Path) -> None:
    """Any byte of an archive may be wrong."""
    content = small.read_bytes()
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 0xFF
        small.write_bytes(changed)
        try:
            root = open_dataroot(small, tmp_path / f"index{place}", workers=1)
        except DeepAccidentError:
            continue
        try:
            if (root / _NAME).exists():
                (root / _NAME).content("calib")  # type: ignore[union-attr]
        except OSError as error:
            assert "archive" in str(error)  # noqa: PT017 - other changes do no harm


def test_releases_in_stores_cannot_be_written_to(small: Path, tmp_path: Path) -> None:
    root = open_dataroot(small, tmp_path / "index", workers=1)
    assert_refused((lambda: real_path(root), NotAvailableError, "lies in an archive or at a URL"))


def test_bad_archives_alone_are_findings(zips: Path) -> None:
    report = validate_release(zips / "more", workers=1)
    assert (report.scenarios, report.counts["error"]) == (0, 5)
