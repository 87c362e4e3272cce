"""What is no regular file is named, and never waited for."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from deepaccident_devkit.errors import ReleaseError
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
        (finding,) = [one for one in validate_release(small, workers=1).findings if one.severity == "error"]
        assert (finding.code, finding.where) == (code, str(pipe))
        assert finding.what == "not a regular file (a named pipe)"
        pipe.unlink()
        pipe.write_bytes(content)
