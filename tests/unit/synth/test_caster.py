import numpy as np
import pytest

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.synth import SynthConfig, caster, make_release
from deepaccident_devkit.synth.caster import NOTHING, EmbreeCaster, NumpyCaster
from deepaccident_devkit.synth.solids import face_corners, face_planes


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


def test_normals_point_outwards(corners):
    normals, offsets = face_planes(face_corners(corners))
    middle = np.repeat(corners.mean(axis=1), 6, axis=0)
    assert (np.einsum("fk,fk->f", normals, middle) < offsets).all()


def test_sensors_without_embree_name_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(caster, "has_embree", lambda: False)
    with pytest.raises(MissingExtraError, match=r"pip install 'deepaccident_devkit\[synth\]'.*--no-sensors"):
        make_release(tmp_path / "out", SynthConfig(scenarios=1, frames=1))
    assert list(tmp_path.iterdir()) == []


def test_labels_without_embree_are_nearly_the_same(tmp_path, monkeypatch, digests):
    small = SynthConfig(scenarios=1, frames=1, sensors=False)
    fast = digests(make_release(tmp_path / "embree", small, workers=1))
    monkeypatch.setattr(caster, "has_embree", lambda: False)
    slow = digests(make_release(tmp_path / "numpy", small, workers=1))
    assert list(fast) == list(slow)
    labels = [name for name in fast if "/label/" in name]
    rows = [
        (a.split(), b.split())
        for name in labels
        for a, b in zip(fast[name].splitlines(), slow[name].splitlines(), strict=True)
    ]
    assert all(a[:11] == b[:11] for a, b in rows)
    assert np.mean([a == b for a, b in rows]) > 0.9
