"""Resized images in a folder: what is written, what is read back, and what is refused."""

import json
import pickle
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingFileError, SensorFileError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.training.image_cache import CachedImages, ImageCache

pytestmark = pytest.mark.slow

IMAGES = ImageConfig(resize=(18, 30), crop=(2, 3, 12, 25))
EVERY_SCENARIO = ("length>=1",)
TWO_AGENTS = ("ego_vehicle", "infrastructure")


def make_cache(
    dataset: DeepAccident, folder: Path, images: ImageConfig = IMAGES, codec: Any = "raw"
) -> ImageCache:
    form = CachedImages(images=images, where=EVERY_SCENARIO, agents=TWO_AGENTS, codec=codec)
    export_release(dataset, folder, form, workers=1)
    return ImageCache(folder)


@pytest.fixture(scope="module")
def cache(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> ImageCache:
    return make_cache(da, tmp_path_factory.mktemp("cache") / "raw")


def list_cameras(dataset: DeepAccident) -> list[str]:
    tokens = [record["token"] for record in dataset.sample if record["agent"] in TWO_AGENTS]
    return [f"{token}/{camera}" for token in tokens for camera in CAMERAS]


def assert_loads_uncached(
    cache: ImageCache, images: ImageConfig, da: DeepAccident, camera: str
) -> None:
    image, intrinsic = cache.load(images, da, camera)
    uncached_image, uncached_intrinsic = images.load(da, camera)
    np.testing.assert_array_equal(image, uncached_image)
    np.testing.assert_array_equal(intrinsic, uncached_intrinsic)


@pytest.mark.parametrize("decode", ["full", "scaled"])
def test_raw_images_are_the_uncached_ones(da: DeepAccident, tmp_path: Path, decode: Any) -> None:
    images = replace(IMAGES, decode=decode)
    cache = pickle.loads(pickle.dumps(make_cache(da, tmp_path / "out", images)))
    for camera in list_cameras(da):
        assert_loads_uncached(cache, images, da, camera)
        assert cache.has(camera)


def test_whole_images_can_be_cropped_later_and_cameras_chosen(
    da: DeepAccident, tmp_path: Path
) -> None:
    cache = make_cache(da, tmp_path / "out", replace(IMAGES, crop=None))
    images = replace(IMAGES, cameras=("Camera_Back", "Camera_Front"))
    cache.check(images)
    assert_loads_uncached(cache, images, da, list_cameras(da)[5])


def test_jpeg_images_are_nearly_the_uncached_ones(
    da: DeepAccident, cache: ImageCache, tmp_path: Path
) -> None:
    jpeg_cache = make_cache(da, tmp_path / "out", codec="jpeg")
    for camera in list_cameras(da)[::7]:
        jpeg_image, jpeg_intrinsic = jpeg_cache.load(IMAGES, da, camera)
        raw_image, raw_intrinsic = cache.load(IMAGES, da, camera)
        assert jpeg_image.shape == (12, 25, 3)
        assert np.abs(jpeg_image.astype(int) - raw_image).mean() < 6
        np.testing.assert_array_equal(jpeg_intrinsic, raw_intrinsic)


@pytest.mark.parametrize(("codec", "tolerance"), [("raw", 0), ("jpeg", 0.5)])
def test_the_plan_is_what_is_written(
    da: DeepAccident, tmp_path: Path, codec: Any, tolerance: float
) -> None:
    form = CachedImages(images=IMAGES, where=EVERY_SCENARIO, codec=codec)
    tally = export_release(da, tmp_path / "out", form, workers=1).tally
    assert tally.samples == len(da.sample)
    assert tally.files == len(da.scenario)
    assert tally.left_out == {}
    plan = export_release(da, tmp_path / "none", form, dry_run=True).tally
    assert plan.bytes == pytest.approx(tally.bytes, rel=tolerance)


def test_what_a_partial_release_lacks_is_absent(da_partial: DeepAccident, tmp_path: Path) -> None:
    form = CachedImages(
        images=IMAGES, where=EVERY_SCENARIO, agents=("ego_vehicle", "other_vehicle_behind")
    )
    tally = export_release(da_partial, tmp_path / "out", form, workers=1).tally
    num_frames = sum(record["num_frames"] for record in da_partial.scenario)
    assert tally.left_out == {
        "agents of scenarios that are not in this release": len(da_partial.scenario),
        "images that are not in this release": num_frames,
    }

    cache = ImageCache(tmp_path / "out")
    sample = f"{da_partial.scenario[0]['token']}/ego_vehicle/003"
    for camera in CAMERAS:
        assert cache.has(f"{sample}/{camera}") == (camera != "Camera_Front")
    assert_raises(
        (
            lambda: cache.load(IMAGES, da_partial, f"{sample}/Camera_Front"),
            MissingFileError,
            r"has no image .*/003/Camera_Front, which was missing in the release; unpack",
        )
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"resize": (36, 60)},
            r"has resize=\(18, 30\), expected \(36, 60\); choose the same, or make another",
        ),
        ({"crop": None}, r"has crop=\(2, 3, 12, 25\), expected None"),
        ({"crop": (2, 3, 12, 24)}, r"has crop=\(2, 3, 12, 25\), expected \(2, 3, 12, 24\)"),
        ({"decode": "scaled"}, "has decode='full', expected 'scaled'"),
    ],
)
def test_other_images_are_refused(cache: ImageCache, changes: dict[str, Any], words: str) -> None:
    assert_raises((lambda: cache.check(replace(IMAGES, **changes)), ConfigError, words))
    cache.check(replace(IMAGES, dtype="uint8"))


def test_another_release_and_agents_without_images_are_refused(
    da: DeepAccident, cache: ImageCache, release_root: Path, tmp_path: Path
) -> None:
    scenario = da.scenario[0]["token"]
    agents = [f"{scenario}/ego_vehicle"]
    cache.check_release(da, agents)

    # the images themselves need not be there
    root = tmp_path / "edited"
    ignore = shutil.ignore_patterns(".deepaccident", "Camera_*")
    shutil.copytree(release_root, root, ignore=ignore)
    cache.check_release(DeepAccident("v1", root, verbose=False), agents)

    scenario_type, name = scenario.split("/")
    label = next((root / scenario_type / "ego_vehicle" / "label" / name).glob("*_002.txt"))
    label.write_text(label.read_text() + "\n")
    edited = DeepAccident("v1", root, index_dir=tmp_path / "anew", verbose=False)
    message = ("another release", f"another state of {scenario}", "make a cache")
    assert_raises(
        (partial(cache.check_release, edited, agents), ConfigError, message),
        *(
            (
                partial(cache.check_release, da, [token]),
                ConfigError,
                (f"no images of {token}; choose other samples",),
            )
            for token in (f"{scenario}/other_vehicle", "elsewhere/unknown/ego_vehicle")
        ),
    )


def test_what_is_no_complete_cache_is_refused(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    form = CachedImages(images=IMAGES, where=EVERY_SCENARIO, agents=("infrastructure",))
    monkeypatch.setattr(CachedImages, "finish", lambda *_: 1 / 0)
    assert_raises(
        (
            lambda: ImageCache(tmp_path),
            ConfigError,
            ("contains no cache of images", "make one with deepaccident cache"),
        ),
        (lambda: export_release(da, out, form, workers=1), ZeroDivisionError, "division by zero"),
        (
            lambda: ImageCache(out),
            ConfigError,
            ("is not complete", "run the same deepaccident cache command again"),
        ),
    )


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-1], ""),
        (lambda content: content[:20], ""),
        (lambda _: b"", ""),
        (lambda content: b"x" + content, ""),
        (lambda _: make_header(1 << 62, 0), "has 0 cameras, and its cache 6"),
        (lambda _: make_header(0, 0), "has 0 cameras"),
        (lambda _: make_header(1, 7, *range(14)), "has 7 cameras"),
        (lambda _: make_header(-1, 6), "is cut off"),
        (lambda _: make_header(1 << 60, 6), "its table"),
        (lambda _: make_header(1, 6, *[0, 1 << 40] * 6), "is cut off"),
        (
            lambda _: make_header(1, 6, *[0, 33 << 20] * 6).ljust(40 << 20, b"\0"),
            "an image takes .* limit for image",
        ),
    ],
)
def test_a_damaged_file_or_one_of_another_cache_is_refused(
    da: DeepAccident, cache: ImageCache, tmp_path: Path, damage: Any, message: str
) -> None:
    shutil.copytree(cache.folder, tmp_path / "out")
    for path in (tmp_path / "out").glob("*.images"):
        path.write_bytes(damage(path.read_bytes()))
    assert_raises(
        (
            lambda: ImageCache(tmp_path / "out").load(IMAGES, da, list_cameras(da)[0]),
            SensorFileError,
            rf"(?s)\.images: .*{message}",
        )
    )


def make_header(rows: int, cameras: int, *table: int) -> bytes:
    return b"DAimages" + np.array([rows, cameras, *table], dtype="<i8").tobytes()


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("images", {}, "its images have no cameras"),
        (
            "images",
            {"resize": [18, 30], "crop": None, "decode": "full"},
            "its images have no cameras",
        ),
        (
            "images",
            {"resize": [18, 30], "crop": None, "cameras": [], "decode": "full"},
            "cameras: expected some of",
        ),
        (
            "images",
            {"resize": [18, "1"], "crop": None, "cameras": [], "decode": "full"},
            "images\\.resize\\[1\\]",
        ),
        ("images", [1], "at `\\$\\.images`"),
        ("codec", "x" * 1_000_000, "invalid enum value 'x+ … x+"),
        ("agents", [], "at `\\$\\.agents`"),
        ("agents", "ego_vehicle", "at `\\$\\.agents`"),
        ("agents", ["x" * 1_000_000], "invalid enum value"),
        ("version", 1, "at `\\$\\.version`"),
        ("version", None, "at `\\$\\.version`"),
    ],
)
def test_changed_settings_are_refused(
    cache: ImageCache, tmp_path: Path, name: str, value: Any, fault: str
) -> None:
    shutil.copytree(cache.folder, tmp_path / "out")
    path = tmp_path / "out" / "cache.manifest.json"
    manifest = json.loads(path.read_text())
    manifest["settings"][name] = value
    path.write_text(json.dumps(manifest))
    message = rf"images_cache: .* contains no cache of images \(.*{fault}.*\); make one"
    with pytest.raises(ConfigError, match=message) as error:
        ImageCache(tmp_path / "out")
    assert len(str(error.value)) < 600


def invoke_cache(*arguments: str | Path) -> Any:
    return CliRunner().invoke(deepaccident, ["cache", *map(str, arguments)])


def test_on_the_command_line(da: DeepAccident, tmp_path: Path) -> None:
    arguments = [
        da.dataroot,
        "--out",
        tmp_path / "out",
        "--workers",
        "1",
        "--size",
        "30x18",
        "--crop",
        "3,2,25,12",
    ]
    arguments += [
        "--agents",
        "ego_vehicle",
        "--channels",
        "Camera_Back,Camera_Front",
        "--decode",
        "scaled",
    ]
    refused = invoke_cache(*arguments)
    assert isinstance(refused.exception, ConfigError)
    assert "(--split, --where)" in str(refused.exception)
    arguments += ["--where", "length>=1"]
    assert invoke_cache(*arguments, "--dry-run").exit_code == 0
    assert not (tmp_path / "out").exists()
    result = invoke_cache(*arguments)
    assert result.exit_code == 0, result.output
    expected = replace(IMAGES, decode="scaled", cameras=("Camera_Back", "Camera_Front"))
    assert ImageCache(tmp_path / "out").images == expected
    assert "0 scenarios new" in invoke_cache(*arguments).output


def test_a_disk_that_is_too_small_is_refused(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    options = ("--size", "30x18", "--where", "length>=1")
    result = invoke_cache(da.dataroot, "--out", tmp_path / "out", *options)
    assert "not enough free space" in str(result.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [["--size", "30"], ["--size", "30x18", "--crop", "3,2,25"]])
def test_sizes_that_cannot_be_read(da: DeepAccident, tmp_path: Path, options: list[str]) -> None:
    assert "expected " in invoke_cache(da.dataroot, "--out", tmp_path / "out", *options).output
