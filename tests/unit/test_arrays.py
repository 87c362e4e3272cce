import copy
import pickle
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.arrays import FrozenArrays, as_floats, as_numbers, checked, checked_number, checked_whole
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.v2x import cooperative_view
from deepaccident_devkit.v2x.tracks import scenario_tracks


@pytest.mark.parametrize("values", ["abc", ["1", "2"], None, [None, 1.0], [[1], [1, 2]], [1j, 2], object()])
def test_what_is_no_numbers_is_refused(values: object) -> None:
    with pytest.raises(GeometryError, match=r"weights: expected an array of shape \(N\), found"):
        checked("weights", values, (None,))
    with pytest.raises(GeometryError, match=r"weights: expected numbers, found"):
        as_numbers("weights", values)
    if values not in (["1", "2"], None, [None, 1.0]):  # what numpy itself reads as numbers or NaN
        with pytest.raises(GeometryError, match="expected numbers, found"):
            as_floats(values)


def test_integers_must_be_whole_and_in_range() -> None:
    assert checked("ids", [1.0, 2.0], (2,), np.int64).tolist() == [1, 2]
    for wrong in ([1.5, 2], [np.nan, 2], [1e30, 2]):
        with pytest.raises(GeometryError, match="ids: expected whole numbers of int64"):
            checked("ids", wrong, (2,), np.int64)
    with pytest.raises(GeometryError, match="codes: expected whole numbers of int8"):
        checked("codes", [300], (1,), np.int8)


def test_an_array_of_the_right_type_is_not_copied() -> None:
    given = np.zeros((2, 3))
    assert checked("points", given, (None, 3)) is given


def test_single_numbers_of_python_and_numpy() -> None:
    for value in (2, 2.0, np.float32(2), np.int64(2), np.array(2), Fraction(2), np.uint8(2)):
        number = checked_number("x", value)
        assert (type(number), number) == (float, 2.0)
    for value in (2, np.int64(2), np.uint8(2)):
        whole = checked_whole("x", value)
        assert (type(whole), whole) == (int, 2)
    for wrong in ("2", None, [2], np.zeros(1), 2j):
        with pytest.raises(ConfigError, match="x: expected metres, found"):
            checked_number("x", wrong, "metres", ConfigError)
    for wrong in (2.0, "2", None, [2]):
        with pytest.raises(ConfigError, match="x: expected frames, found"):
            checked_whole("x", wrong, "frames", ConfigError)


def arrays_of(record: object) -> dict[str, np.ndarray]:
    names = getattr(record, "__slots__", ())
    values = {name: getattr(record, name) for name in names}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def records(da: DeepAccident) -> list[object]:
    """One of each record of geometry and v2x that holds arrays."""
    sample = f"{da.scenario[0]['token']}/ego_vehicle/003"
    accident = next(scenario for scenario in da.scenario if scenario["collision"])
    boxes = da.boxes(sample)
    return [
        SE3.from_yaw(0.3, (1, 2, 3)),
        da.transform(sample, sample, "world"),
        da.world_from(sample, "ego").inverse(),
        boxes,
        Boxes.from_arrays([[1, 2, 3]], [[4, 2, 1.5]], [0.1]),
        LidarPointCloud(np.ones((4, 3)), np.ones(4)),
        PinholeCamera.from_field_of_view(100, 50, 1.2),
        da.project_to_image(np.ones((2, 3)), sample, f"{sample}/Camera_Front"),
        da.trajectory(da.instance[0]),
        scenario_tracks(da, da.scenario[0]),
        cooperative_view(da, sample),
        da.collision(accident),
    ]


COPIES = [lambda record: pickle.loads(pickle.dumps(record)), copy.deepcopy, copy.copy]


@pytest.mark.parametrize("copied", COPIES, ids=["pickle", "deepcopy", "copy"])
def test_arrays_stay_read_only_in_every_copy(da: DeepAccident, copied: Callable[[object], object]) -> None:
    for record in records(da):
        assert isinstance(record, FrozenArrays)
        twin, have = copied(record), arrays_of(record)
        assert type(twin) is type(record)
        assert have
        for name, array in arrays_of(twin).items():
            assert_array_equal(array, have[name])
            assert not have[name].flags.writeable
            assert not array.flags.writeable, f"{type(record).__name__}.{name}"
    box = copied(da.get_boxes(da.sample[0])[0])
    assert not box.center.flags.writeable
    assert box.token is not None
