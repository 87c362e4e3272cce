"""Points that the camera's own agent cannot see are not rendered over what hides them."""

from dataclasses import replace

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.v2x import map_pointcloud_to_image
from deepaccident_devkit.v2x.poses import ImagePoints, camera_of


def test_what_lies_behind_the_agents_own_points_is_hidden(da: DeepAccident, behind: str) -> None:
    camera = f"{behind}/Camera_Front"
    own, seen = map_pointcloud_to_image(da, camera, colors=False), hiding(da, camera)
    np.testing.assert_array_equal(seen(own).mask, own.mask)
    nearer, farther = (seen(replace(own, depth=factor * own.depth)).mask for factor in (0.5, 4.0))
    np.testing.assert_array_equal(nearer, own.mask)
    assert farther.sum() < 0.2 * own.mask.sum()


def test_a_wall_goes_on_above_the_highest_ring_and_ground_between_two_rings(da: DeepAccident, behind: str) -> None:
    camera = f"{behind}/Camera_Front"
    own, lens = map_pointcloud_to_image(da, camera, colors=False), camera_of(da, camera)
    side = lens.width / 50
    cells = (own.pixels[own.mask] // side).astype(int)
    column = np.bincount(cells[:, 0]).argmax()
    rows = np.unique(cells[cells[:, 0] == column, 1])
    deepest = {row: own.depth[own.mask][(cells == (column, row)).all(axis=1)].max() for row in (rows[0], rows[-1])}
    places = np.array([(column, rows[0] - 1), (column, rows[-1])]) * side + side / 2
    for share, shown in ((1.0, True), (1.2, False)):
        depth = share * np.array([deepest[rows[0]], deepest[rows[-1]]]) + 1.0
        points = ImagePoints(pixels=places, depth=depth, color=None, mask=np.ones(2, dtype=bool))
        assert hiding(da, camera)(points).mask.tolist() == [shown, shown]


def test_without_the_agents_cloud_nothing_is_hidden(da_motion: DeepAccident, sample: str) -> None:
    points = ImagePoints(pixels=np.ones((1, 2)), depth=np.array([500.0]), color=None, mask=np.ones(1, dtype=np.bool_))
    assert hiding(da_motion, f"{sample}/Camera_Front")(points).mask.all()
