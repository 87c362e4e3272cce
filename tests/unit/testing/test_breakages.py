"""Every breakage: the findings of `validate`, and the errors of opening and reading."""

import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, DeepAccidentError
from deepaccident_devkit.release import (
    read_bev,
    read_calib,
    read_image,
    read_label,
    read_lidar,
    read_meta,
    read_split_file,
)
from deepaccident_devkit.taxonomy import BEV_CAMERA, LIDAR
from deepaccident_devkit.testing import (
    BREAKAGES,
    BrokenRelease,
    SmallRelease,
    break_release,
    broken_release,
)
from deepaccident_devkit.validation import validate_release

pytestmark = pytest.mark.slow

CAMERA = "Camera_Front"
WITHOUT_SENSORS = SmallRelease(splits=("train",), channels=())
READERS: dict[str, Callable[[Path], Any]] = {
    "label": read_label,
    "calib": read_calib,
    CAMERA: read_image,
    LIDAR: read_lidar,
    BEV_CAMERA: read_bev,
}


def read_file(path: Path) -> object:
    """Read a file of a release with the reader that its folder asks for."""
    if path.parent.name == "meta":
        return read_meta(path)
    reader = READERS.get(path.parent.parent.name)
    return reader(path) if reader else read_split_file(path)


def break_copy(release: Path, tmp_path: Path, name: str) -> BrokenRelease:
    root = tmp_path / "release"
    shutil.copytree(release, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return break_release(root, name)


def catch_error_type(call: Callable[[], object]) -> type[DeepAccidentError] | None:
    """Return the type of our error that a call raises; any other error fails the test."""
    try:
        call()
    except DeepAccidentError as error:
        return type(error)
    return None


@pytest.mark.parametrize("name", BREAKAGES)
def test_what_the_devkit_says(make_deepaccident_release, tmp_path: Path, name: str) -> None:
    breakage = BREAKAGES[name]
    options = SmallRelease(splits=("train",), channels=(breakage.channel or CAMERA,))
    broken = break_copy(make_deepaccident_release(options), tmp_path, name)
    report = validate_release(broken.root, deep=breakage.deep, workers=1)
    assert tuple(sorted({finding.code for finding in report.findings})) == breakage.codes
    assert {finding.scenario for finding in report.findings} <= {broken.scenario, None}

    opening_error = catch_error_type(
        lambda: DeepAccident("v1", broken.root, workers=1, verbose=False)
    )
    assert opening_error == breakage.opening
    if breakage.reading or broken.path.is_file():
        assert catch_error_type(lambda: read_file(broken.path)) == breakage.reading
    assert not broken.marker.exists()


@pytest.mark.parametrize(
    "name", ["frame-lost", "scenario-twice", "split-line-twice", "infrastructure-absent"]
)
def test_folders_in_the_other_layout(make_deepaccident_release, tmp_path: Path, name: str) -> None:
    options = SmallRelease(layout="B", splits=("train",), channels=(CAMERA,))
    broken = break_copy(make_deepaccident_release(options), tmp_path, name)
    report = validate_release(broken.root, workers=1)
    assert tuple(sorted({finding.code for finding in report.findings})) == BREAKAGES[name].codes


def test_a_program_in_a_calib_file_runs_where_it_is_unpickled(
    make_deepaccident_release, tmp_path: Path
) -> None:
    """Otherwise the missing `marker` would say nothing in the other tests."""
    broken = break_copy(make_deepaccident_release(WITHOUT_SENSORS), tmp_path, "calib-code")
    pickle.loads(broken.path.read_bytes())
    assert broken.marker.is_dir()


EGO_ONLY = SmallRelease(agents=("ego_vehicle",), channels=())
LACKS_A_PART = "which lacks a part: "


@pytest.mark.parametrize(
    ("name", "config", "error", "message"),
    [
        (
            "label-purple",
            WITHOUT_SENSORS,
            ChoiceError,
            ("breakage: expected one of label-empty, ", "found 'label-purple'"),
        ),
        (
            "lidar-cut",
            WITHOUT_SENSORS,
            ConfigError,
            ("'lidar-cut' cannot break ", LACKS_A_PART, "npz"),
        ),
        (
            "agents-swapped",
            EGO_ONLY,
            ConfigError,
            (LACKS_A_PART, "a second vehicle that records; choose a complete"),
        ),
        (
            "lidar-cut",
            SmallRelease(splits=("test",), frames=1, channels=()),
            ConfigError,
            ("no labelled scenario",),
        ),
        *(
            (
                name,
                SmallRelease(splits=("val",), channels=(), **options),
                ConfigError,
                (f"'{name}' changes nothing in",),
            )
            for name, options in (
                ("frames-swapped", {"frames": 1}),
                ("label-own-row-missing", {"agents": ("infrastructure",)}),
                ("infrastructure-absent", {"agents": ("ego_vehicle",)}),
                ("sensors-absent", {}),
            )
        ),
    ],
)
def test_what_cannot_be_broken_and_what_would_stay_whole(
    tmp_path: Path, name: str, config, error, message
) -> None:
    assert_raises((lambda: broken_release(tmp_path / "release", name, config), error, message))
    assert (tmp_path / "release").exists() == (error is not ChoiceError)


@pytest.mark.parametrize(
    ("first", "then"),
    [
        ("label-garbage", "label-nan"),
        ("meta-empty", "meta-pair-wrong"),
        ("calib-key-missing", "calib-key-missing"),
    ],
)
def test_what_is_broken_already_may_be_too_broken_for_more(
    tmp_path: Path, first: str, then: str
) -> None:
    root = broken_release(tmp_path / "release", first, WITHOUT_SENSORS).root
    assert_raises(
        (lambda: break_release(root, then), ConfigError, (f"'{then}' cannot break ", LACKS_A_PART))
    )
