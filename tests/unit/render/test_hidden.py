"""Points that the camera's own agent cannot see are not rendered over what hides them."""

from dataclasses import replace

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.hidden import hidden_points_filter
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.poses import ImagePoints


def test_what_lies_behind_the_agents_own_points_is_hidden(
    da: DeepAccident, follower_sample: str
) -> None:
    """Points above the highest one are hidden too, as a wall goes on there."""
    camera = f"{follower_sample}/Camera_Front"
    own_points = map_pointcloud_to_image(da, camera, colors=False)
    hide = hidden_points_filter(da, camera)

    nearer, unmoved, farther = (
        hide(replace(own_points, depth=factor * own_points.depth)).mask
        for factor in (0.5, 1.0, 4.0)
    )
    np.testing.assert_array_equal([nearer, unmoved], [own_points.mask] * 2)
    assert farther.sum() < 0.2 * own_points.mask.sum()

    highest = np.argmin(np.where(own_points.mask, own_points.pixels[:, 1], np.inf))
    top_of_column = (own_points.pixels[highest, 0], 0.5)
    above = ImagePoints(
        pixels=np.array([top_of_column] * 2),
        depth=own_points.depth[highest] * np.array([1.0, 4.0]),
        color=None,
        mask=np.ones(2, dtype=bool),
    )
    assert hide(above).mask.tolist() == [True, False]


def test_without_the_agents_cloud_nothing_is_hidden(da_motion: DeepAccident, sample: str) -> None:
    far_point = ImagePoints(
        pixels=np.ones((1, 2)),
        depth=np.array([500.0]),
        color=None,
        mask=np.ones(1, dtype=bool),
    )
    hide = hidden_points_filter(da_motion, f"{sample}/Camera_Front")

    assert hide(far_point).mask.all()
