"""Labels whose ids are all −1."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import tiny

from deepaccident_devkit.validation import validate_release


def untracked(path: Path, *, keep: Callable[[list[str]], bool] = lambda _: False) -> None:
    """Write −1 for the ids of others."""
    first, *rows = path.read_text().splitlines()
    words = [row.split() for row in rows]
    for row in words:
        if row[10] != "-100" and not keep(row):
            row[10] = "-1"
    path.write_text("\n".join([first, *(" ".join(row) for row in words)]) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize("agent", tiny.AGENTS)
@pytest.mark.parametrize("frames", [[2], [1, 2, 3, 4]])
def test_labels_that_track_nobody(own_release: Path, agent: str, frames: list[int]) -> None:
    folder = next(own_release.glob(f"train/*_accident/{agent}/label/*"))
    for frame in frames:
        untracked(folder / f"{folder.name}_{frame:03d}.txt")
    found = validate_release(own_release, workers=1).findings
    assert [(finding.code, finding.where) for finding in found] == [("ids-untracked", str(folder))]


def test_one_agent_alone_that_tracks_nobody(own_release: Path) -> None:
    for folder in own_release.glob("*/*/*"):
        if folder.name not in ("meta", "ego_vehicle"):
            shutil.rmtree(folder)
    folders = sorted(own_release.glob("*/*/ego_vehicle/label/*"))
    expected = {str(folder) for folder in folders if sum(map(near_vehicles, folder.iterdir())) >= 2}
    assert expected
    for folder in folders:
        for path in folder.iterdir():
            untracked(path)
    found = validate_release(own_release, workers=1).findings
    assert {finding.where for finding in found if finding.code == "ids-untracked"} == expected


def near_vehicles(path: Path) -> int:
    """How many vehicles of a label its agent saw from within 15 m."""
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    return sum(
        row[0] in ("car", "truck", "van")
        and row[10] != "-100"
        and float(row[1]) ** 2 + float(row[2]) ** 2 < 15**2
        and (int(row[11]) > 0 or row[12] == "True")
        for row in rows
    )


def test_far_actors_are_not_tracked(own_release: Path) -> None:
    """−1 is normal where it begins at a distance, whoever else is nearer (docs/format.md, Label)."""
    for path in own_release.glob("*/*/*/label/*/*.txt"):
        untracked(path, keep=lambda row: float(row[1]) ** 2 + float(row[2]) ** 2 < 20**2)
    codes = {finding.code for finding in validate_release(own_release, workers=1).findings}
    assert "ids-untracked" not in codes
