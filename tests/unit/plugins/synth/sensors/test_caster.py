import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.sensors import caster
from deepaccident_devkit.plugins.synth.sensors.caster import (
    GROUND,
    NO_HIT,
    EmbreeCaster,
    NumpyCaster,
)


@pytest.mark.parametrize("kind", [EmbreeCaster, NumpyCaster])
@pytest.mark.parametrize("grounded", [False, True])
def test_rays_end_at_their_reach(kind, world, grounded):
    corners = Boxes.from_arrays([[5, 0, 1]], [[2, 2, 2]], [0]).corners()
    ray_caster = kind(corners, world.terrain if grounded else None)
    directions = np.array(
        [
            [1.0, 0, 0],
            [1.0, 0, 0],
            [0, 0, -1.0],
            [0, 0, -1.0],
        ]
    )
    reach = np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32)
    unchanged = reach.copy()

    distances, faces = ray_caster.cast(np.array([0.0, 0.0, 1.0]), directions, reach)

    last_distance, last_face = (1, GROUND) if grounded else (np.inf, NO_HIT)
    np.testing.assert_allclose(distances, [np.inf, 4, np.inf, last_distance])
    assert faces.tolist() == [NO_HIT, 1, NO_HIT, last_face]
    np.testing.assert_array_equal(reach, unchanged)


@pytest.mark.parametrize("kind", [EmbreeCaster, NumpyCaster])
@pytest.mark.parametrize("world_name", ["world", "hilly_world"])
def test_rays_end_on_the_ground(rng, request, kind, world_name):
    terrain = request.getfixturevalue(world_name).terrain
    ray_caster = kind(np.zeros((0, 8, 3)), terrain)
    origin = np.array([-20.0, 0.0, 3.0])
    directions = rng.normal(size=(3000, 3))
    directions[:, 2] = -0.2 * np.abs(directions[:, 2]) - 0.02

    distances, faces = ray_caster.cast(origin, directions)

    points = origin + distances[:, None] * directions
    near = np.abs(points[:, :2]).max(axis=1) < 100
    assert near.mean() > 0.5
    assert set(faces[near].tolist()) == {GROUND}
    ground = terrain.height(points[near, :2])
    np.testing.assert_allclose(points[near, 2], ground, atol=0.05)


def test_without_embree_the_error_names_the_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr(caster, "has_embree", lambda: False)
    config = SynthConfig(sensors="cameras")
    assert_raises(
        (
            lambda: make_release(tmp_path / "release", config),
            MissingExtraError,
            ("pip install '.[synth]'", "--sensors none"),
        )
    )
    assert list(tmp_path.iterdir()) == []


def test_labels_without_embree_are_nearly_the_same(monkeypatch, world, actor, rig_of):
    cars = [actor(10 + k, "car", 9.0 * k, 1.75, np.pi) for k in range(4)]

    def make_labels(available):
        monkeypatch.setattr(caster, "has_embree", lambda: available)
        rig = rig_of(world, cars, sensors="none")
        return rig.sighting(rig.scene(0.0), rig.agents[0], 1).labels

    with_embree, without = make_labels(True), make_labels(False)
    for name, atol in (
        ("center", 0),
        ("camera_visible", 0),
        ("num_lidar_pts", 3),
    ):
        np.testing.assert_allclose(
            getattr(with_embree, name),
            getattr(without, name),
            rtol=0,
            atol=atol,
        )
