"""Array aliases, and checks of the arrays and numbers that a caller passes."""

import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from numbers import Real
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from deepaccident_devkit.errors import ConfigError, DeepAccidentError, GeometryError
from deepaccident_devkit.support.values import ReadOnlyValues

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
AnyArray = NDArray[Any]
NO_INDICES: Final = np.zeros(0, dtype=np.int64)
"""No rows, cells or ids: the start of a list of arrays to join, which may stay empty."""
_FLOAT64 = np.dtype(np.float64)
# Types of a single True or False.
_BOOL_KINDS = (bool, np.bool_)
# Kinds of the element types of numbers.
_NUMBER_KINDS = "biuf"
# Largest plausible number of metres, m/s, pixels, …: a larger one in a file is a fault and counts
# as infinite, because its square could overflow.
LARGEST_NUMBER: Final = 1e9
# Largest block that the allocator can keep, bytes.
_MAX_KEPT_SIZE = 31 * 2**20
# Limits of a record's repr: characters of all fields and of one field, and entries of a collection.
_MAX_FIELDS_LENGTH = 160
_MAX_VALUE_LENGTH = 80
_MAX_ENTRIES = 4


def keep_freed(size: int = _MAX_KEPT_SIZE) -> None:
    """Make Linux's allocator keep freed blocks of up to `size` bytes, at most 31 MiB.

    Otherwise memory is returned to the system every time, and page faults take a large part of the
    time. The allocator raises its threshold when it frees a block of that size, whose memory is
    never touched.
    """
    kept_size = min(size, _MAX_KEPT_SIZE)
    np.empty(kept_size, dtype=np.uint8)


class ShortRepr:
    """Base of dataclasses with arrays, whose repr is one line of fewer than 200 characters.

    The repr shows the shapes of arrays, not their numbers. A subclass may define its own
    `__repr__`.
    """

    __slots__ = ()

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        inherited = cls.__repr__
        # A dataclass replaces a `__repr__` that is not the class's own.
        cls.__repr__ = inherited  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return the class name and as many fields as fit."""
        kind: type[Any] = type(self)
        text = ""
        separator = ""
        for name in _list_field_names(kind):
            value_text = _format_value(getattr(self, name))
            field_text = f"{separator}{name}={value_text}"
            if len(text) + len(field_text) > _MAX_FIELDS_LENGTH:
                text += ", …"
                break
            text += field_text
            separator = ", "
        return f"{kind.__name__}({text})"


class FrozenArrays(ShortRepr):
    """Base of frozen dataclasses whose arrays are read-only, in every copy as well.

    Without it, arrays would become writable by pickling or `copy.deepcopy`.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the arrays; a subclass that checks its arrays also freezes them."""
        freeze_arrays(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy without calling `__init__`, because the values were already checked."""
        kind = type(self)
        values = {name: getattr(self, name) for name in _list_field_names(kind)}
        return _restore_arrays, (kind, values)


class BitView(Sequence[bool]):
    """A bool column as Arrow packs it, eight rows per byte; rows are unpacked on access."""

    def __init__(self, packed: ByteArray, length: int) -> None:
        """View `length` bits, the lowest bit of each byte first."""
        self._packed = packed
        self._length = length

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[bool]:
        return iter(self[:].tolist())

    def __getitem__(self, rows: Any) -> Any:
        """Return one row as a bool, or a slice (step 1) or an array of rows as a bool array."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(self._length)
            return self._unpack(start, max(start, stop))
        if isinstance(rows, np.ndarray):
            packed_bytes = self._packed[rows >> 3]
            bits = packed_bytes >> (rows & 7).astype(np.uint8) & 1
            return bits.view(np.bool_)
        packed_byte = self._packed.item(rows >> 3)
        return bool(packed_byte >> (rows & 7) & 1)

    def _unpack(self, start: int, stop: int) -> BoolArray:
        """Return the rows `start` to `stop` − 1 as a bool array."""
        packed_bytes = self._packed[start >> 3 : (stop + 7) >> 3]
        bits = np.unpackbits(packed_bytes, bitorder="little")
        offset = start & 7
        return bits[offset : offset + stop - start].view(np.bool_)


def checked(
    name: str, values: ArrayLike, shape: Sequence[int | None], dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """Return `values` as an array of `dtype` and `shape` (None: any length); raise GeometryError.

    If `dtype` is None, the values keep their type. An array of the right type is not copied. For an
    integer type, the numbers must be whole and in range.
    """
    if (
        type(values) is np.ndarray
        and values.dtype.kind in _NUMBER_KINDS
        and _has_shape(values.shape, shape)
    ):
        # Fast path for the many small arrays of a sample's labels.
        if values.dtype == dtype:
            return values
        return as_numbers(name, values, dtype=dtype)
    array = as_numbers(name, values, f"an array of shape {_format_shape(shape)}", dtype)
    if not _has_shape(array.shape, shape):
        is_transposed = array.ndim == 2 and _has_shape(array.shape[::-1], shape)
        remedy = "; transpose it (.T)" if is_transposed else ""
        raise GeometryError(
            f"{name}: expected shape {_format_shape(shape)}, found {array.shape}{remedy}"
        )
    return array


def as_numbers(
    name: str, values: ArrayLike, expected: str = "numbers", dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """Convert a caller's numbers to an array of any shape; all arrays of callers pass here.

    Anything that numpy can read without a copy from another device is accepted: numpy arrays,
    sequences, and objects with `__array__` or DLPack, such as torch tensors on the CPU. Nothing is
    silently detached, fetched from an accelerator or unmasked; the GeometryError explains how to
    convert it. Numbers must fit into the range of a float type (NaN and inf are accepted),
    otherwise GeometryError is raised too.
    """
    source = _to_array(name, values, expected)
    target = source.dtype if dtype is None else np.dtype(dtype)
    if source.dtype.kind not in _NUMBER_KINDS:
        raise GeometryError(
            f"{name}: expected {expected}, found {type(values).__name__} (not numeric: "
            f"{source.dtype}){_suggest_conversion(values)}"
        )
    if source.dtype == target:
        return source
    if np.can_cast(source.dtype, target, "safe"):
        return source.astype(target)
    with np.errstate(invalid="ignore", over="ignore"):
        array = source.astype(target)
    if target.kind in "iu":
        if not np.array_equal(array, source):
            changed_number = source[array != source].flat[0]
            raise GeometryError(
                f"{name}: expected whole numbers of {target}, found {changed_number}"
            )
    elif (
        target.kind == "f"
        and target.itemsize < source.dtype.itemsize
        and not np.isfinite(array).all()
    ):
        has_overflowed = np.isinf(array) & np.isfinite(source)
        if has_overflowed.any():
            raise GeometryError(
                f"{name}: expected numbers within {target}'s range, "
                f"found {source[has_overflowed][0]}"
            )
    return array


def checked_number(
    name: str,
    value: object,
    expected: str = "a number",
    error: type[DeepAccidentError] = GeometryError,
) -> float:
    """Return `value` as a float; raise `error`, naming it, unless it is one (numpy) number."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    try:
        if isinstance(value, Real):
            return float(value)
    except OverflowError:  # an integer of hundreds of digits
        pass
    raise error(f"{name}: expected {expected}, found {value!r}")


def checked_whole(
    name: str,
    value: object,
    expected: str = "a whole number",
    error: type[DeepAccidentError] = GeometryError,
) -> int:
    """Return `value` as an int; raise `error` with its name unless it is a (numpy) integer."""
    try:
        return operator.index(value)  # type: ignore[arg-type]  # everything else is refused
    except TypeError:
        raise error(f"{name}: expected {expected}, found {value!r}") from None


def checked_flag(name: str, value: object) -> bool:
    """Return `value` if it is a bool; otherwise raise a ConfigError that names it."""
    if not isinstance(value, _BOOL_KINDS):
        raise ConfigError(f"{name}: expected True or False, found {value!r}")
    return bool(value)


def checked_count(name: str, value: object, subject: str, maximum: int) -> int:
    """Return `value` if it is an integer from 1 to `maximum`; otherwise raise ConfigError."""
    expected = f"a whole number from 1 to {maximum:,} ({subject})"
    count = 0  # a bool keeps this count, which is out of range
    if not isinstance(value, _BOOL_KINDS):
        count = checked_whole(name, value, expected, ConfigError)
    if not 1 <= count <= maximum:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return count


def checked_setting(
    name: str, value: object, expected: str, minimum: float = -math.inf, maximum: float = math.inf
) -> float:
    """Return `value` as a float; raise ConfigError unless `minimum` ≤ value ≤ `maximum`."""
    number = math.nan  # a bool keeps this number, which is not allowed
    if not isinstance(value, _BOOL_KINDS):
        number = checked_number(name, value, expected, ConfigError)
    if not (math.isfinite(number) and minimum <= number <= maximum):
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return number


def check_minima(record: object, **minima: float) -> None:
    """Raise ConfigError if a field of a configuration is below its minimum, or NaN."""
    for name, minimum in minima.items():
        value = getattr(record, name)
        if not value >= minimum:
            raise ConfigError(f"{name}: expected a number from {minimum}, found {value!r}")


def as_floats(values: ArrayLike) -> FloatArray:
    """Convert `values` to float64, without copying float64; raise GeometryError if not real."""
    array = _to_array("", values, "numbers")
    if array.dtype == _FLOAT64:
        return array
    try:
        if array.dtype.kind == "c":
            raise TypeError(f"not real numbers: {array.dtype}")
        return array.astype(_FLOAT64)
    except (TypeError, ValueError) as error:
        raise GeometryError(f"expected numbers, found {type(values).__name__} ({error})") from error


def concatenate_ranges(starts: IntArray, counts: IntArray) -> IntArray:
    """Concatenate N ranges of consecutive numbers, given by `starts` (N,) and `counts` (N,)."""
    num_before = np.cumsum(counts) - counts
    offsets = np.repeat(starts.astype(np.int64) - num_before, counts)
    return offsets + np.arange(counts.sum())


def in_range(numbers: AnyArray | float) -> BoolArray:
    """Return which numbers are neither NaN, nor infinite, nor larger than `LARGEST_NUMBER`."""
    is_small: BoolArray = np.abs(numbers) <= np.float64(LARGEST_NUMBER)  # half precision has no 1e9
    return is_small


def json_numbers(values: ArrayLike | None, digits: int | None = None) -> Any:
    """Convert numbers to JSON: nested lists of rounded numbers, None if not finite."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim:
        return [json_numbers(row, digits) for row in array]
    number = array.item() if np.isfinite(array) else None
    if number is None or digits is None:
        return number
    return round(number, digits)


def readonly(array: AnyArray) -> AnyArray:
    """Return a read-only view of `array`; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def freeze_arrays(record: ShortRepr) -> None:
    """Make the arrays of a new frozen dataclass read-only."""
    for name in _list_field_names(type(record)):
        value = getattr(record, name)
        if isinstance(value, np.ndarray):
            object.__setattr__(record, name, readonly(value))


def _to_array(name: str, values: Any, expected: str) -> AnyArray:
    """Convert `values` to an array of any type; raise GeometryError if masked or unreadable."""
    if type(values) is np.ndarray:
        return values
    prefix = f"{name}: " if name else ""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise GeometryError(
            f"{prefix}expected {expected}, found {np.count_nonzero(values.mask)} masked values; "
            "pass array.filled(value) with a value for them"
        )
    try:
        if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
            return np.from_dlpack(values)
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise GeometryError(
            f"{prefix}expected {expected}, found {type(values).__name__} ({error})"
            f"{_suggest_conversion(values)}"
        ) from error


def _has_shape(actual: Sequence[int], shape: Sequence[int | None]) -> bool:
    if len(actual) != len(shape):
        return False
    lengths = zip(shape, actual, strict=True)
    return all(expected is None or expected == length for expected, length in lengths)


def _suggest_conversion(values: object) -> str:
    """Return the remedy for a point cloud, or for another framework's array, as a text.

    It is empty for all other values.
    """
    if hasattr(values, "xyz"):
        return "; give its array, .xyz"
    if hasattr(values, "corners"):  # boxes, whose own error has the remedy
        return ""
    if isinstance(values, np.ndarray) or not (
        hasattr(values, "__array__") or hasattr(values, "__dlpack__")
    ):
        return ""
    return (
        "; pass a torch tensor as tensor.detach().cpu().float(), and a tensor of another "
        "framework as a float32 numpy array"
    )


def _restore_arrays(kind: type[FrozenArrays], values: ReadOnlyValues) -> FrozenArrays:
    """Make the copy that `FrozenArrays.__reduce__` describes."""
    result = object.__new__(kind)
    for name, value in values.items():
        frozen = readonly(value) if isinstance(value, np.ndarray) else value
        object.__setattr__(result, name, frozen)
    return result


def _format_value(value: object) -> str:
    """Describe a value briefly: an array by shape and type, a long collection by its length."""
    if isinstance(value, np.ndarray):
        return f"{value.shape} {value.dtype}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping | list | tuple) and (
        len(value) > _MAX_ENTRIES or _holds_arrays(value)
    ):
        kind = "dict" if isinstance(value, Mapping) else type(value).__name__
        return f"<{len(value)} in a {kind}>"
    text = repr(value)
    if len(text) <= _MAX_VALUE_LENGTH:
        return text
    return f"{type(value).__name__}(…)"


def _holds_arrays(collection: Mapping[Any, Any] | Sequence[Any]) -> bool:
    """Return whether a collection contains arrays or other collections."""
    values = collection.values() if isinstance(collection, Mapping) else collection
    kinds = (np.ndarray, Mapping, list, tuple)
    return any(isinstance(value, kinds) for value in values)


def _list_field_names(kind: type[Any]) -> Iterable[str]:
    return [field.name for field in fields(kind)]


def _format_shape(shape: Sequence[int | None]) -> str:
    lengths = ["N" if length is None else str(length) for length in shape]
    return f"({', '.join(lengths)})"
