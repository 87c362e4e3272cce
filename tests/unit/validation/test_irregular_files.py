"""Files that are not regular are named, and validation never waits for them."""

import os
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.validation import validate_release


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_pipes_instead_of_files_are_findings(small: Path) -> None:
    """Validation does not wait for them; a sensor's is named without `deep` as well."""
    codes_by_pattern = {
        "*/*/Camera_Front/*/*_002.jpg": "sensor-irregular",
        "*/*/lidar01/*/*_002.npz": "sensor-irregular",
        "*/*/label/*/*_003.txt": "label-unreadable",
        "*/*/calib/*/*_003.pkl": "calib-unreadable",
    }
    codes_by_path = {str(next(small.glob(key))): code for key, code in codes_by_pattern.items()}
    for path in codes_by_path:
        Path(path).unlink()
        os.mkfifo(path)
    os.mkfifo(small / "train.txt")

    findings = validate_release(small, workers=1).findings
    errors = {finding.where: finding.code for finding in findings if finding.severity == "error"}
    assert errors == {**codes_by_path, str(small / "train.txt"): "split-file-unreadable"}
    deep_findings = validate_release(small, deep=True, workers=1).findings
    messages = {finding.what for finding in deep_findings if finding.where in codes_by_path}
    assert messages == {"not a regular file (a named pipe)"}


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
    findings = validate_release(small, workers=1).findings
    [finding] = [finding for finding in findings if finding.code == code]

    assert finding.where.startswith(str(path))
    assert "Too many levels of symbolic links" in finding.what


def test_a_scenario_type_that_is_a_link_to_itself_is_a_note(small: Path) -> None:
    link = small / "type2_subtype1_normal"
    link.symlink_to(link.name)
    findings = validate_release(small, workers=1).findings
    [note] = [finding for finding in findings if finding.scenario is None]

    assert (note.code, note.severity) == ("link-leads-nowhere", "note")
    assert Path(note.where).name == link.name
    assert len(DeepAccident(dataroot=small, workers=1, verbose=False).scenario) == 1
