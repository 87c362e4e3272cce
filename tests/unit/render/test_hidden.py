"""Points that the camera's own agent cannot see are not rendered over what hides them."""

from dataclasses import replace

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.poses import ImagePoints


def test_what_lies_behind_the_agents_own_points_is_hidden(da: DeepAccident, behind: str) -> None:
    """Also above the highest of them, where walls go on."""
    camera = f"{behind}/Camera_Front"
    own, seen = map_pointcloud_to_image(da, camera, colors=False), hiding(da, camera)
    shown = {
        factor: seen(replace(own, depth=factor * own.depth)).mask for factor in (0.5, 1.0, 4.0)
    }
    np.testing.assert_array_equal([shown[0.5], shown[1.0]], [own.mask] * 2)
    assert shown[4.0].sum() < 0.2 * own.mask.sum()
    highest = np.argmin(np.where(own.mask, own.pixels[:, 1], np.inf))
    places, depths = (
        np.array([[own.pixels[highest, 0], 0.5]] * 2),
        own.depth[highest] * np.array([1.0, 4.0]),
    )
    above = ImagePoints(pixels=places, depth=depths, color=None, mask=np.ones(2, dtype=bool))
    assert seen(above).mask.tolist() == [True, False]


def test_without_the_agents_cloud_nothing_is_hidden(da_motion: DeepAccident, sample: str) -> None:
    far = ImagePoints(
        pixels=np.ones((1, 2)), depth=np.array([500.0]), color=None, mask=np.ones(1, dtype=bool)
    )
    assert hiding(da_motion, f"{sample}/Camera_Front")(far).mask.all()
