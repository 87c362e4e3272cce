import copy
import pickle
import re
from collections.abc import Callable
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

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
def test_values_that_are_no_numbers_are_refused(values: object) -> None:
    cases = [
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
    if values not in (["1", "2"], None, [None, 1.0]):  # NumPy reads these as numbers or NaN
        cases.append((lambda: as_floats(values), GeometryError, ("expected numbers, found",)))

    assert_raises(*cases)


@pytest.mark.parametrize("values", [[1.5, 2], [np.nan, 2], [1e30, 2], [300, 1]])
def test_integers_must_be_whole_and_in_range(values: list[float]) -> None:
    assert checked("ids", [1.0, 2.0], (2,), np.int64).tolist() == [1, 2]
    assert_raises(
        (
            lambda: checked("ids", values, (2,), np.int8),
            GeometryError,
            "ids: expected whole numbers of int8",
        )
    )


@pytest.mark.parametrize(
    ("shape", "wrong_shape", "transposed"),
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
def test_a_transposed_array_is_named_as_such(
    shape: tuple[int | None, ...], wrong_shape: tuple[int, ...], transposed: bool
) -> None:
    end = r"; transpose it \(\.T\)$" if transposed else rf"{re.escape(str(wrong_shape))}$"
    message = f"points: expected shape .*, found .*{end}"
    assert_raises((lambda: checked("points", np.zeros(wrong_shape), shape), GeometryError, message))


def test_a_cloud_instead_of_an_array_is_named_as_such() -> None:
    cloud = LidarPointCloud(np.zeros((2, 3)), np.zeros(2, dtype=np.float32))
    boxes = Boxes.from_arrays(np.zeros((1, 3)), np.ones((1, 3)), [0.0])
    message = ("points: ", "found LidarPointCloud ", "give its array, .xyz")
    calls = (
        boxes.contains,
        boxes.count_points,
        PinholeCamera.from_field_of_view(8, 6, 1.0).project,
    )

    assert_raises(*((partial(call, cloud), GeometryError, message) for call in calls))
    assert boxes.count_points(cloud.xyz).tolist() == [2]


class ForeignArray:
    """An array of another framework, which may raise an error when it is read."""

    def __init__(self, values: object, error: Exception | None = None) -> None:
        self._values = np.asarray(values)
        self._error = error

    def read(self) -> np.ndarray:
        if self._error is not None:
            raise self._error
        return self._values


class NumpyConvertibleArray(ForeignArray):
    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        return self.read()


class DlpackArray(ForeignArray):
    def __dlpack__(self, **options: object) -> object:
        return self.read().__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        return np.zeros(0).__dlpack_device__()


@pytest.mark.parametrize("kind", [NumpyConvertibleArray, DlpackArray])
def test_arrays_of_other_frameworks_are_read(kind: type[ForeignArray]) -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    foreign = kind(values)
    for array in (checked("x", foreign, (2, 3)), as_floats(foreign)):
        assert array.dtype == np.float64
        assert_array_equal(array, values)
    assert np.shares_memory(checked("x", foreign, (2, 3), np.float32), values)


@pytest.mark.parametrize("kind", [NumpyConvertibleArray, DlpackArray])
@pytest.mark.parametrize("error", [TypeError, RuntimeError, BufferError, ValueError])
def test_arrays_that_cannot_be_read_say_what_to_do(
    kind: type[ForeignArray], error: type[Exception]
) -> None:
    array = kind([1.0], error("it is on another device"))
    remedy = (
        r"another device\); pass a torch tensor as "
        r"tensor\.detach\(\)\.cpu\(\)\.float\(\), and a tensor of another framework"
    )

    assert_raises(
        (
            lambda: checked("x", array, (1,)),
            GeometryError,
            rf"x: expected an array of shape \(1\), found {kind.__name__} .*{remedy}",
        ),
        (
            lambda: as_floats(array),
            GeometryError,
            rf"^expected numbers, found {kind.__name__} .*{remedy}",
        ),
    )


def test_masked_numbers_are_refused() -> None:
    masked_array = np.ma.masked_array([1.0, 2.0, 3.0], mask=[False, True, True])
    unmasked_array = np.ma.masked_array([1.0, 2.0], mask=False)
    message = ("found 2 masked values; pass array.filled(value)",)

    assert_raises(
        (lambda: checked("x", masked_array, (3,)), GeometryError, message),
        (lambda: as_floats(masked_array), GeometryError, message),
    )
    assert type(checked("x", unmasked_array, (2,))) is np.ndarray


def test_numbers_beyond_a_float_type_are_refused() -> None:
    assert_raises(
        (
            lambda: checked("x", [1.0, np.inf, np.nan, -1e300], (4,), np.float32),
            GeometryError,
            ("x: expected numbers within float32's range, found -1e+300",),
        )
    )
    values = [1.0, np.inf, -np.inf, np.nan]
    assert_array_equal(checked("x", values, (4,), np.float32), values)


@pytest.mark.parametrize(
    "value", [2, 2.0, np.float32(2), np.int64(2), np.array(2), Fraction(2), np.uint8(2)]
)
def test_single_numbers_of_python_and_numpy(value: object) -> None:
    number = checked_number("x", value)
    assert type(number) is float
    assert number == 2.0
    if isinstance(value, int | np.integer):
        whole = checked_whole("x", value)
        assert type(whole) is int
        assert whole == 2


@pytest.mark.parametrize("value", ["2", None, [2], np.zeros(1), 2j, 10**400, 2.0])
def test_values_that_are_no_single_number_are_refused(value: object) -> None:
    if not isinstance(value, float):
        assert_raises(
            (
                lambda: checked_number("x", value, "metres", ConfigError),
                ConfigError,
                ("x: expected metres, found",),
            )
        )
    if not isinstance(value, int):
        assert_raises(
            (
                lambda: checked_whole("x", value, "frames", ConfigError),
                ConfigError,
                ("x: expected frames, found",),
            )
        )


def read_arrays(record: object) -> dict[str, np.ndarray]:
    """Return the arrays among a record's fields, by field name."""
    values = {name: getattr(record, name) for name in getattr(record, "__slots__", ())}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def make_records(da: DeepAccident) -> list[object]:
    """Make one of each record of geometry and v2x that holds arrays."""
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


@pytest.mark.parametrize("make_copy", COPIES, ids=["pickle", "deepcopy", "copy"])
def test_arrays_stay_read_only_in_every_copy(
    da: DeepAccident, make_copy: Callable[[object], object]
) -> None:
    for record in make_records(da):
        assert isinstance(record, FrozenArrays)
        copied = make_copy(record)
        arrays = read_arrays(record)
        assert type(copied) is type(record)
        assert arrays
        for name, copied_array in read_arrays(copied).items():
            assert_array_equal(copied_array, arrays[name])
            assert not arrays[name].flags.writeable, f"{type(record)}.{name}"
            assert not copied_array.flags.writeable, f"{type(record)}.{name}"

    box = make_copy(da.get_boxes(da.sample[0])[0])
    assert not box.center.flags.writeable
    assert box.token is not None
