"""Which camera shows an actor best, and the part of its image about the actor."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.camera import best_view, crop_about
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from deepaccident_devkit.v2x.poses import camera_of


def test_the_best_view_of_the_vehicle_ahead_is_the_front_camera(da: DeepAccident, behind: str) -> None:
    boxes = da.boxes(behind, "world")
    ego = da.get("agent", f"{behind.rsplit('/', 2)[0]}/ego_vehicle")["actor_id"]
    view = best_view(da, [behind], boxes.select(boxes.actor_id == ego))
    assert view is not None
    assert view.camera == f"{behind}/Camera_Front"
    pixels, _ = camera_of(da, view.camera).project(da.boxes(behind, "Camera_Front").corners()[boxes.actor_id == ego][0])
    low, high = pixels.min(axis=0).clip(0, (64, 36)), pixels.max(axis=0).clip(0, (64, 36))
    assert_allclose(view.bounds, [*low, *high])
    assert view.area == pytest.approx(float(np.prod(high - low)))


def test_what_no_camera_sees_has_no_best_view(da: DeepAccident, behind: str) -> None:
    boxes = da.boxes(behind, "world")
    assert best_view(da, [behind], boxes.select(boxes.actor_id == OWN_ACTOR_ID)) is None


@pytest.mark.parametrize("bounds", [(10.0, 10, 14, 12), (0.0, 0, 5, 5), (0.0, 0, 64, 36), (60.0, 30, 64, 36)])
def test_a_crop_has_the_image_s_shape_holds_the_bounds_and_stays_inside(bounds: Any) -> None:
    left, top, right, bottom = crop_about(bounds, width=64, height=36)
    assert (right - left) / (bottom - top) == pytest.approx(64 / 36)
    assert min(left, top) >= 0
    assert right <= 64
    assert bottom <= 36
    assert left <= bounds[0]
    assert top <= bounds[1]
    assert right >= bounds[2]
    assert bottom >= bounds[3]
