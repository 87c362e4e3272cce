"""The lift: its geometry is the devkit's, and its sums hold all that the pixels have."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from support.expected_errors import assert_raises
from support.strategies import ANGLES, arrays, rotation_matrix
from torch_extra.model.tensors import make_noise

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
# optical axes (x right, y down, z forward) of a camera that faces along the ego's x axis
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CAMERA = PinholeCamera(np.array([[30.0, 0, 20], [0, 30, 12], [0, 0, 1]]), 40, 24)


def make_rig(seed: int = 0, shape: tuple[int, int, int] = (2, 2, 3)) -> CameraGeometry:
    """Make cameras near the origin that face all ways and are tilted a little."""
    random = np.random.default_rng(seed)
    count = int(np.prod(shape))
    angles = random.uniform(-1, 1, (count, 2)) * (np.pi, 0.1)
    arrays_by_name = {
        "rotation": np.stack([rotation_matrix(yaw, tilt, 0) @ FORWARD for yaw, tilt in angles]),
        "translation": random.uniform(-2, 2, (count, 3)),
        "intrinsics": np.tile(CAMERA.intrinsic, (count, 1, 1)),
    }
    tensors = {
        name: torch.tensor(values).float().unflatten(0, shape)
        for name, values in arrays_by_name.items()
    }
    return CameraGeometry(**tensors)


def make_lift(config: LiftConfig) -> LiftSplat:
    torch.manual_seed(0)
    return LiftSplat(config)


def make_lift_of_bias(config: LiftConfig, bias: dict[int, float]) -> LiftSplat:
    """Make a lift with depths and features that depend only on a bias."""
    lift = LiftSplat(config)
    torch.nn.init.zeros_(lift.depthnet.weight)
    torch.nn.init.zeros_(lift.depthnet.bias)
    lift.depthnet.bias.data[list(bias)] = torch.tensor(list(bias.values()))
    return lift


def make_pose(rotation: np.ndarray, position: ArrayLike) -> SE3:
    upper_rows = np.column_stack([rotation, position])
    return SE3(np.vstack([upper_rows, [0, 0, 0, 1]]))


def make_one_camera(camera: PinholeCamera, ego_from_camera: SE3) -> CameraGeometry:
    matrix = ego_from_camera.matrix
    rotation, translation, intrinsics = (
        torch.tensor(np.array(values))[None, None, None]
        for values in (matrix[:3, :3], matrix[:3, 3], camera.intrinsic)
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
    """Points project onto the centres of their pixels, and lie in the cells of a BevGrid."""
    lift = make_lift(replace(CONFIG, z=(-100, 100, 200)))
    camera = PinholeCamera(
        np.array([[fx, 0, 20 + centre[0]], [0, fy, 12 + centre[1]], [0, 0, 1]]),
        40,
        24,
    )
    ego_from_camera = make_pose(rotation_matrix(yaw, pitch, roll), position)
    cameras = make_one_camera(camera, ego_from_camera)

    points = lift.points(cameras).numpy().reshape(-1, 3)

    pixels, depths = camera.project(ego_from_camera.inverse().apply(points))
    bins, rows, columns = (values.ravel() for values in np.indices((8, 3, 5)))
    np.testing.assert_allclose(depths, 2.0 + 2 * bins, atol=1e-4)
    np.testing.assert_allclose(pixels, np.stack([8 * columns + 4, 8 * rows + 4], 1), atol=1e-3)

    index, inside = BevGrid(x=CONFIG.x, y=CONFIG.y).index_of(points)
    inside &= np.abs(points[:, 2]) < 100
    np.testing.assert_array_equal(
        lift.cells(cameras).flatten(), np.where(inside, index @ (32, 1), -1)
    )


def test_one_pixel_at_one_depth_lights_one_cell():
    """The camera is 1 m above the ego's origin and faces ahead.

    Its pixel in row 1 and column 3 is at (10, −8/3, 1) in a depth of 10 m. The cell of that point
    is in row (−8/3 + 16) / 0.5 and column 10 + 12.
    """
    lift = make_lift_of_bias(CONFIG, {4: 100.0})  # the fifth depth: 10 m
    lift.depthnet.weight.data[8:, :3, 0, 0] = torch.eye(3)
    camera = make_one_camera(CAMERA, make_pose(FORWARD, (0, 0, 1)))
    features = torch.zeros(1, 1, 1, 5, 3, 5)
    features[0, 0, 0, :3, 1, 3] = torch.tensor([1.0, 2.0, 3.0])
    expected = torch.zeros(1, 1, 3, 64, 32)
    expected[0, 0, :, 26, 22] = torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(lift(features, camera), expected)


@pytest.mark.parametrize(
    ("frustum", "columns", "rows"),
    [
        ("centres", [4, 12, 20, 28, 36], [4, 12, 20]),
        ("corners", [0, 9.75, 19.5, 29.25, 39], [0, 11.5, 23]),
    ],
)
def test_rays_pass_through_the_centres_or_from_corner_to_corner(frustum, columns, rows):
    rays = LiftSplat(replace(CONFIG, frustum=frustum)).frustum
    axes = (
        torch.arange(2.0, 18, 2),
        torch.tensor(rows).float(),
        torch.tensor(columns).float(),
    )
    torch.testing.assert_close(
        rays,
        torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], dim=-1),
        rtol=0,
        atol=0,
    )


# --- sums


def test_a_wide_map_holds_all_that_the_pixels_have():
    """Probabilities of depths sum to 1, so that the sum of a frame's map is that of its pixels."""
    lift, features = make_lift(WIDE), make_noise(2, 2, 3, 5, 3, 5)
    pixels = lift.depthnet(features.flatten(0, 2))[:, 8:].unflatten(0, (2, 2, 3))
    torch.testing.assert_close(
        lift(features, make_rig()).sum((3, 4)),
        pixels.sum((2, 4, 5)),
        atol=1e-4,
        rtol=1e-4,
    )


def test_gradients_reach_the_features_and_every_weight():
    lift = make_lift(CONFIG)
    features = make_noise(1, 2, 3, 5, 3, 5).requires_grad_()

    maps = lift(features, make_rig(shape=(1, 2, 3)))
    (maps * make_noise(*maps.shape, seed=1)).sum().backward()

    assert all((weight.grad != 0).all() for weight in lift.parameters())
    assert (features.grad != 0).any()


# --- options of `tiny` that the release does not have


def test_only_points_in_the_band_above_the_road_count():
    """The road is at height 0 under a vehicle's cameras, and 4 m below the cameras of a pole."""
    cameras, lift = make_rig(), make_lift(CONFIG)
    banded = make_lift(replace(CONFIG, band=(-0.5, 1.5)))
    for camera_height, road_height in ((1.8, 0.0), (0.0, -4.0)):
        cameras.translation[..., 2] = camera_height
        heights = lift.points(cameras)[..., 2] - road_height
        cells = lift.cells(cameras)
        expected = torch.where((heights >= -0.5) & (heights < 1.5), cells, -1)
        assert torch.equal(banded.cells(cameras), expected)
        assert 10 < int((expected >= 0).sum()) < int((cells >= 0).sum()) - 10


def test_a_mean_does_not_grow_with_the_number_of_points():
    """Where all features are equal, each reached cell has almost these features."""
    lift = make_lift_of_bias(replace(CONFIG, pooling="mean"), {8: 1.0, 9: 2.0, 10: 3.0})
    cameras = make_rig()

    maps = lift(make_noise(2, 2, 3, 5, 3, 5), cameras)

    cells = lift.cells(cameras).flatten(2).flatten(0, 1)
    counts = [torch.bincount(frame[frame >= 0], minlength=64 * 32) for frame in cells]
    mass = torch.stack(counts).view(2, 2, 1, 64, 32) / 8
    torch.testing.assert_close(
        maps,
        mass / (mass + 0.01) * torch.tensor([1.0, 2.0, 3.0])[:, None, None],
    )
    assert 0.9 < float(maps.detach()[:, :, 0].max()) < 1


# --- errors


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": (1, 10, 2)}, r"depth: expected start, end and step .* found \(1, 10, 2\)"),
        ({"depth": (1, 10, 0)}, "depth: expected start, end and step"),
        ({"z": (-10, 10, 5)}, "z: expected one step"),
        ({"x": (-10, 10, 3)}, "x: -10 to 10 m is not a whole number of cells"),
        ({"band": (2.5, -0.5)}, "band: expected the lower end, then the higher end"),
        ({"image_size": (90, 160), "stride": 8}, r"multiples of the stride 8, found \(90, 160\)"),
    ],
)
def test_a_wrong_configuration_is_named(change, message):
    assert_raises((lambda: replace(CONFIG, **change), ConfigError, message))


def test_features_of_another_shape_are_named():
    lift = make_lift(CONFIG)
    features, turned_features = make_noise(2, 2, 3, 5, 3, 5), make_noise(2, 2, 3, 5, 5, 3)
    assert_raises(
        (lambda: lift(turned_features, make_rig()), GeometryError, ("features", "(…, 3, 5)")),
        (
            lambda: lift(features, make_rig(shape=(2, 2, 2))),
            GeometryError,
            ("cameras", "cells (2, 2, 3, 8, 3, 5)"),
        ),
    )
