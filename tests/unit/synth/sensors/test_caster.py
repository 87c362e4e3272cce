import numpy as np
import pytest

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.sensors.caster import GROUND, NOTHING, Caster


def test_nearest_face_is_met():
    corners = Boxes.from_arrays([[5, 0, 0], [10, 0, 0]], [[2, 2, 2]] * 2, [0, 0]).corners()
    distance, face = Caster(corners).cast(np.zeros(3), np.array([[1.0, 0, 0], [-1, 0, 0], [0.5, 0, 0]]))
    np.testing.assert_allclose(distance, [4, np.inf, 8])
    assert face.tolist() == [1, NOTHING, 1]


@pytest.mark.parametrize("grounded", [False, True])
def test_rays_end_at_their_reach(world, grounded):
    corners = Boxes.from_arrays([[5, 0, 1]], [[2, 2, 2]], [0]).corners()
    directions = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -1.0], [0, 0, -1.0]])
    reach = np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32)
    distance, face = Caster(corners, world.terrain if grounded else None).cast(
        np.array([0.0, 0.0, 1.0]), directions, reach
    )
    np.testing.assert_allclose(distance, [np.inf, 4, np.inf, 1 if grounded else np.inf])
    assert face.tolist() == [NOTHING, 1, NOTHING, GROUND if grounded else NOTHING]
    np.testing.assert_array_equal(reach, np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32))


@pytest.mark.parametrize("kind", ["world", "hilly_world"])
def test_rays_end_on_the_ground(rng, request, kind):
    terrain = request.getfixturevalue(kind).terrain
    directions = rng.normal(size=(3000, 3))
    directions[:, 2] = -0.2 * np.abs(directions[:, 2]) - 0.02
    origin = np.array([-20.0, 0.0, 3.0])
    distance, face = Caster(np.zeros((0, 8, 3)), terrain).cast(origin, directions)
    points = origin + distance[:, None] * directions
    near = np.abs(points[:, :2]).max(axis=1) < 100
    assert near.mean() > 0.5
    assert (face[near] == GROUND).all()
    np.testing.assert_allclose(points[near, 2], terrain.height(points[near, :2]), atol=0.05)


def test_without_embree_the_error_names_the_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[synth\]'"):
        make_release(tmp_path / "release", SynthConfig(sensors="none"))
    assert list(tmp_path.iterdir()) == []
