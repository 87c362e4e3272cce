import copy
import pickle
import re
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.support.arrays import (
    FrozenArrays,
    as_floats,
    as_numbers,
    checked,
    checked_number,
    checked_whole,
)
from deepaccident_devkit.v2x import cooperative_view
from deepaccident_devkit.v2x.tracks import scenario_tracks


@pytest.mark.parametrize(
    "values", ["abc", ["1", "2"], None, [None, 1.0], [[1], [1, 2]], [1j, 2], object()]
)
def test_what_is_no_numbers_is_refused(values: object) -> None:
    refused = [
        (
            lambda: checked("weights", values, (None,)),
            GeometryError,
            ("weights: expected an array of shape (N), fo",),
        ),
        (
            lambda: as_numbers("weights", values),
            GeometryError,
            ("weights: expected numbers, found",),
        ),
    ]
    if values not in (["1", "2"], None, [None, 1.0]):  # what numpy itself reads as numbers or NaN
        refused.append((lambda: as_floats(values), GeometryError, ("expected numbers, found",)))
    assert_refused(*refused)


@pytest.mark.parametrize("wrong", [[1.5, 2], [np.nan, 2], [1e30, 2], [300, 1]])
def test_integers_must_be_whole_and_in_range(wrong: list[float]) -> None:
    assert checked("ids", [1.0, 2.0], (2,), np.int64).tolist() == [1, 2]
    assert_refused(
        (
            lambda: checked("ids", wrong, (2,), np.int8),
            GeometryError,
            "ids: expected whole numbers of int8",
        )
    )


@pytest.mark.parametrize(
    ("shape", "found", "transposed"),
    [
        ((None, 3), (3, 8), True),
        ((5, 3), (3, 5), True),
        ((None, 2), (2, 7), True),
        ((None, 3), (4, 8), False),
        ((None, 3), (3,), False),
        ((None, 3), (3, 8, 1), False),
        ((4, 4), (3, 3), False),
    ],
)
def test_a_transposed_array_is_named_so(
    shape: tuple[int | None, ...], found: tuple[int, ...], transposed: bool
) -> None:
    end = r"; transpose it \(\.T\)$" if transposed else rf"{re.escape(str(found))}$"
    told = f"points: expected shape .*, found .*{end}"
    assert_refused((lambda: checked("points", np.zeros(found), shape), GeometryError, told))


def test_a_cloud_in_place_of_an_array_is_named_so() -> None:
    cloud = LidarPointCloud(np.zeros((2, 3)), np.zeros(2, dtype=np.float32))
    boxes = Boxes.from_arrays(np.zeros((1, 3)), np.ones((1, 3)), [0.0])
    told = ("points: ", "found LidarPointCloud ", "give its array, .xyz")
    calls = (
        boxes.contains,
        boxes.count_points,
        PinholeCamera.from_field_of_view(8, 6, 1.0).project,
    )
    assert_refused(*((lambda call=call: call(cloud), GeometryError, told) for call in calls))
    assert boxes.count_points(cloud.xyz).tolist() == [2]


class Foreign:
    """An array of another framework; or the error with which it answers who asks for its values."""

    def __init__(self, values: object, error: Exception | None = None) -> None:
        self._values, self._error = np.asarray(values), error

    def read(self) -> np.ndarray:
        if self._error is not None:
            raise self._error
        return self._values


class WithArray(Foreign):
    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        return self.read()


class OnlyDlpack(Foreign):
    def __dlpack__(self, **options: object) -> object:
        return self.read().__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        return np.zeros(0).__dlpack_device__()


@pytest.mark.parametrize("kind", [WithArray, OnlyDlpack])
def test_arrays_of_other_frameworks_are_read(kind: type[Foreign]) -> None:
    given = np.arange(6, dtype=np.float32).reshape(2, 3)
    for read in (checked("x", kind(given), (2, 3)), as_floats(kind(given))):
        assert read.dtype == np.float64
        assert_array_equal(read, given)
    assert np.shares_memory(checked("x", kind(given), (2, 3), np.float32), given)


@pytest.mark.parametrize("kind", [WithArray, OnlyDlpack])
@pytest.mark.parametrize("error", [TypeError, RuntimeError, BufferError, ValueError])
def test_arrays_that_cannot_be_read_say_what_to_do(
    kind: type[Foreign], error: type[Exception]
) -> None:
    given = kind([1.0], error("it is on another device"))
    remedy = (
        r"another device\); pass a torch tensor as "
        r"tensor\.detach\(\)\.cpu\(\)\.float\(\), another framework's"
    )
    assert_refused(
        (
            lambda: checked("x", given, (1,)),
            GeometryError,
            rf"x: expected an array of shape \(1\), found {kind.__name__} .*{remedy}",
        ),
        (
            lambda: as_floats(given),
            GeometryError,
            rf"^expected numbers, found {kind.__name__} .*{remedy}",
        ),
    )


def test_masked_numbers_are_nobodys_to_unmask() -> None:
    hidden = np.ma.masked_array([1.0, 2.0, 3.0], mask=[False, True, True])
    told = ("found 2 masked values; pass array.filled(value)",)
    assert_refused(
        (lambda: checked("x", hidden, (3,)), GeometryError, told),
        (lambda: as_floats(hidden), GeometryError, told),
    )
    assert type(checked("x", np.ma.masked_array([1.0, 2.0], mask=False), (2,))) is np.ndarray


def test_numbers_beyond_a_float_type_are_refused() -> None:
    told = ("x: expected numbers within float32's range, found -1e+300",)
    assert_refused(
        (lambda: checked("x", [1.0, np.inf, np.nan, -1e300], (4,), np.float32), GeometryError, told)
    )
    kept = [1.0, np.inf, -np.inf, np.nan]
    assert_array_equal(checked("x", kept, (4,), np.float32), kept)


@pytest.mark.parametrize(
    "value", [2, 2.0, np.float32(2), np.int64(2), np.array(2), Fraction(2), np.uint8(2)]
)
def test_single_numbers_of_python_and_numpy(value: object) -> None:
    number = checked_number("x", value)
    assert (type(number), number) == (float, 2.0)
    if isinstance(value, int | np.integer):
        whole = checked_whole("x", value)
        assert (type(whole), whole) == (int, 2)


@pytest.mark.parametrize("wrong", ["2", None, [2], np.zeros(1), 2j, 10**400, 2.0])
def test_what_is_no_single_number(wrong: object) -> None:
    number, whole = (("x: expected metres, found",), ("x: expected frames, found",))
    if not isinstance(wrong, float):
        assert_refused(
            (lambda: checked_number("x", wrong, "metres", ConfigError), ConfigError, number)
        )
    if not isinstance(wrong, int):
        assert_refused(
            (lambda: checked_whole("x", wrong, "frames", ConfigError), ConfigError, whole)
        )


def arrays_of(record: object) -> dict[str, np.ndarray]:
    values = {name: getattr(record, name) for name in getattr(record, "__slots__", ())}
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
def test_arrays_stay_read_only_in_every_copy(
    da: DeepAccident, copied: Callable[[object], object]
) -> None:
    for record in records(da):
        assert isinstance(record, FrozenArrays)
        twin, have = copied(record), arrays_of(record)
        assert type(twin) is type(record)
        assert have
        for name, array in arrays_of(twin).items():
            assert_array_equal(array, have[name])
            assert (have[name].flags.writeable, array.flags.writeable) == (False, False), (
                f"{type(record)}.{name}"
            )
    box = copied(da.get_boxes(da.sample[0])[0])
    assert (box.center.flags.writeable, box.token is not None) == (False, True)
