import numpy as np
import pytest

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.sensors import caster
from deepaccident_devkit.synth.sensors.caster import GROUND, NOTHING, EmbreeCaster, NumpyCaster


@pytest.fixture
def corners(rng):
    boxes = Boxes.from_arrays(rng.uniform(-20, 20, (30, 3)), rng.uniform(1, 5, (30, 3)), rng.uniform(-3, 3, 30))
    return boxes.corners()


def test_numpy_equals_embree(corners, rng):
    directions = rng.normal(size=(3000, 3)).astype(np.float32)
    origin = np.array([0.0, 0.0, 60.0])
    directions[:, 2] = -4 * np.abs(directions[:, 2]) - 1
    fast, slow = EmbreeCaster(corners).cast(origin, directions), NumpyCaster(corners).cast(origin, directions)
    assert 300 < (fast[1] >= 0).sum() < 2900
    assert (fast[1] == slow[1]).mean() > 0.998
    same = fast[1] == slow[1]
    np.testing.assert_allclose(fast[0][same], slow[0][same], rtol=1e-4)


@pytest.mark.parametrize("kind", [EmbreeCaster, NumpyCaster])
def test_nearest_face_is_met(kind):
    corners = Boxes.from_arrays([[5, 0, 0], [10, 0, 0]], [[2, 2, 2]] * 2, [0, 0]).corners()
    distance, face = kind(corners).cast(np.zeros(3), np.array([[1.0, 0, 0], [-1, 0, 0], [0.5, 0, 0]]))
    np.testing.assert_allclose(distance, [4, np.inf, 8])
    assert face.tolist() == [1, NOTHING, 1]


@pytest.mark.parametrize("kind", [EmbreeCaster, NumpyCaster])
@pytest.mark.parametrize("grounded", [False, True])
def test_rays_end_at_their_reach(kind, world, grounded):
    corners = Boxes.from_arrays([[5, 0, 1]], [[2, 2, 2]], [0]).corners()
    directions = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -1.0], [0, 0, -1.0]])
    reach = np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32)
    distance, face = kind(corners, world.terrain if grounded else None).cast(
        np.array([0.0, 0.0, 1.0]), directions, reach
    )
    np.testing.assert_allclose(distance, [np.inf, 4, np.inf, 1 if grounded else np.inf])
    assert face.tolist() == [NOTHING, 1, NOTHING, GROUND if grounded else NOTHING]
    np.testing.assert_array_equal(reach, np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32))


@pytest.mark.parametrize("kind", [EmbreeCaster, NumpyCaster])
@pytest.mark.parametrize("place", ["world", "hilly_world"])
def test_rays_end_on_the_ground(rng, request, kind, place):
    terrain = request.getfixturevalue(place).terrain
    directions = rng.normal(size=(3000, 3))
    directions[:, 2] = -0.2 * np.abs(directions[:, 2]) - 0.02
    origin = np.array([-20.0, 0.0, 3.0])
    distance, face = kind(np.zeros((0, 8, 3)), terrain).cast(origin, directions)
    points = origin + distance[:, None] * directions
    near = np.abs(points[:, :2]).max(axis=1) < 100
    assert near.mean() > 0.5
    assert (face[near] == GROUND).all()
    np.testing.assert_allclose(points[near, 2], terrain.height(points[near, :2]), atol=0.05)


def test_without_embree_the_error_names_the_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr(caster, "has_embree", lambda: False)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[synth\]'.*--sensors none"):
        make_release(tmp_path / "release", SynthConfig(sensors="cameras"))
    assert list(tmp_path.iterdir()) == []


def test_labels_without_embree_are_nearly_the_same(monkeypatch, world, actor, rig_of):
    others = [actor(10 + k, "car", 9.0 * k, 1.75, np.pi) for k in range(4)]
    labels = []
    for available in (True, False):
        monkeypatch.setattr(caster, "has_embree", lambda available=available: available)
        rig = rig_of(world, others, sensors="none")
        labels.append(rig.sighting(rig.scene(0.0), rig.agents[0], 1).labels)
    fast, slow = labels
    np.testing.assert_array_equal(fast.center, slow.center)
    np.testing.assert_array_equal(fast.camera_visible, slow.camera_visible)
    np.testing.assert_allclose(fast.num_lidar_pts, slow.num_lidar_pts, atol=3)
