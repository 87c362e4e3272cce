"""Thumbnails: the accident as a camera had it, from above where no image is there."""

import io
import shutil
from pathlib import Path

import numpy as np
from PIL import Image, ImageColor
from replay_page import accident, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.explore.explorer import SIZE, Explorer, thumbnail
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR


def pixels(jpeg: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(jpeg))
    assert image.size == SIZE
    return np.asarray(image, dtype=int)


def near(shown: np.ndarray, color: str, off: int = 60) -> int:
    """How many pixels are about of a colour."""
    return int((np.abs(shown - ImageColor.getrgb(color)).max(axis=-1) < off).sum())


def test_an_accident_has_red_boxes_and_a_normal_one_has_none(da: DeepAccident) -> None:
    shown = pixels(thumbnail(da, da.get("scenario", accident(da))))
    assert near(shown, COLLIDER_COLOR) > 40
    assert near(pixels(thumbnail(da, da.get("scenario", normal(da)))), COLLIDER_COLOR) < 10


def test_without_images_it_is_seen_from_above(da_b: DeepAccident) -> None:
    shown = pixels(thumbnail(da_b, da_b.get("scenario", accident(da_b))))
    assert near(shown, COLLIDER_COLOR) > 40
    assert near(shown, "#ffffff", 10) > shown.shape[0] * shown.shape[1] / 2


def test_without_labels_it_is_grey(own_release: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    shown = pixels(thumbnail(dataset, dataset.scenario[0]))
    assert near(shown, MISSING_COLOR, 4) == shown.shape[0] * shown.shape[1]


def test_a_damaged_image_does_not_matter(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "damaged"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    for path in root.rglob("*.jpg"):
        path.write_bytes(b"no picture")
    dataset = DeepAccident("v1", root, verbose=False)
    assert near(pixels(thumbnail(dataset, dataset.get("scenario", accident(dataset)))), "#ffffff", 10) > 1000


def test_images_that_come_later_are_shown(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "later"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "Camera_*"))
    explorer = Explorer(DeepAccident("v1", root, verbose=False))
    token = accident(explorer.dataset)  # type: ignore[arg-type]
    before = explorer.thumbnail(token)
    assert explorer.thumbnail(token) == before
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"), dirs_exist_ok=True)
    assert explorer.thumbnail(token) == thumbnail(da, da.get("scenario", token)) != before
