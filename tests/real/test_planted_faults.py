"""Faults planted in a copy of the real scenario: the tolerances that its own rows set hide none of
them.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fault_injection.mutations import BEYOND, HARMLESS, MUTATIONS
from fault_injection.place import NoVictimError, Place
from fault_injection.run import Job, mutate, places

from deepaccident_devkit.release import read_lidar, write_lidar
from deepaccident_devkit.taxonomy import LIDAR
from deepaccident_devkit.testing.breakages.breakage import FIELD
from deepaccident_devkit.validation import validate_release
from real.conftest import TOKEN

SHALLOW = [
    name for name, kind in MUTATIONS.items() if not kind.deep and name not in (*BEYOND, *HARMLESS)
]


def doubts(root: Path, *, deep: bool = False) -> set[str]:
    report = validate_release(root, deep=deep, workers=1)
    return {
        f"{finding.code}: {finding}" for finding in report.findings if finding.severity != "note"
    }


@pytest.fixture(scope="session")
def real_places(real_copy: Path) -> dict[str, Place]:
    return places(real_copy)


@pytest.fixture(scope="session")
def sound(real_copy: Path) -> set[str]:
    """What is said of the copy before anything is planted: that sensor files are missing."""
    return doubts(real_copy)


@pytest.mark.parametrize("name", SHALLOW)
def test_a_planted_fault_is_told(
    real_copy: Path, real_places: dict[str, Place], sound: set[str], name: str
) -> None:
    try:
        place = mutate(Job(name, 0), real_places)
    except (NoVictimError, FileNotFoundError) as error:
        for place in real_places.values():
            place.restore()
        pytest.skip(f"needs what this scenario does not have: {error}")
    try:
        assert doubts(real_copy) - sound, place.changes()
    finally:
        place.restore()


def _exchanged(folder: Path, other: Path, stem: str, stem_other: str) -> None:
    first, second = folder / f"{stem}.npz", other / f"{stem_other}.npz"
    first_bytes, second_bytes = first.read_bytes(), second.read_bytes()
    first.write_bytes(second_bytes)
    second.write_bytes(first_bytes)


def _two_frames(root: Path) -> None:
    folder, name = _clouds(root, "ego_vehicle")
    _exchanged(folder, folder, f"{name}_026", f"{name}_051")


def _two_agents(root: Path) -> None:
    (folder, name), (other, _) = _clouds(root, "ego_vehicle"), _clouds(root, "infrastructure")
    _exchanged(folder, other, f"{name}_051", f"{name}_051")


def _shifted(root: Path) -> None:
    _moved(root, lambda xyz: xyz + np.array([0.5, 0.0, 0.0]))


def _mirrored(root: Path) -> None:
    _moved(root, lambda xyz: xyz * (1.0, -1.0, 1.0))


def _halved(root: Path) -> None:
    _moved(root, lambda xyz: xyz[::2])


def _moved(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the points of one cloud."""
    folder, name = _clouds(root, "other_vehicle_behind")
    path = folder / f"{name}_026.npz"
    xyz = change(read_lidar(path).xyz)
    write_lidar(path, xyz, np.zeros(len(xyz)))


def _turned(root: Path) -> None:
    _moved(root, lambda xyz: xyz[:, [1, 0, 2]] * (-1.0, 1.0, 1.0))


def _raised(root: Path) -> None:
    _moved(root, lambda xyz: xyz + np.array([0.0, 0.0, 1.0]))


def _one_late(root: Path) -> None:
    """Each cloud of an agent is that of the frame before, where that is there."""
    folder, name = _clouds(root, "ego_vehicle")
    for frame in range(100, 1, -1):
        path, before = (folder / f"{name}_{number:03d}.npz" for number in (frame, frame - 1))
        if path.is_file() and before.is_file():
            path.write_bytes(before.read_bytes())


def _miscounted(root: Path) -> None:
    """A near car's points, up by a half."""
    folder, name = _clouds(root, "ego_vehicle")
    label = folder.parents[1] / "label" / name / f"{name}_001.txt"
    first, *lines = [line.split() for line in label.read_text().splitlines()]
    most = max(
        (line for line in lines if int(line[FIELD["id"]]) > 0 and line[0] == "car"),
        key=lambda line: int(line[FIELD["num_lidar_pts"]]),
    )
    most[FIELD["num_lidar_pts"]] = str(int(1.5 * int(most[FIELD["num_lidar_pts"]])))
    label.write_text("\n".join(" ".join(words) for words in (first, *lines)) + "\n")


def _clouds(root: Path, agent: str) -> tuple[Path, str]:
    folder, name = TOKEN.split("/")
    return root / folder / agent / LIDAR / name, name


@pytest.fixture
def damaged(real_root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(real_root, tmp_path / "release"))


@pytest.mark.parametrize(
    "plant",
    [
        _two_frames,
        _two_agents,
        _shifted,
        _mirrored,
        _halved,
        _turned,
        _raised,
        _one_late,
        _miscounted,
    ],
)
def test_a_cloud_that_does_not_fit_its_label_is_told(
    damaged: Path, plant: Callable[[Path], None]
) -> None:
    before = doubts(damaged, deep=True)
    plant(damaged)
    assert any("points-differ" in doubt for doubt in doubts(damaged, deep=True) - before)
