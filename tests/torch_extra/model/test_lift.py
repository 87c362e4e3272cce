"""The lift: its geometry is the devkit's, and sums are whole."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from refusals import assert_refused
from strategies import ANGLES, arrays, rotation_matrix

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, PinholeCamera
from deepaccident_devkit.plugins.model.lift import CameraGeometry, LiftConfig, LiftSplat

CONFIG = LiftConfig(
    in_channels=5,
    channels=3,
    depth=(2, 18, 2),
    x=(-12, 20, 1),
    y=(-16, 16, 0.5),
    z=(-4, 6, 10),
    image_size=(24, 40),
    stride=8,
)
WIDE = replace(CONFIG, x=(-200, 200, 10), y=(-200, 200, 10), z=(-200, 200, 400))
# optical axes (x right, y down, z forward) of a camera that looks along the ego's x axis
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CAMERA = PinholeCamera(np.array([[30.0, 0, 20], [0, 30, 12], [0, 0, 1]]), 40, 24)


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def rig(seed: int = 0, shape: tuple[int, int, int] = (2, 2, 3)) -> CameraGeometry:
    """Cameras at heights of a car's that look around."""
    random = np.random.default_rng(seed)
    count = int(np.prod(shape))
    angles = random.uniform(-1, 1, (count, 2)) * (np.pi, 0.1)
    given = {
        "rotation": np.stack([rotation_matrix(yaw, tilt, 0) @ FORWARD for yaw, tilt in angles]),
        "translation": random.uniform(-2, 2, (count, 3)),
        "intrinsics": np.tile(CAMERA.intrinsic, (count, 1, 1)),
    }
    return CameraGeometry(
        **{name: torch.tensor(each).float().unflatten(0, shape) for name, each in given.items()}
    )


def lift_of(config: LiftConfig) -> LiftSplat:
    torch.manual_seed(0)
    return LiftSplat(config)


def without_weights(config: LiftConfig, bias: dict[int, float]) -> LiftSplat:
    """One whose depths and features are those of a bias alone."""
    lift = LiftSplat(config)
    torch.nn.init.zeros_(lift.depthnet.weight)
    torch.nn.init.zeros_(lift.depthnet.bias)
    lift.depthnet.bias.data[list(bias)] = torch.tensor(list(bias.values()))
    return lift


def posed(rotation: np.ndarray, position: ArrayLike) -> SE3:
    return SE3(np.vstack([np.column_stack([rotation, position]), [0, 0, 0, 1]]))


def one_camera(camera: PinholeCamera, ego_from_camera: SE3) -> CameraGeometry:
    parts = (ego_from_camera.matrix[:3, :3], ego_from_camera.matrix[:3, 3], camera.intrinsic)
    rotation, translation, intrinsics = (
        torch.tensor(np.array(each))[None, None, None] for each in parts
    )
    return CameraGeometry(rotation=rotation, translation=translation, intrinsics=intrinsics)


# --- geometry


@given(
    ANGLES,
    ANGLES,
    ANGLES,
    arrays((3,), 5.0),
    st.floats(10, 200),
    st.floats(10, 200),
    arrays((2,), 30.0),
)
def test_points_lie_where_the_devkit_sees_them(yaw, pitch, roll, position, fx, fy, centre):
    """Points project onto the centres of their pixels at their depths, and their cells are those of
    a BevGrid.
    """
    lift = lift_of(replace(CONFIG, z=(-100, 100, 200)))
    camera = PinholeCamera(
        np.array([[fx, 0, 20 + centre[0]], [0, fy, 12 + centre[1]], [0, 0, 1]]), 40, 24
    )
    ego_from_camera = posed(rotation_matrix(yaw, pitch, roll), position)
    cameras = one_camera(camera, ego_from_camera)
    points = lift.points(cameras).numpy().reshape(-1, 3)
    pixels, depth = camera.project(ego_from_camera.inverse().apply(points))
    d, i, j = np.meshgrid(np.arange(8), np.arange(3), np.arange(5), indexing="ij")
    np.testing.assert_allclose(depth, 2.0 + 2 * d.ravel(), atol=1e-4)
    np.testing.assert_allclose(
        pixels, np.stack([8 * j.ravel() + 4, 8 * i.ravel() + 4], 1), atol=1e-3
    )

    index, inside = BevGrid(x=CONFIG.x, y=CONFIG.y).index_of(points)
    expected = np.where(inside & (np.abs(points[:, 2]) < 100), index @ (32, 1), -1)
    np.testing.assert_array_equal(lift.cells(cameras).flatten(), expected)


def test_one_pixel_at_one_depth_lights_one_cell():
    """A camera 1 m above the ego's origin that looks ahead: pixel row 1, column 3 at 10 m is at
    (10, −8/3, 1).

    Its cell is in row (−8/3 + 16) / 0.5 and column 10 + 12.
    """
    lift = without_weights(CONFIG, {4: 100.0})  # the fifth depth: 10 m
    lift.depthnet.weight.data[8:, :3, 0, 0] = torch.eye(3)
    features, expected = torch.zeros(1, 1, 1, 5, 3, 5), torch.zeros(1, 1, 3, 64, 32)
    features[0, 0, 0, :3, 1, 3] = expected[0, 0, :, 26, 22] = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(
        lift(features, one_camera(CAMERA, posed(FORWARD, (0, 0, 1)))), expected
    )


@pytest.mark.parametrize(
    ("frustum", "columns", "rows"),
    [
        ("centres", [4, 12, 20, 28, 36], [4, 12, 20]),
        ("corners", [0, 9.75, 19.5, 29.25, 39], [0, 11.5, 23]),
    ],
)
def test_rays_pass_through_the_centres_or_from_corner_to_corner(frustum, columns, rows):
    rays = LiftSplat(replace(CONFIG, frustum=frustum)).frustum
    depths, down, along = (
        torch.arange(2.0, 18, 2),
        torch.tensor(rows).float(),
        torch.tensor(columns).float(),
    )
    expected = torch.stack(torch.meshgrid(depths, down, along, indexing="ij")[::-1], dim=-1)
    torch.testing.assert_close(rays, expected, rtol=0, atol=0)


# --- sums


def test_a_wide_map_holds_all_that_the_pixels_have():
    """Probabilities of depths sum to 1, so that the map's sum is the sum over pixels, frame by
    frame.
    """
    lift, features = lift_of(WIDE), noise(2, 2, 3, 5, 3, 5)
    pixels = lift.depthnet(features.flatten(0, 2))[:, 8:].unflatten(0, (2, 2, 3))
    torch.testing.assert_close(
        lift(features, rig()).sum((3, 4)), pixels.sum((2, 4, 5)), atol=1e-4, rtol=1e-4
    )


def test_gradients_reach_the_features_and_every_weight():
    lift, features = lift_of(CONFIG), noise(1, 2, 3, 5, 3, 5).requires_grad_()
    bev = lift(features, rig(shape=(1, 2, 3)))
    (bev * noise(*bev.shape, seed=1)).sum().backward()
    assert all((weight.grad != 0).all() for weight in lift.parameters())
    assert (features.grad != 0).any()


# --- what `tiny` has beside the release


def test_only_points_in_the_band_above_the_road_count():
    """The road is at the origin's height under cameras that stand above it, and 4 m below those of
    a pole.
    """
    cameras, plain, banded = rig(), lift_of(CONFIG), lift_of(replace(CONFIG, band=(-0.5, 1.5)))
    for height, road in ((1.8, 0.0), (0.0, -4.0)):
        cameras.translation[..., 2] = height
        above, cells = plain.points(cameras)[..., 2] - road, plain.cells(cameras)
        expected = torch.where((above >= -0.5) & (above < 1.5), cells, -1)
        assert torch.equal(banded.cells(cameras), expected)
        assert 10 < int((expected >= 0).sum()) < int((cells >= 0).sum()) - 10


def test_a_mean_does_not_grow_with_the_number_of_points():
    """Where all features are equal, each cell that is reached has them, or nearly."""
    lift, cameras = (
        without_weights(replace(CONFIG, pooling="mean"), {8: 1.0, 9: 2.0, 10: 3.0}),
        rig(),
    )
    maps, cells = lift(noise(2, 2, 3, 5, 3, 5), cameras), lift.cells(cameras).flatten(2)
    points = [
        [torch.bincount(each[each >= 0], minlength=64 * 32).view(64, 32) for each in row]
        for row in cells
    ]
    mass = torch.stack([torch.stack(row) for row in points]) / 8
    expected = (mass / (mass + 0.01))[:, :, None] * torch.tensor([1.0, 2.0, 3.0])[:, None, None]
    torch.testing.assert_close(maps, expected)
    assert 0.9 < float(maps.detach()[:, :, 0].max()) < 1


# --- errors


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": (1, 10, 2)}, r"depth: expected start, end and step .* found \(1, 10, 2\)"),
        ({"depth": (1, 10, 0)}, "depth: expected start, end and step"),
        ({"z": (-10, 10, 5)}, "z: expected one step"),
        ({"x": (-10, 10, 3)}, "x: -10 to 10 m is not a whole number of cells"),
        ({"band": (2.5, -0.5)}, "band: expected a lower and a higher end"),
        ({"image_size": (90, 160), "stride": 8}, r"multiples of the stride 8, found \(90, 160\)"),
    ],
)
def test_a_wrong_configuration_is_named(change, message):
    assert_refused((lambda: replace(CONFIG, **change), ConfigError, message))


def test_features_of_another_shape_are_named():
    lift, good = lift_of(CONFIG), noise(2, 2, 3, 5, 3, 5)
    assert_refused(
        (lambda: lift(noise(2, 2, 3, 5, 5, 3), rig()), GeometryError, ("features", "(…, 3, 5)")),
        (
            lambda: lift(good, rig(shape=(2, 2, 2))),
            GeometryError,
            ("cameras", "cells (2, 2, 3, 8, 3, 5)"),
        ),
    )
