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
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingFileError, SensorFileError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.training.image_cache import CachedImages, ImageCache

pytestmark = pytest.mark.slow

IMAGES = ImageConfig(resize=(18, 30), crop=(2, 3, 12, 25))
ALL = ("length>=1",)
FEW = ("ego_vehicle", "infrastructure")


def made(
    dataset: DeepAccident, folder: Path, images: ImageConfig = IMAGES, **fields: Any
) -> ImageCache:
    export_release(
        dataset,
        folder,
        CachedImages(**{"images": images, "where": ALL, "agents": FEW, **fields}),
        workers=1,
    )
    return ImageCache(folder)


@pytest.fixture(scope="module")
def cache(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> ImageCache:
    return made(da, tmp_path_factory.mktemp("cache") / "raw")


def cameras_of(dataset: DeepAccident) -> list[str]:
    tokens = [record["token"] for record in dataset.sample if record["agent"] in FEW]
    return [f"{token}/{camera}" for token in tokens for camera in CAMERAS]


@pytest.mark.parametrize("decode", ["full", "scaled"])
def test_raw_images_are_the_uncached_ones(da: DeepAccident, tmp_path: Path, decode: Any) -> None:
    images = replace(IMAGES, decode=decode)
    cache = pickle.loads(pickle.dumps(made(da, tmp_path / "out", images)))
    for camera in cameras_of(da):
        for found, expected in zip(
            cache.load(images, da, camera), images.load(da, camera), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
        assert cache.has(camera)


def test_whole_images_can_be_cropped_later_and_cameras_chosen(
    da: DeepAccident, tmp_path: Path
) -> None:
    cache = made(da, tmp_path / "out", replace(IMAGES, crop=None))
    wanted, camera = replace(IMAGES, cameras=("Camera_Back", "Camera_Front")), cameras_of(da)[5]
    cache.check(wanted)
    for found, expected in zip(
        cache.load(wanted, da, camera), wanted.load(da, camera), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_jpeg_images_are_nearly_the_uncached_ones(
    da: DeepAccident, cache: ImageCache, tmp_path: Path
) -> None:
    smaller = made(da, tmp_path / "out", codec="jpeg")
    for camera in cameras_of(da)[::7]:
        found, intrinsic = smaller.load(IMAGES, da, camera)
        raw, expected = cache.load(IMAGES, da, camera)
        assert (found.shape, np.abs(found.astype(int) - raw).mean() < 6) == ((12, 25, 3), True)
        np.testing.assert_array_equal(intrinsic, expected)


@pytest.mark.parametrize(("codec", "exact"), [("raw", 0), ("jpeg", 0.5)])
def test_the_plan_is_what_is_written(
    da: DeepAccident, tmp_path: Path, codec: Any, exact: float
) -> None:
    form = CachedImages(images=IMAGES, where=ALL, codec=codec)
    done = export_release(da, tmp_path / "out", form, workers=1).tally
    told = export_release(da, tmp_path / "none", form, dry_run=True).tally
    assert (done.samples, done.files, done.left_out) == (len(da.sample), len(da.scenario), {})
    assert told.bytes == pytest.approx(done.bytes, rel=exact)


def test_what_a_partial_release_lacks_is_absent(da_partial: DeepAccident, tmp_path: Path) -> None:
    form = CachedImages(images=IMAGES, where=ALL, agents=("ego_vehicle", "other_vehicle_behind"))
    done = export_release(da_partial, tmp_path / "out", form, workers=1)
    frames = sum(record["num_frames"] for record in da_partial.scenario)
    assert done.tally.left_out == {
        "agents of scenarios that are not in this release": len(da_partial.scenario),
        "images that are not in this release": frames,
    }
    cache, sample = (
        ImageCache(tmp_path / "out"),
        f"{da_partial.scenario[0]['token']}/ego_vehicle/003",
    )
    assert [cache.has(f"{sample}/{camera}") for camera in CAMERAS] == [
        camera != "Camera_Front" for camera in CAMERAS
    ]
    assert_refused(
        (
            lambda: cache.load(IMAGES, da_partial, f"{sample}/Camera_Front"),
            MissingFileError,
            r"has no image .*/003/Camera_Front, which the release lacked; unpack",
        )
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"resize": (36, 60)},
            r"has resize=\(18, 30\), wanted is \(36, 60\); choose the same, or make another",
        ),
        ({"crop": None}, r"has crop=\(2, 3, 12, 25\), wanted is None"),
        ({"crop": (2, 3, 12, 24)}, r"has crop=\(2, 3, 12, 25\), wanted is \(2, 3, 12, 24\)"),
        ({"decode": "scaled"}, "has decode='full', wanted is 'scaled'"),
    ],
)
def test_other_images_are_refused(cache: ImageCache, changes: dict[str, Any], words: str) -> None:
    assert_refused((lambda: cache.check(replace(IMAGES, **changes)), ConfigError, words))
    cache.check(replace(IMAGES, dtype="uint8"))


def test_another_release_and_agents_without_images_are_refused(
    da: DeepAccident, cache: ImageCache, release_root: Path, tmp_path: Path
) -> None:
    scenario = da.scenario[0]["token"]
    cache.check_release(da, [f"{scenario}/ego_vehicle"])
    shutil.copytree(
        release_root,
        tmp_path / "edited",
        ignore=shutil.ignore_patterns(".deepaccident", "Camera_*"),
    )
    edited = DeepAccident("v1", tmp_path / "edited", verbose=False)
    cache.check_release(
        edited, [f"{scenario}/ego_vehicle"]
    )  # the images themselves need not be there
    kind, name = scenario.split("/")
    label = next((tmp_path / "edited" / kind / "ego_vehicle" / "label" / name).glob("*_002.txt"))
    label.write_text(label.read_text() + "\n")
    edited = DeepAccident("v1", tmp_path / "edited", index_dir=tmp_path / "anew", verbose=False)
    changed = partial(cache.check_release, edited, [f"{scenario}/ego_vehicle"])
    assert_refused(
        (changed, ConfigError, ("another release", f"another state of {scenario}", "make a cache")),
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
    out, form = tmp_path / "out", CachedImages(images=IMAGES, where=ALL, agents=("infrastructure",))
    monkeypatch.setattr(CachedImages, "finish", lambda *_: 1 / 0)
    assert_refused(
        (
            lambda: ImageCache(tmp_path),
            ConfigError,
            ("holds no cache of images", "make one with deepaccident cache"),
        ),
        (lambda: export_release(da, out, form, workers=1), ZeroDivisionError, "division by zero"),
        (
            lambda: ImageCache(out),
            ConfigError,
            ("is not complete", "run the deepaccident cache that makes it again"),
        ),
    )


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda content: content[:-1], ""),
        (lambda content: content[:20], ""),
        (lambda _: b"", ""),
        (lambda content: b"x" + content, ""),
        (lambda _: headed(1 << 62, 0), "has 0 cameras, and its cache 6"),
        (lambda _: headed(0, 0), "has 0 cameras"),
        (lambda _: headed(1, 7, *range(14)), "has 7 cameras"),
        (lambda _: headed(-1, 6), "is cut off"),
        (lambda _: headed(1 << 60, 6), "its table"),
        (lambda _: headed(1, 6, *[0, 1 << 40] * 6), "is cut off"),
        (
            lambda _: headed(1, 6, *[0, 33 << 20] * 6).ljust(40 << 20, b"\0"),
            "an image takes .* limit for image",
        ),
    ],
)
def test_a_damaged_file_or_one_of_another_cache_is_refused(
    da: DeepAccident, cache: ImageCache, tmp_path: Path, damage: Any, told: str
) -> None:
    shutil.copytree(cache.folder, tmp_path / "out")
    for path in (tmp_path / "out").glob("*.images"):
        path.write_bytes(damage(path.read_bytes()))
    assert_refused(
        (
            lambda: ImageCache(tmp_path / "out").load(IMAGES, da, cameras_of(da)[0]),
            SensorFileError,
            rf"(?s)\.images: .*{told}",
        )
    )


def headed(rows: int, cameras: int, *table: int) -> bytes:
    return b"DAimages" + np.array([rows, cameras, *table], dtype="<i8").tobytes()


@pytest.mark.parametrize(
    ("name", "value", "place"),
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
    cache: ImageCache, tmp_path: Path, name: str, value: Any, place: str
) -> None:
    shutil.copytree(cache.folder, tmp_path / "out")
    path = tmp_path / "out" / "cache.manifest.json"
    told = json.loads(path.read_text())
    told["settings"][name] = value
    path.write_text(json.dumps(told))
    with pytest.raises(
        ConfigError, match=rf"images_cache: .* holds no cache of images \(.*{place}.*\); make one"
    ) as error:
        ImageCache(tmp_path / "out")
    assert len(str(error.value)) < 600


def command(*words: str | Path) -> Any:
    return CliRunner().invoke(deepaccident, ["cache", *map(str, words)])


def test_on_the_command_line(da: DeepAccident, tmp_path: Path) -> None:
    words = [
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
    words += [
        "--agents",
        "ego_vehicle",
        "--channels",
        "Camera_Back,Camera_Front",
        "--decode",
        "scaled",
    ]
    refused = command(*words)
    assert isinstance(refused.exception, ConfigError)
    assert "(--split, --where)" in str(refused.exception)
    words += ["--where", "length>=1"]
    assert (command(*words, "--dry-run").exit_code, (tmp_path / "out").exists()) == (0, False)
    done = command(*words)
    assert done.exit_code == 0, done.output
    assert ImageCache(tmp_path / "out").images == replace(
        IMAGES, decode="scaled", cameras=("Camera_Back", "Camera_Front")
    )
    assert "0 scenarios written now" in command(*words).output


def test_a_disk_that_is_too_small_is_refused(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    found = command(
        da.dataroot, "--out", tmp_path / "out", "--size", "30x18", "--where", "length>=1"
    ).exception
    assert "too little room" in str(found)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["--size", "30"], ["--size", "30x18", "--crop", "3,2,25"]])
def test_sizes_that_cannot_be_read(da: DeepAccident, tmp_path: Path, words: list[str]) -> None:
    assert "expected " in command(da.dataroot, "--out", tmp_path / "out", *words).output
