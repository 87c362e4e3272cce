"""What is no regular file is named, and never waited for."""

import os
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.validation import validate_release


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_pipes_in_the_place_of_files_are_findings(small: Path) -> None:
    """Nothing waits for them; a sensor's is told without `deep` too."""
    places = {
        "*/*/Camera_Front/*/*_002.jpg": "sensor-irregular",
        "*/*/lidar01/*/*_002.npz": "sensor-irregular",
        "*/*/label/*/*_003.txt": "label-unreadable",
        "*/*/calib/*/*_003.pkl": "calib-unreadable",
    }
    pipes = {str(next(small.glob(pattern))): code for pattern, code in places.items()}
    for path in pipes:
        Path(path).unlink()
        os.mkfifo(path)
    os.mkfifo(small / "train.txt")
    found = [one for one in validate_release(small, workers=1).findings if one.severity == "error"]
    assert {one.where: one.code for one in found} == {
        **pipes,
        str(small / "train.txt"): "split-file-unreadable",
    }
    told = {
        one.what
        for one in validate_release(small, deep=True, workers=1).findings
        if one.where in pipes
    }
    assert told == {"not a regular file (a named pipe)"}


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
    (found,) = [
        finding for finding in validate_release(small, workers=1).findings if finding.code == code
    ]
    assert found.where.startswith(str(path))
    assert "Too many levels of symbolic links" in found.what


def test_a_scenario_type_that_is_a_link_to_itself_is_a_note(small: Path) -> None:
    (small / "type2_subtype1_normal").symlink_to("type2_subtype1_normal")
    (note,) = [one for one in validate_release(small, workers=1).findings if one.scenario is None]
    assert (note.code, note.severity, Path(note.where).name) == (
        "link-leads-nowhere",
        "note",
        "type2_subtype1_normal",
    )
    assert len(DeepAccident(dataroot=small, workers=1, verbose=False).scenario) == 1
