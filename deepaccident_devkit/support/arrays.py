"""Array aliases, and checks of the arrays and numbers that a caller passes."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from numbers import Real
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from deepaccident_devkit.errors import ConfigError, DeepAccidentError, GeometryError

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
AnyArray = NDArray[Any]
_FLOAT64: Final = np.dtype(np.float64)
# Kinds of the element types of numbers.
_NUMBER_KINDS: Final = "biuf"
# Largest number of metres, m/s, pixels, …: a larger one in a file is damage and counts as infinite,
# since squares would overflow.
LARGEST_NUMBER: Final = 1e9
# Limits of the text of a record: characters of all fields and of one, and entries of a collection.
_MAX_FIELDS_LENGTH: Final = 160
_MAX_VALUE_LENGTH: Final = 80
_MAX_ENTRIES: Final = 4


def keep_freed(size: int = 31 * 2**20) -> None:
    """Make the allocator (of Linux) keep freed blocks of up to `size` bytes, 31 MiB at most.

    Otherwise memory is returned to the system each time, and page faults take as long as much of
    the work. The allocator does so after it has once freed a block as large, which is never
    touched.
    """
    np.empty(min(size, 31 * 2**20), dtype=np.uint8)


class ShortRepr:
    """Base of dataclasses that hold arrays, with a text of one line.

    It has fewer than 200 characters, with the shapes of arrays; the text of an ordinary dataclass
    would have the arrays' numbers. A subclass may have a `__repr__` of its own.
    """

    __slots__ = ()

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        inherited = cls.__repr__
        # A dataclass replaces a `__repr__` that is not the class's own.
        cls.__repr__ = inherited  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return the class and its fields, as far as they fit."""
        kind: type[Any] = type(self)
        text = ""
        for number, name in enumerate(_field_names(kind)):
            part = f"{', ' * (number > 0)}{name}={_value_text(getattr(self, name))}"
            if len(text) + len(part) > _MAX_FIELDS_LENGTH:
                text += ", …"
                break
            text += part
        return f"{kind.__name__}({text})"


class FrozenArrays(ShortRepr):
    """Base of frozen dataclasses with arrays that are read-only, from the start and in every copy.

    numpy forgets on pickling and on `copy.deepcopy` that an array was read-only.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the arrays; a class that checks its arrays freezes them itself."""
        kind: type[Any] = type(self)
        for field in fields(kind):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, field.name, readonly(value))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a copy's constructor, which skips `__init__` since the values were checked."""
        kind = type(self)
        values = {name: getattr(self, name) for name in _field_names(kind)}
        return _restore_arrays, (kind, values)


class BitView(Sequence[bool]):
    """A bool column as Arrow packs it, eight rows a byte; rows are unpacked on access."""

    def __init__(self, packed: ByteArray, length: int) -> None:
        """View `length` bits, lowest first."""
        self._packed, self._length = packed, length

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[bool]:
        return iter(self[:].tolist())

    def __getitem__(self, rows: Any) -> Any:
        """Return one row as bool, or a bool array of a slice (step 1) or of an array of rows."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(self._length)
            return self._unpack(start, max(start, stop))
        if isinstance(rows, np.ndarray):
            return (self._packed[rows >> 3] >> (rows & 7).astype(np.uint8) & 1).view(np.bool_)
        return bool(self._packed.item(rows >> 3) >> (rows & 7) & 1)

    def _unpack(self, start: int, stop: int) -> BoolArray:
        window = self._packed[start >> 3 : (stop + 7) >> 3]
        offset = start & 7
        return np.unpackbits(window, bitorder="little")[offset : offset + stop - start].view(
            np.bool_
        )


def checked(
    name: str, values: ArrayLike, shape: Sequence[int | None], dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """Return `values` as an array of `dtype` and `shape` (None: any length); raise GeometryError.

    With dtype None they keep their own; an array that has it already is not copied. For integers,
    numbers must be whole and in range.
    """
    if (
        type(values) is np.ndarray
        and values.dtype.kind in _NUMBER_KINDS
        and _has_shape(values.shape, shape)
    ):
        # The fast path: many small arrays of a sample's labels come here.
        if values.dtype == dtype:
            return values
        return as_numbers(name, values, dtype=dtype)
    array = as_numbers(name, values, f"an array of shape {_shape_text(shape)}", dtype)
    if not _has_shape(array.shape, shape):
        is_transposed = array.ndim == 2 and _has_shape(array.shape[::-1], shape)
        remedy = "; transpose it (.T)" if is_transposed else ""
        raise GeometryError(
            f"{name}: expected shape {_shape_text(shape)}, found {array.shape}{remedy}"
        )
    return array


def as_numbers(
    name: str, values: ArrayLike, expected: str = "numbers", dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """Return what `checked` returns, for any shape: the one way in for a caller's arrays.

    Everything is accepted that numpy can read without a copy from another device: its own arrays,
    sequences, and objects with `__array__` or DLPack, such as torch tensors on the processor.
    Nothing is detached, fetched from an accelerator or unmasked silently; the error explains how.
    Numbers must be in the range of a float type too (NaN and inf pass).
    """
    source = _to_array(name, values, expected)
    target = source.dtype if dtype is None else np.dtype(dtype)
    if source.dtype.kind not in _NUMBER_KINDS:
        raise GeometryError(
            f"{name}: expected {expected}, found {type(values).__name__} (no numbers: "
            f"{source.dtype}){_remedy(values)}"
        )
    if source.dtype == target:
        return source
    if np.can_cast(source.dtype, target, "safe"):
        return source.astype(target)
    with np.errstate(invalid="ignore", over="ignore"):
        array = source.astype(target)
    if target.kind in "iu":
        if not np.array_equal(array, source):
            other = source[array != source].flat[0]
            raise GeometryError(f"{name}: expected whole numbers of {target}, found {other}")
    elif (
        target.kind == "f"
        and target.itemsize < source.dtype.itemsize
        and not np.isfinite(array).all()
    ):
        overflowed = np.isinf(array) & np.isfinite(source)
        if overflowed.any():
            raise GeometryError(
                f"{name}: expected numbers within {target}'s range, found {source[overflowed][0]}"
            )
    return array


def checked_number(
    name: str,
    value: object,
    expected: str = "a number",
    error: type[DeepAccidentError] = GeometryError,
) -> float:
    """Return a single number, also one of numpy's scalars, as Python's float; or raise `error`."""
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
    """Return a single whole number, also an integer of numpy, as Python's int; or raise `error`."""
    try:
        return operator.index(value)  # type: ignore[arg-type]  # everything else is refused
    except TypeError:
        raise error(f"{name}: expected {expected}, found {value!r}") from None


def checked_flag(name: str, value: object) -> bool:
    """Return True or False; raise ConfigError."""
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{name}: expected True or False, found {value!r}")
    return bool(value)


def checked_count(name: str, value: object, subject: str, maximum: int) -> int:
    """Return a whole number from 1 to `maximum`, or raise ConfigError, which names the subject."""
    expected = f"a whole number from 1 to {maximum:,} ({subject})"
    count = 0
    if not isinstance(value, bool | np.bool_):
        count = checked_whole(name, value, expected, ConfigError)
    if not 1 <= count <= maximum:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return count


def checked_setting(
    name: str, value: object, expected: str, minimum: float = -math.inf, maximum: float = math.inf
) -> float:
    """Return a finite number from `minimum` to `maximum`, or raise ConfigError."""
    number = math.nan
    if not isinstance(value, bool | np.bool_):
        number = checked_number(name, value, expected, ConfigError)
    if not (math.isfinite(number) and minimum <= number <= maximum):
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return number


def check_least(record: object, **minima: float) -> None:
    """Raise ConfigError if a field of a configuration is below its minimum, or NaN."""
    for name, minimum in minima.items():
        value = getattr(record, name)
        if not value >= minimum:
            raise ConfigError(f"{name}: expected a number from {minimum}, found {value!r}")


def as_floats(values: ArrayLike) -> FloatArray:
    """Return `values` as float64, without copying arrays of float64; raise GeometryError."""
    array = _to_array("", values, "numbers")
    if array.dtype == _FLOAT64:
        return array
    try:
        if array.dtype.kind == "c":
            raise TypeError(f"no real numbers: {array.dtype}")
        return array.astype(_FLOAT64)
    except (TypeError, ValueError) as error:
        raise GeometryError(f"expected numbers, found {type(values).__name__} ({error})") from error


def in_range(numbers: AnyArray | float) -> BoolArray:
    """Return which numbers are neither NaN, infinite, nor larger than any valid file contains."""
    is_small: BoolArray = np.abs(numbers) <= np.float64(LARGEST_NUMBER)  # half precision has no 1e9
    return is_small


def known(values: ArrayLike | None, digits: int | None = None) -> Any:
    """Return numbers for JSON, in lists as deep as the array, rounded; None if not finite."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim:
        return [known(row, digits) for row in array]
    number = array.item() if np.isfinite(array) else None
    if number is None or digits is None:
        return number
    return round(number, digits)


def readonly(array: AnyArray) -> AnyArray:
    """Return a read-only view of `array`; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def _to_array(name: str, values: Any, expected: str) -> AnyArray:
    """Return `values` as an array of any type; raise GeometryError with the remedy."""
    if type(values) is np.ndarray:
        return values
    prefix = f"{name}: " if name else ""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise GeometryError(
            f"{prefix}expected {expected}, found {np.count_nonzero(values.mask)} masked values; "
            "pass array.filled(value) with the value that is to stand there"
        )
    try:
        if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
            return np.from_dlpack(values)
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise GeometryError(
            f"{prefix}expected {expected}, found {type(values).__name__} ({error}){_remedy(values)}"
        ) from error


def _has_shape(actual: Sequence[int], shape: Sequence[int | None]) -> bool:
    if len(actual) != len(shape):
        return False
    lengths = zip(shape, actual, strict=True)
    return all(expected is None or expected == length for expected, length in lengths)


def _remedy(values: object) -> str:
    """Return the remedy for a point cloud, or another framework's array that numpy does not read.

    Empty for all other values.
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
        "; pass a torch tensor as tensor.detach().cpu().float(), another framework's as a float32 "
        "numpy array"
    )


def _restore_arrays(kind: type[FrozenArrays], values: Mapping[str, Any]) -> FrozenArrays:
    """Undo `FrozenArrays.__reduce__`."""
    result = object.__new__(kind)
    for name, value in values.items():
        frozen = readonly(value) if isinstance(value, np.ndarray) else value
        object.__setattr__(result, name, frozen)
    return result


def _value_text(value: object) -> str:
    """Return an array's shape and type, and only the type and length of long collections."""
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
    values = collection.values() if isinstance(collection, Mapping) else collection
    return any(isinstance(value, np.ndarray | Mapping | list | tuple) for value in values)


def _field_names(kind: type[Any]) -> Iterable[str]:
    return [field.name for field in fields(kind)]


def _shape_text(shape: Sequence[int | None]) -> str:
    lengths = ["N" if length is None else str(length) for length in shape]
    return f"({', '.join(lengths)})"
