"""What is no regular file is named, and never waited for."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ReleaseError, SensorFileError
from deepaccident_devkit.release import (
    read_bev,
    read_calib,
    read_image,
    read_label,
    read_lidar,
    read_meta,
    read_split_file,
)
from deepaccident_devkit.validation import validate_release

READERS = [read_bev, read_calib, read_image, read_label, read_lidar, read_meta, read_split_file]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("read", READERS)
def test_readers_do_not_wait_for_a_pipe(tmp_path: Path, read: Callable[[Path], object]) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    link = tmp_path / "link"
    link.symlink_to(pipe)
    for path in (pipe, link):
        with pytest.raises(ReleaseError, match=rf"^{path}: not a regular file \(a named pipe\); "):
            read(path)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="the system has no such device")
@pytest.mark.parametrize("read", READERS)
def test_readers_do_not_read_a_device(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path = tmp_path / "link"
    path.symlink_to("/dev/zero")
    with pytest.raises(ReleaseError, match=rf"^{path}: not a regular file \(a device\); "):
        read(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_pipes_in_the_place_of_files_are_findings(small: Path) -> None:
    kinds = {"Camera_Front": "jpg", "lidar01": "npz"}
    pipes = [next(small.glob(f"*/*/{kind}/*/*_002.{ending}")) for kind, ending in kinds.items()]
    for pipe in pipes:
        pipe.unlink()
        os.mkfifo(pipe)
    found = validate_release(small, deep=True, workers=1).findings
    told = {finding.where: finding.what for finding in found if finding.code == "sensor-unreadable"}
    assert told == dict.fromkeys(map(str, pipes), "not a regular file (a named pipe)")
    for kind, ending, code in (("label", "txt", "label-unreadable"), ("calib", "pkl", "calib-unreadable")):
        pipe = next(small.glob(f"*/*/{kind}/*/*_003.{ending}"))
        content = pipe.read_bytes()
        pipe.unlink()
        os.mkfifo(pipe)
        errors = [one for one in validate_release(small, workers=1).findings if one.severity == "error"]
        (finding,) = [one for one in errors if one.code != "sensor-irregular"]
        assert {one.where for one in errors} == {str(pipe), *map(str, pipes)}
        assert (finding.code, finding.where) == (code, str(pipe))
        assert finding.what == "not a regular file (a named pipe)"
        pipe.unlink()
        pipe.write_bytes(content)


@pytest.mark.parametrize(
    ("pattern", "code"),
    [
        ("*/*/calib/*", "folder-unreadable"),
        ("*/*/label/*", "folder-unreadable"),
        ("*/*/Camera_Front/*", "folder-unreadable"),
        ("*/*/label", "folder-unreadable"),
        ("*/*/calib/*/*_002.pkl", "calib-unreadable"),
        ("*/*/label/*/*_002.txt", "label-unreadable"),
        ("*/*/Camera_Front/*/*_002.jpg", "sensor-irregular"),
        ("*/*/lidar01/*/*_002.npz", "sensor-irregular"),
    ],
)
def test_links_to_themselves_are_findings(small: Path, pattern: str, code: str) -> None:
    path = next(small.glob(pattern))
    path.rename(small / "aside")
    path.symlink_to(path.name)
    found = [finding for finding in validate_release(small, workers=1).findings if finding.code == code]
    assert [finding.where.startswith(str(path)) for finding in found] == [True]
    assert "Too many levels of symbolic links" in found[0].what


def test_a_scenario_type_that_is_a_link_to_itself_is_a_note(small: Path) -> None:
    (small / "type2_subtype1_normal").symlink_to("type2_subtype1_normal")
    (note,) = [one for one in validate_release(small, workers=1).findings if one.scenario is None]
    assert (note.code, note.severity, Path(note.where).name) == ("link-leads-nowhere", "note", "type2_subtype1_normal")
    assert len(DeepAccident(dataroot=small, workers=1, verbose=False).scenario) == 1


def test_a_link_to_a_folder_above_goes_no_deeper(small: Path) -> None:
    for folder in [small, *small.glob("*/*/*/*")]:
        (folder / "above").symlink_to("..")
    assert [one for one in validate_release(small, workers=1).findings if one.severity == "error"] == []


def test_loading_a_link_to_itself_names_it(small: Path) -> None:
    dataset = DeepAccident(dataroot=small, workers=1, verbose=False)
    sample = dataset.sample[1]["token"]
    for pattern, load in (
        ("*/*/Camera_Front/*/*_002.jpg", lambda: dataset.load_image(f"{sample}/Camera_Front")),
        ("*/*/lidar01/*/*_002.npz", lambda: dataset.load_point_cloud(sample)),
    ):
        path = next(small.glob(pattern))
        path.unlink()
        path.symlink_to(path.name)
        with pytest.raises(SensorFileError, match=rf"^{path}: cannot be read \(Too many levels"):
            load()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_a_pipe_in_the_place_of_a_split_file_is_a_finding(small: Path) -> None:
    os.mkfifo(small / "train.txt")
    (finding,) = [one for one in validate_release(small, workers=1).findings if one.severity == "error"]
    assert (finding.code, finding.where) == ("split-file-unreadable", str(small / "train.txt"))
