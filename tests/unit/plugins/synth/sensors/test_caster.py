import numpy as np
import pytest
from refusals import assert_refused

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
    directions = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -1.0], [0, 0, -1.0]])
    reach = np.array([3.9, 4.1, 0.9, 1.1], dtype=np.float32)
    given, cast = reach.copy(), kind(corners, world.terrain if grounded else None).cast
    distance, face = cast(np.array([0.0, 0.0, 1.0]), directions, reach)
    np.testing.assert_allclose(distance, [np.inf, 4, np.inf, 1 if grounded else np.inf])
    assert face.tolist() == [NO_HIT, 1, NO_HIT, GROUND if grounded else NO_HIT]
    np.testing.assert_array_equal(reach, given)


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
    assert (near.mean() > 0.5, set(face[near].tolist())) == (True, {GROUND})
    np.testing.assert_allclose(points[near, 2], terrain.height(points[near, :2]), atol=0.05)


def test_without_embree_the_error_names_the_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr(caster, "has_embree", lambda: False)
    config, told = SynthConfig(sensors="cameras"), ("pip install '.[synth]'", "--sensors none")
    assert_refused((lambda: make_release(tmp_path / "release", config), MissingExtraError, told))
    assert list(tmp_path.iterdir()) == []


def test_labels_without_embree_are_nearly_the_same(monkeypatch, world, actor, rig_of):
    others = [actor(10 + k, "car", 9.0 * k, 1.75, np.pi) for k in range(4)]

    def labels(available):
        monkeypatch.setattr(caster, "has_embree", lambda: available)
        rig = rig_of(world, others, sensors="none")
        return rig.sighting(rig.scene(0.0), rig.agents[0], 1).labels

    fast, slow = labels(True), labels(False)
    for name, atol in (("center", 0), ("camera_visible", 0), ("num_lidar_pts", 3)):
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), rtol=0, atol=atol)
