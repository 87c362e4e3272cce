"""Faults planted in a copy of the real scenario; its own tolerances hide none of them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fault_injection.editor import NoVictimError, UndoableEditor
from fault_injection.mutations import BEYOND, HARMLESS, MUTATIONS
from fault_injection.run import Job, mutate, open_editors

from deepaccident_devkit.release import read_lidar, write_lidar
from deepaccident_devkit.taxonomy import LIDAR
from deepaccident_devkit.testing.breakages.breakage import FIELD
from deepaccident_devkit.validation import validate_release
from real.conftest import TOKEN

SHALLOW = [
    name for name, kind in MUTATIONS.items() if not kind.deep and name not in (*BEYOND, *HARMLESS)
]


def find_faults(root: Path, *, deep: bool = False) -> set[str]:
    findings = validate_release(root, deep=deep, workers=1).findings
    return {f"{finding.code}: {finding}" for finding in findings if finding.severity != "note"}


@pytest.fixture(scope="session")
def real_places(real_copy: Path) -> dict[str, UndoableEditor]:
    return open_editors(real_copy)


@pytest.fixture(scope="session")
def known_faults(real_copy: Path) -> set[str]:
    """The faults of the copy before anything is planted: sensor files are missing."""
    return find_faults(real_copy)


@pytest.mark.parametrize("name", SHALLOW)
def test_a_planted_fault_is_told(
    real_copy: Path, real_places: dict[str, UndoableEditor], known_faults: set[str], name: str
) -> None:
    try:
        fault_place = mutate(Job(name, 0), real_places)
    except (NoVictimError, FileNotFoundError) as error:
        for fault_place in real_places.values():
            fault_place.restore()
        pytest.skip(f"needs what this scenario does not have: {error}")
    try:
        assert find_faults(real_copy) - known_faults, fault_place.changes()
    finally:
        fault_place.restore()


def cloud_path(root: Path, agent: str, frame: int) -> Path:
    scenario_type, name = TOKEN.split("/")
    return root / scenario_type / agent / LIDAR / name / f"{name}_{frame:03d}.npz"


def exchange_files(path: Path, other_path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(other_path.read_bytes())
    other_path.write_bytes(content)


def exchange_two_frames(root: Path) -> None:
    exchange_files(cloud_path(root, "ego_vehicle", 26), cloud_path(root, "ego_vehicle", 51))


def exchange_two_agents(root: Path) -> None:
    exchange_files(cloud_path(root, "ego_vehicle", 51), cloud_path(root, "infrastructure", 51))


def change_points(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the points of one cloud."""
    path = cloud_path(root, "other_vehicle_behind", 26)
    xyz = change(read_lidar(path).xyz)
    write_lidar(path, xyz, np.zeros(len(xyz)))


def shift_points(root: Path) -> None:
    change_points(root, lambda xyz: xyz + np.array([0.5, 0.0, 0.0]))


def mirror_points(root: Path) -> None:
    change_points(root, lambda xyz: xyz * (1.0, -1.0, 1.0))


def halve_points(root: Path) -> None:
    change_points(root, lambda xyz: xyz[::2])


def turn_points(root: Path) -> None:
    change_points(root, lambda xyz: xyz[:, [1, 0, 2]] * (-1.0, 1.0, 1.0))


def raise_points(root: Path) -> None:
    change_points(root, lambda xyz: xyz + np.array([0.0, 0.0, 1.0]))


def delay_clouds(root: Path) -> None:
    """Replace each cloud of an agent by that of the frame before, if both exist."""
    for frame in range(100, 1, -1):
        path = cloud_path(root, "ego_vehicle", frame)
        previous_path = cloud_path(root, "ego_vehicle", frame - 1)
        if path.is_file() and previous_path.is_file():
            path.write_bytes(previous_path.read_bytes())


def miscount_points(root: Path) -> None:
    """Raise the number of points of the car that has the most by a half."""
    scenario_type, name = TOKEN.split("/")
    label = root / scenario_type / "ego_vehicle" / "label" / name / f"{name}_001.txt"
    header, *rows = [line.split() for line in label.read_text().splitlines()]
    cars = [row for row in rows if int(row[FIELD["id"]]) > 0 and row[0] == "car"]
    points_column = FIELD["num_lidar_pts"]
    nearest_car = max(cars, key=lambda row: int(row[points_column]))
    nearest_car[points_column] = str(int(1.5 * int(nearest_car[points_column])))
    label.write_text("\n".join(" ".join(words) for words in (header, *rows)) + "\n")


@pytest.fixture
def release_copy(real_root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(real_root, tmp_path / "release"))


@pytest.mark.parametrize(
    "plant",
    [
        exchange_two_frames,
        exchange_two_agents,
        shift_points,
        mirror_points,
        halve_points,
        turn_points,
        raise_points,
        delay_clouds,
        miscount_points,
    ],
)
def test_a_cloud_that_does_not_fit_its_label_is_told(
    release_copy: Path, plant: Callable[[Path], None]
) -> None:
    before = find_faults(release_copy, deep=True)
    plant(release_copy)
    new_faults = find_faults(release_copy, deep=True) - before
    assert any("points-differ" in fault for fault in new_faults)
