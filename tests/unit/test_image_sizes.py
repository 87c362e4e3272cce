"""Images that are not of the size of their calib are noticed at first use and by `validate`."""

import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.zipped_releases import zip_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import DeepAccidentError, ImageSizeWarning
from deepaccident_devkit.release import read_calib, write_raw_calib
from deepaccident_devkit.validation import Finding, findings, validate_release

CAMERA = "Camera_Front"
KINDS = ("calib", "label", CAMERA, "Camera_Back")
FAULT = "is 32x18, but calib is for 64x36"


@pytest.fixture(params=["A", "B"])
def release(request: pytest.FixtureRequest, release_root: Path, tmp_path: Path) -> Path:
    """Copy the ego's two cameras of one scenario type, in each layout."""
    root = tmp_path / "release"
    folder = root / "train" if request.param == "B" else root
    source = next(release_root.glob("*_accident"))
    for kind in KINDS:
        path = Path(source.name, "ego_vehicle", kind)
        shutil.copytree(release_root / path, folder / path)
    shutil.copytree(source / "meta", folder / source.name / "meta")
    return root


def list_images(root: Path, camera: str = CAMERA) -> list[Path]:
    return sorted(root.glob(f"**/{camera}/*/*.jpg"))


def shrink(*paths: Path) -> None:
    for path in paths:
        Image.open(path).resize((32, 18)).save(path, quality=90)


def collect_warnings(use: Callable[[], object]) -> list[warnings.WarningMessage]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        use()
    return caught


def use_cameras(da: DeepAccident) -> None:
    for sample in da.sample:
        for camera in (CAMERA, "Camera_Back"):
            da.camera(sample, camera)
            da.get_sample_data(sample["token"], camera)


def size_findings(root: Path, *, deep: bool) -> list[Finding]:
    report = validate_release(root, deep=deep, workers=1)
    return [finding for finding in report.findings if finding.code == "image-size"]


def test_the_first_use_of_a_camera_warns_once(release: Path) -> None:
    shrink(*list_images(release), *list_images(release, "Camera_Back"))
    da = DeepAccident(dataroot=release, verbose=False)

    caught = collect_warnings(lambda: use_cameras(da))

    assert [warning.category for warning in caught] == [ImageSizeWarning]
    message = str(caught[0].message)
    assert message.startswith(f"{list_images(release)[0]}: {FAULT}")
    assert "run deepaccident validate" in message
    assert caught[0].filename == __file__
    assert collect_warnings(lambda: use_cameras(da)) == []


def test_a_fitting_release_and_one_without_images_are_silent(release: Path) -> None:
    da = DeepAccident(dataroot=release, verbose=False)
    assert collect_warnings(lambda: use_cameras(da)) == []

    for folder in release.glob("**/Camera_*"):
        shutil.rmtree(folder)
    da = DeepAccident(dataroot=release, verbose=False)
    assert collect_warnings(lambda: use_cameras(da)) == []
    assert size_findings(release, deep=False) == []


def test_a_damaged_image_is_left_to_its_reader(release: Path) -> None:
    list_images(release)[0].write_bytes(b"no image")
    da = DeepAccident(dataroot=release, verbose=False)
    assert collect_warnings(lambda: use_cameras(da)) == []
    assert size_findings(release, deep=False) == []


@pytest.mark.parametrize("method", ["stored", "deflated"])
def test_images_in_zips_are_compared_too(release: Path, tmp_path: Path, method: str) -> None:
    shrink(*list_images(release, "Camera_Back"))
    archive = zip_release(release, tmp_path / "archives" / "release.zip", method)
    da = DeepAccident(dataroot=archive, index_dir=tmp_path / "index", verbose=False)

    caught = collect_warnings(lambda: use_cameras(da))

    (finding,) = size_findings(archive, deep=False)
    assert [warning.category for warning in caught] == [ImageSizeWarning]
    for text in (str(caught[0].message), str(finding)):
        assert text.startswith(str(archive))
        assert "Camera_Back" in text
        assert FAULT in text


def test_validate_finds_the_camera_and_deep_its_frames(release: Path) -> None:
    images = list_images(release)
    shrink(*images[:3])
    for deep, frames in ((False, "frame 1"), (True, "frames 1–3")):
        (finding,) = size_findings(release, deep=deep)
        assert finding.severity == "warning"
        assert finding.where == str(images[0])
        assert finding.what == f"{FAULT} ({frames})"
        assert "calib" in finding.remedy
    da = DeepAccident(dataroot=release, verbose=False)
    codes = [finding.code for finding in findings(da, da.scenario[0])]
    assert codes.count("image-size") == 1


def test_only_deep_finds_a_single_later_image(release: Path) -> None:
    shrink(list_images(release)[4])
    assert size_findings(release, deep=False) == []
    (finding,) = size_findings(release, deep=True)
    assert finding.what == f"{FAULT} (frame 5)"


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("place", [(0, 0), (0, 1), (1, 0)])
def test_an_endless_intrinsic_matrix_names_its_file(
    release: Path, value: float, place: tuple[int, int]
) -> None:
    path = sorted(release.glob("**/calib/*/*.pkl"))[1]
    calib = read_calib(path, raw=True)
    calib[f"intrinsic_{CAMERA}"][place] = value
    write_raw_calib(path, calib)

    with pytest.raises(DeepAccidentError, match="intrinsic_Camera_Front: contains NaN") as raised:
        DeepAccident(dataroot=release, verbose=False)
    assert str(path) in str(raised.value)
    report = validate_release(release, workers=1)
    (finding,) = [finding for finding in report.findings if finding.severity == "error"]
    assert (finding.code, finding.where) == ("calib-unreadable", str(path))


@pytest.mark.slow
def test_a_command_says_it_in_one_line(release: Path, tmp_path: Path) -> None:
    shrink(*list_images(release))
    out = tmp_path / "camera.png"
    command = [sys.executable, "-m", "deepaccident_devkit", "render", "sample-data", str(release)]
    result = subprocess.run(
        [*command, "--out", str(out)], capture_output=True, text=True, timeout=300, check=True
    )
    lines = [line for line in result.stderr.splitlines() if FAULT in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"warning: {release}")
