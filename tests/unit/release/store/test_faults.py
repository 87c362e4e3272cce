"""Archives and URLs that cannot be read raise the devkit's own errors, which name the archive and
the remedy.
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
from support import tiny_release
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.tiny_release_index import OTHER_SCENARIO, folder_contents, label_path
from support.zipped_releases import zip_release

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
    """Make a zip of one small stored file."""
    path = tmp_path / "small.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(_NAME, b"0123456789")
    return path


def _open(path: Path | str, tmp_path: Path) -> object:
    return open_dataroot(path, tmp_path / "index", workers=1)


def _change_number(path: Path, head: bytes, offset: int, form: str, value: int) -> None:
    """Change a number of the archive's head or directory that begins with `head`."""
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, content.index(head) + offset, value)
    path.write_bytes(content)


BAD: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda whole: whole[: len(whole) // 2], "the end is missing"),
    "empty": (lambda _: b"", "the file is empty"),
    "a web page": (lambda _: b"\n<!DOCTYPE html><html>Sign in</html>", "a web page"),
    "without a directory": (lambda whole: whole.replace(b"PK\x01\x02", b"PK\x01\x00"), "directory"),
    "zeros": (lambda whole: bytes(len(whole)), "not a zip archive"),
}


@pytest.fixture
def zips(tmp_path: Path) -> Path:
    """Make a zip of each of two scenarios, and bad archives of all kinds in a folder below."""
    folder = tmp_path / "zips"
    for name in (tiny_release.SCENARIO_NAME, OTHER_SCENARIO):
        root = tiny_release.write_tiny_release(tmp_path / name, name=name)
        zip_release(root, folder / f"{name}.zip")
    whole = (folder / f"{OTHER_SCENARIO}.zip").read_bytes()
    (folder / "more").mkdir()
    for name, (damage, _) in BAD.items():
        (folder / "more" / f"{name}.zip").write_bytes(damage(whole))
    return folder


def test_all_bad_archives_are_named_at_once_with_the_ways_out(zips: Path) -> None:
    names = [f"more/{name}.zip: " for name in BAD]
    messages = [message for _, message in BAD.values()]
    remedies = ["download the archive again", "move the broken ones", "--on-error skip"]
    words = ("5 of 7 archives cannot be read", *names, *messages, *remedies)
    assert_raises((lambda: DeepAccident(dataroot=zips, verbose=False), DatarootError, words))


def test_bad_archives_can_be_left_out(zips: Path, caplog: pytest.LogCaptureFixture) -> None:
    release = DeepAccident(dataroot=zips, on_error="skip", verbose=False)
    assert len(release.scenario) == 2
    assert all(f"more/{name}.zip: " in caplog.text for name in BAD)
    assert_raises(
        (lambda: DeepAccident(dataroot=zips, verbose=False), DatarootError, "5 of 7 archives")
    )


def test_validate_lists_bad_archives_and_goes_on(zips: Path) -> None:
    (zips / "half.zip.part").write_bytes(b"PK")

    report = validate_release(zips, workers=1)

    assert report.scenarios == 2
    findings = {
        Path(finding.where).name: finding
        for finding in report.findings
        if finding.code.startswith("archive-")
    }
    assert findings.keys() == {*(f"{name}.zip" for name in BAD), "half.zip.part"}
    for name, (_, message) in BAD.items():
        finding = findings[f"{name}.zip"]
        size_bytes = (zips / "more" / f"{name}.zip").stat().st_size
        assert finding.severity == "error"
        assert finding.code == "archive-unreadable"
        assert finding.scenario is None
        assert message in finding.what
        assert f"{size_bytes:,} bytes" in finding.what
        assert finding.remedy == "download the archive again"
    unfinished = findings["half.zip.part"]
    assert unfinished.severity == "warning"
    assert unfinished.code == "archive-unfinished"

    result = invoke_command("validate", zips, "--files", "--json", status=1)
    assert len(json.loads(result.stdout)["unreadable_archives"]) == 5


def test_an_archive_that_cannot_be_opened_is_one_of_them(
    zips: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse_other_scenario(path: Path) -> BinaryIO:
        if path.name == f"{OTHER_SCENARIO}.zip":
            raise PermissionError(13, "Permission denied")
        return open_file(path)

    monkeypatch.setattr(opening, "open_file", refuse_other_scenario)

    report = validate_release(zips, workers=1)

    archives = report.files.unreadable_archives
    message = f"{OTHER_SCENARIO}.zip: cannot be read (Permission denied)"
    assert report.scenarios == 1
    assert len(archives) == 6
    assert any(message in archive for archive in archives)


@pytest.mark.parametrize("change", ["in place", "in its place"])
def test_a_changed_archive_of_the_same_size_and_time_is_noticed(
    tmp_path: Path, change: str
) -> None:
    root = tiny_release.write_tiny_release(tmp_path / "release")
    archive = zip_release(root, tmp_path / "zips" / "all.zip")
    before = DeepAccident(dataroot=archive.parent, verbose=False)

    label = label_path(root)
    label.write_text(label.read_text().replace(" 1300 12 ", " 1300 72 "))
    other_archive = zip_release(root, tmp_path / "other.zip")
    status = archive.stat()
    if change == "in place":
        shutil.copyfile(other_archive, archive)
    else:
        other_archive.replace(archive)
    os.utime(archive, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert archive.stat().st_size == status.st_size

    after = DeepAccident(dataroot=archive.parent, verbose=False)
    token = f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/002/1"
    assert before.get("annotation", token)["num_lidar_pts"] == 12
    assert after.get("annotation", token)["num_lidar_pts"] == 72


def test_two_archives_with_the_same_member_are_refused(small: Path, tmp_path: Path) -> None:
    folder = tmp_path / "zips"
    folder.mkdir()
    shutil.copy(small, folder / "a.zip")
    shutil.copy(small, folder / "b.zip")
    words = (f"{_NAME}: is in a.zip and in b.zip", "keep one of them")
    assert_raises((lambda: _open(folder, tmp_path), DatarootError, words))


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
def test_a_member_that_is_twice_in_an_archive_is_refused(small: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(small, "a") as archive:
        archive.writestr(_NAME, b"other")
    assert_raises(
        (lambda: _open(small, tmp_path), DatarootError, rf"{_NAME}: is twice in small\.zip")
    )


@pytest.mark.parametrize(
    ("offset", "form", "value", "message"),
    [
        (8, "<H", 1, "is encrypted; unpack the archive with its password"),
        (10, "<H", 14, "is compressed by method 14; unpack the archive, or pack it again"),
        (
            20,
            "<I",
            10_000,
            "is listed at a place outside the archive; download the archive again",
        ),
        (24, "<I", 11, "is stored with two sizes"),
    ],
)
def test_members_that_cannot_be_read_in_place_are_refused(
    small: Path, tmp_path: Path, offset: int, form: str, value: int, message: str
) -> None:
    _change_number(small, b"PK\x01\x02", offset, form, value)
    assert_raises(
        (
            lambda: _open(small, tmp_path),
            DatarootError,
            rf"small\.zip: its member {_NAME} {message}",
        )
    )


def test_a_member_without_its_head_is_refused_when_it_is_read(small: Path, tmp_path: Path) -> None:
    root = open_dataroot(small, tmp_path / "index", workers=1)
    small.write_bytes(small.read_bytes().replace(b"PK\x03\x04", b"KP\x03\x04"))
    assert_raises(
        (
            lambda: (root / _NAME).content("calib"),
            OSError,
            ("damaged in its archive (no head at its place)",),
        )
    )


def test_validate_compares_checksums_and_reading_does_not(
    release_root: Path, tmp_path: Path
) -> None:
    path = zip_release(release_root, tmp_path / "all.zip")
    dataset = DeepAccident(dataroot=path, workers=1, verbose=False)
    token = f"{dataset.sample[0]['token']}/Camera_Front"
    image = dataset.local_path(token).read_bytes()
    middle = len(image) // 2
    position = path.read_bytes().index(image) + middle
    with path.open("r+b") as file:
        file.seek(position)
        file.write(bytes([image[middle] ^ 1]))

    scenario = dataset.scenario[0]["token"]
    report = validate_release(path, deep=True, workers=1, scenarios=[scenario])

    (finding,) = [finding for finding in report.findings if "checksum" in finding.what]
    assert finding.code == "sensor-unreadable"
    assert "damaged in its archive (its bytes do not match its checksum)" in finding.what
    dataset.load_image(token)


def test_a_label_of_another_checksum_is_a_finding(release_root: Path, tmp_path: Path) -> None:
    path = zip_release(release_root, tmp_path / "all.zip")
    label = next(release_root.rglob("label/*/*.txt")).read_bytes()
    content = path.read_bytes()
    assert content.count(label) == 1
    path.write_bytes(content.replace(label, label.replace(b"car", b"van", 1)))

    report = validate_release(path, workers=1)

    codes = {finding.code for finding in report.findings}
    assert "label-unreadable" in codes


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_NAME, bytes(5 << 20))

    def read_member(index: str) -> object:
        root = open_dataroot(path, tmp_path / index, workers=1)
        return (root / _NAME).content("calib")  # type: ignore[union-attr]

    limit = "has 5,242,880 bytes, more than 1,048,576, the limit for calib"
    assert_raises((lambda: read_member("one"), OSError, limit))

    _change_number(path, b"PK\x01\x02", 24, "<I", 1000)
    assert_raises((lambda: read_member("other"), OSError, "1,001 bytes instead of 1,000"))


def test_a_list_of_members_that_is_too_large_is_refused(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEEPACCIDENT_LIMITS", "archive=10")
    words = ("small.zip: ", "directory has ", "more than 10", "set DEEPACCIDENT_LIMITS=archive=4G")
    assert_raises((lambda: _open(small, tmp_path), DatarootError, words))


def test_names_that_lead_out_of_an_archive_are_of_no_release(tmp_path: Path) -> None:
    path = tmp_path / "odd.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"../{_NAME}", b"x")
        archive.writestr(f"__MACOSX/{_NAME}", b"x")
        archive.writestr("README.txt", b"x")

    root = open_dataroot(path, tmp_path / "index", workers=1)

    assert len(root.store.members) == 0  # type: ignore[union-attr]
    with pytest.raises(DatarootError, match=r"odd\.zip: no scenario found"):
        DeepAccident(dataroot=path, workers=1, verbose=False)


def test_archives_with_backslashes_in_their_names_are_read(tmp_path: Path) -> None:
    root = tiny_release.write_tiny_release(tmp_path / "release")
    path = zip_release(
        root,
        tmp_path / "windows.zip",
        above="DeepAccident/",
        rename=lambda name: name.replace("/", "\\"),
    )
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("type1_subtype1_accident\\", b"")
        archive.writestr("..\\" + _NAME.replace("/", "\\"), b"x")

    release = DeepAccident(dataroot=path, workers=1, verbose=False)

    unpacked = DeepAccident(dataroot=root, workers=1, verbose=False)
    assert len(release.annotation) == len(unpacked.annotation)
    (scenario,) = release.scenario
    assert scenario["token"] == tiny_release.SCENARIO_TOKEN


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "memory://nothing/here",
            r"memory://nothing/here: (does not exist|no file of a release found)",
        ),
        (
            "nosuch://bucket",
            r"nosuch://bucket: cannot be read \(Protocol not known: nosuch\); check the URL",
        ),
        ("s3://name:secret@bucket/x", r"s3://bucket…: contains a name, a password or a signature"),
        (
            "https://host/x?signature=secret",
            r"https://host…: contains a name, a password or a signature",
        ),
        (
            "memory://nothing/all.zip",
            r"memory://nothing/all\.zip: does not exist, or may not be listed",
        ),
    ],
)
def test_wrong_urls_are_refused_without_their_secrets(
    url: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(DatarootError, match=message) as raised:
        _open(url, tmp_path)
    assert "secret" not in str(raised.value)


def test_a_url_of_a_truncated_archive_is_refused(small: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    url = "memory://broken/all.zip"
    memory.pipe_file("/broken/all.zip", small.read_bytes()[:-10])
    words = (f"{url}: not a readable zip archive",)
    assert_raises((lambda: _open(url, tmp_path), DatarootError, words))

    memory.pipe_file("/broken/small.zip", small.read_bytes())
    for _ in range(2):
        root = open_dataroot("memory://broken", tmp_path / "index", on_error="skip")
        assert len(root.store.members) == 1  # type: ignore[union-attr]
        assert root.store.members.lacking == ["all.zip"]  # type: ignore[union-attr]
    memory.rm("/broken", recursive=True)


def test_a_changed_archive_at_a_url_is_noticed_and_loose_files_when_asked(
    small: Path, tmp_path: Path
) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/changing/small.zip", small.read_bytes())
    before = open_dataroot("memory://changing", tmp_path / "index")
    with zipfile.ZipFile(small, "a") as archive:
        archive.writestr(_NAME.replace("001", "002"), b"more")
    memory.pipe_file("/changing/small.zip", small.read_bytes())
    after = open_dataroot("memory://changing", tmp_path / "index")
    assert len(before.store.members) == 1  # type: ignore[union-attr]
    assert len(after.store.members) == 2  # type: ignore[union-attr]

    memory.pipe_file(f"/loose2/{_NAME}", b"x")
    open_dataroot("memory://loose2", tmp_path / "index2")
    memory.pipe_file(f"/loose2/{_NAME.replace('001', '002')}", b"x")
    unrefreshed = open_dataroot("memory://loose2", tmp_path / "index2", refresh=False)
    refreshed = open_dataroot("memory://loose2", tmp_path / "index2", refresh=True)
    assert len(unrefreshed.store.members) == 1  # type: ignore[union-attr]
    assert len(refreshed.store.members) == 2  # type: ignore[union-attr]
    assert unrefreshed.store.state != refreshed.store.state  # type: ignore[union-attr]


def test_a_damaged_list_is_made_again(small: Path, tmp_path: Path) -> None:
    _open(small, tmp_path)
    (path,) = (tmp_path / "index").glob("files-*")
    content = path.read_bytes()
    path.write_bytes(content[:200])
    opened_store.cache_clear()
    words = ("cannot be read", "deepaccident index DATAROOT --clear")
    assert_raises((lambda: Members(path), IndexStoreError, words))

    _open(small, tmp_path)
    assert path.read_bytes() == content


def test_full_disks_are_reported(
    release_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = zip_release(release_root, tmp_path / "all.zip")
    dataset = DeepAccident(dataroot=archive, workers=1, verbose=False)
    cache = tmp_path / "full"
    monkeypatch.setattr(Path, "write_bytes", _fail_to_write)
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(cache))
    words = ("cannot be cached in ", "full: ", "No space left", "DEEPACCIDENT_CACHE")
    assert_raises(
        (lambda: dataset.local_path(dataset.sample[0], "lidar01"), SensorFileError, words)
    )
    assert folder_contents(cache) == {}


def _fail_to_write(path: Path, _content: bytes) -> int:
    path.touch()
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("size", ["0", "x", "-1", "3X"])
def test_a_wrong_size_of_the_cache_is_refused(
    release_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: str
) -> None:
    monkeypatch.setenv("DEEPACCIDENT_CACHE_SIZE", size)
    archive = zip_release(release_root, tmp_path / "all.zip")
    dataset = DeepAccident(dataroot=archive, workers=1, verbose=False)
    read = partial(dataset.local_path, dataset.sample[0], "lidar01")
    assert_raises((read, ConfigError, "DEEPACCIDENT_CACHE_SIZE: expected bytes"))


def test_every_error_is_the_devkits(small: Path, tmp_path: Path) -> None:
    """Any byte of an archive may be wrong."""
    content = small.read_bytes()
    for position in range(len(content)):
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        small.write_bytes(damaged)
        try:
            root = open_dataroot(small, tmp_path / f"index{position}", workers=1)
        except DeepAccidentError:
            continue
        member = root / _NAME
        try:
            if member.exists():
                member.content("calib")  # type: ignore[union-attr]
        except OSError as error:
            assert "archive" in str(error)  # noqa: PT017 - other changes do no harm


def test_releases_in_stores_cannot_be_written_to(small: Path, tmp_path: Path) -> None:
    root = open_dataroot(small, tmp_path / "index", workers=1)
    assert_raises((lambda: real_path(root), NotAvailableError, "is in an archive or at a URL"))


def test_bad_archives_without_a_good_one_are_findings(zips: Path) -> None:
    report = validate_release(zips / "more", workers=1)
    assert report.scenarios == 0
    assert report.counts["error"] == 5
