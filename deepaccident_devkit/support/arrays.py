"""Array aliases, and the checks of the arrays and numbers that a caller passes."""

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
# Kinds of element types.
_NUMBERS: Final = "biuf"
# Metres, m/s, pixels, …: a larger number in a file is damage and counts as infinite; squares would overflow.
LARGEST_NUMBER: Final = 1e9
_LONGEST_FIELDS: Final = 160
_LONGEST_VALUE: Final = 80
# In texts of records: characters of all fields and of one, and entries of a collection that are shown.
_FEW: Final = 4


def keep_freed(size: int = 31 * 2**20) -> None:
    """Have the allocator (of Linux) keep freed blocks of up to `size` bytes, 31 MiB at most, for what is made next.

    Else it returns them to the system each time, and to get their pages again takes as long as much of the work. It
    does so after it has once freed a block as large, which is never touched.
    """
    np.empty(min(size, 31 * 2**20), dtype=np.uint8)


class ShortRepr:
    """Base of dataclasses that hold arrays: their text is one line of fewer than 200 characters, with shapes of arrays.

    The text that a dataclass makes would have the arrays' numbers. A subclass may have a `__repr__` of its own.
    """

    __slots__ = ()

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        inherited = cls.__repr__
        cls.__repr__ = inherited  # type: ignore[method-assign]  # a dataclass replaces one that is not the class's own

    def __repr__(self) -> str:
        """The class and its fields, as far as they fit."""
        kind: type[Any] = type(self)
        text = ""
        for number, name in enumerate(_field_names(kind)):
            part = f"{', ' * (number > 0)}{name}={_value_text(getattr(self, name))}"
            if len(text) + len(part) > _LONGEST_FIELDS:
                text += ", …"
                break
            text += part
        return f"{kind.__name__}({text})"


class FrozenArrays(ShortRepr):
    """Base of frozen dataclasses that hold arrays: these are read-only, from the start and in every copy.

    numpy forgets on pickling and on `copy.deepcopy` that an array was read-only.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        """Freeze the arrays; a class that checks them freezes them itself."""
        kind: type[Any] = type(self)
        for field in fields(kind):
            if isinstance(value := getattr(self, field.name), np.ndarray):
                object.__setattr__(self, field.name, readonly(value))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies go without `__init__`, since what they hold was checked."""
        return _restored, (
            type(self),
            {name: getattr(self, name) for name in _field_names(type(self))},
        )


class BitView(Sequence[bool]):
    """A bool column as Arrow packs it, eight rows a byte; rows are unpacked when asked for."""

    def __init__(self, packed: ByteArray, length: int) -> None:
        """View `length` bits, lowest first."""
        self._packed, self._length = packed, length

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[bool]:
        return iter(self[:].tolist())

    def __getitem__(self, rows: Any) -> Any:
        """One row as bool; of a slice with step 1, or of an array of rows, a new bool array."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(self._length)
            return self._unpacked(start, max(start, stop))
        if isinstance(rows, np.ndarray):
            return (self._packed[rows >> 3] >> (rows & 7).astype(np.uint8) & 1).view(np.bool_)
        return bool(self._packed.item(rows >> 3) >> (rows & 7) & 1)

    def _unpacked(self, start: int, stop: int) -> BoolArray:
        window = self._packed[start >> 3 : (stop + 7) >> 3]
        first = start & 7
        return np.unpackbits(window, bitorder="little")[first : first + stop - start].view(np.bool_)


def checked(
    name: str, values: ArrayLike, shape: Sequence[int | None], dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """`values` as an array of `dtype`, or GeometryError if they are no numbers or not of `shape` (None: any length).

    With dtype None they keep theirs; an array that has it already is not copied. For integers, numbers must be whole
    and in range.
    """
    if type(values) is np.ndarray and values.dtype.kind in _NUMBERS and _fits(values.shape, shape):
        # as nearly always; many small arrays of a sample's labels come here
        return values if values.dtype == dtype else as_numbers(name, values, dtype=dtype)
    array = as_numbers(name, values, f"an array of shape {_shape_text(shape)}", dtype)
    if not _fits(array.shape, shape):
        remedy = (
            "; transpose it (.T)" if array.ndim == 2 and _fits(array.shape[::-1], shape) else ""
        )
        raise GeometryError(
            f"{name}: expected shape {_shape_text(shape)}, found {array.shape}{remedy}"
        )
    return array


def as_numbers(
    name: str, values: ArrayLike, expected: str = "numbers", dtype: DTypeLike | None = np.float64
) -> AnyArray:
    """`checked` for any shape: the one way in for a caller's arrays, of any framework.

    Everything is taken that numpy can read without a copy from another device: its own arrays, sequences, and objects
    with `__array__` or DLPack, such as torch tensors on the processor. Nothing is detached, fetched from an accelerator
    or unmasked silently; the error says how. Numbers must be in the range of a float type too (NaN and inf pass).
    """
    given = _read(name, values, expected)
    wanted = given.dtype if dtype is None else np.dtype(dtype)
    if given.dtype.kind not in _NUMBERS:
        raise GeometryError(
            f"{name}: expected {expected}, found {type(values).__name__} (no numbers: {given.dtype}){_remedy(values)}"
        )
    if given.dtype == wanted:
        return given
    if np.can_cast(given.dtype, wanted, "safe"):
        return given.astype(wanted)
    with np.errstate(invalid="ignore", over="ignore"):
        array = given.astype(wanted)
    if wanted.kind in "iu":
        if not np.array_equal(array, given):
            other = given[array != given].flat[0]
            raise GeometryError(f"{name}: expected whole numbers of {wanted}, found {other}")
    elif (
        wanted.kind == "f"
        and wanted.itemsize < given.dtype.itemsize
        and not np.isfinite(array).all()
    ):
        lost = np.isinf(array) & np.isfinite(given)
        if lost.any():
            raise GeometryError(
                f"{name}: expected numbers within {wanted}'s range, found {given[lost][0]}"
            )
    return array


def checked_number(
    name: str,
    value: object,
    expected: str = "a number",
    error: type[DeepAccidentError] = GeometryError,
) -> float:
    """A single number, numpy's scalars among them, as Python's float; or raise `error`, which says what is expected."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    try:
        if isinstance(value, Real):
            return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        pass
    raise error(f"{name}: expected {expected}, found {value!r}")


def checked_whole(
    name: str,
    value: object,
    expected: str = "a whole number",
    error: type[DeepAccidentError] = GeometryError,
) -> int:
    """A single whole number, numpy's integers among them, as Python's int; or raise `error`."""
    try:
        return operator.index(value)  # type: ignore[arg-type]  # everything else is refused
    except TypeError:
        raise error(f"{name}: expected {expected}, found {value!r}") from None


def checked_flag(name: str, value: object) -> bool:
    """True or False, or ConfigError."""
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{name}: expected True or False, found {value!r}")
    return bool(value)


def checked_count(name: str, value: object, what: str, most: int) -> int:
    """A whole number from 1 to `most`, or ConfigError, which says what it counts."""
    expected = f"a whole number from 1 to {most:,} ({what})"
    found = (
        0
        if isinstance(value, bool | np.bool_)
        else checked_whole(name, value, expected, ConfigError)
    )
    if not 1 <= found <= most:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return found


def checked_setting(
    name: str, value: object, expected: str, least: float = -math.inf, most: float = math.inf
) -> float:
    """A finite number from `least` to `most`, or ConfigError."""
    found = (
        math.nan
        if isinstance(value, bool | np.bool_)
        else checked_number(name, value, expected, ConfigError)
    )
    if not (math.isfinite(found) and least <= found <= most):
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return found


def check_least(record: object, **least: float) -> None:
    """Raise ConfigError if a field of a configuration is less than it may be, or NaN."""
    for name, lowest in least.items():
        if not (value := getattr(record, name)) >= lowest:
            raise ConfigError(f"{name}: expected a number from {lowest}, found {value!r}")


def as_floats(values: ArrayLike) -> FloatArray:
    """`values` as float64; arrays that are float64 already are not copied. Raises GeometryError."""
    given = _read("", values, "numbers")
    if given.dtype == _FLOAT64:
        return given
    try:
        if given.dtype.kind == "c":
            raise TypeError(f"no real numbers: {given.dtype}")
        return given.astype(_FLOAT64)
    except (TypeError, ValueError) as error:
        raise GeometryError(f"expected numbers, found {type(values).__name__} ({error})") from error


def in_range(numbers: AnyArray | float) -> BoolArray:
    """Which numbers are neither NaN nor infinite, nor as large as no sound file has them."""
    small: BoolArray = np.abs(numbers) <= np.float64(LARGEST_NUMBER)  # half precision has no 1e9
    return small


def known(values: ArrayLike | None, digits: int | None = None) -> Any:
    """Numbers as JSON holds them, in lists as deep as the array, rounded; None for what is not finite."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim:
        return [known(each, digits) for each in array]
    number = array.item() if np.isfinite(array) else None
    return number if number is None or digits is None else round(number, digits)


def readonly(array: AnyArray) -> AnyArray:
    """Return a read-only view of `array`; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def _read(name: str, values: Any, expected: str) -> AnyArray:
    """`values` as an array of any type, or GeometryError with the remedy."""
    if type(values) is np.ndarray:
        return values
    prefix = f"{name}: " if name else ""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise GeometryError(
            f"{prefix}expected {expected}, found {np.count_nonzero(values.mask)} masked values; pass "
            "array.filled(value) with the value that is to stand there"
        )
    try:
        if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
            return np.from_dlpack(values)
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise GeometryError(
            f"{prefix}expected {expected}, found {type(values).__name__} ({error}){_remedy(values)}"
        ) from error


def _fits(found: Sequence[int], shape: Sequence[int | None]) -> bool:
    return len(found) == len(shape) and all(
        want is None or want == have for want, have in zip(shape, found, strict=True)
    )


def _remedy(values: object) -> str:
    """The remedy for a point cloud, or another framework's array that numpy does not read; empty for the rest."""
    if hasattr(values, "xyz"):
        return "; give its array, .xyz"
    if hasattr(values, "corners"):  # boxes, whose own error has the remedy
        return ""
    if isinstance(values, np.ndarray) or not (
        hasattr(values, "__array__") or hasattr(values, "__dlpack__")
    ):
        return ""
    return "; pass a torch tensor as tensor.detach().cpu().float(), another framework's as a float32 numpy array"


def _restored(kind: type[FrozenArrays], values: Mapping[str, Any]) -> FrozenArrays:
    """Undo `FrozenArrays.__reduce__`."""
    result = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(
            result, name, readonly(value) if isinstance(value, np.ndarray) else value
        )
    return result


def _value_text(value: object) -> str:
    """An array's shape and type; of what is long, only its type, and how many it holds."""
    if isinstance(value, np.ndarray):
        return f"{value.shape} {value.dtype}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping | list | tuple) and (len(value) > _FEW or _holds_arrays(value)):
        return (
            f"<{len(value)} in a {'dict' if isinstance(value, Mapping) else type(value).__name__}>"
        )
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{type(value).__name__}(…)"


def _holds_arrays(values: Mapping[Any, Any] | Sequence[Any]) -> bool:
    each = values.values() if isinstance(values, Mapping) else values
    return any(isinstance(one, np.ndarray | Mapping | list | tuple) for one in each)


def _field_names(kind: type[Any]) -> Iterable[str]:
    return [field.name for field in fields(kind)]


def _shape_text(shape: Sequence[int | None]) -> str:
    return "(" + ", ".join("N" if length is None else str(length) for length in shape) + ")"
