"""Pickles of arrays: read without running anything of them, and written for old readers, too.

The oldest readers are Python 3.7 and numpy 1.16. Protocol 3 names globals in plain text. Numpy 2
writes its private path, which numpy 1 does not have; numpy 2 reads the old path.
(`reducer_override` cannot give a function another name: it must lead to that very function.)
"""

import pickle
import re
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from typing import Any, BinaryIO, Final, Literal, NamedTuple, cast

import numpy as np

from deepaccident_devkit.errors import shortened
from deepaccident_devkit.release._unpickle import Machine
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.reading import fault_text

_PROTOCOL: Final = 3
_BEGIN: Final = pickle.PROTO + bytes([_PROTOCOL])
_OLD_NAME: Final = b"cnumpy.core.multiarray\n"
_NEW_NAME: Final = b"cnumpy._core.multiarray\n"
# A calib file has 263 to 543 opcodes.
MAX_OPCODES: Final = 10_000
# Depth of nested containers; a calib file has depth 1.
_MAX_DEPTH: Final = 20
# Values may take this many bytes more than the pickle, which may hold an array twice and store it
# once.
_EXTRA_BYTES: Final = 1 << 20
_MIN_BYTES_PER_VALUE: Final = 64
# The calib files of a release have few layouts, which differ in the content of their arrays.
_MAX_LAYOUTS: Final = 16
_MAX_MESSAGE_LENGTH: Final = 200
# The only allowed dtypes: numpy itself would evaluate other strings.
_PLAIN_NUMBER: Final = re.compile(r"[<>=|]?[fiub][1-9][0-9]?", re.ASCII)
# State of a number's dtype in numpy's pickles after version and byte order: no fields, no size of
# its own.
_NUMBER_STATE: Final = (None, None, None, -1, -1, 0)
_PLAIN_TYPES: Final = (type(None), bool, int, float, str)
# Errors that damaged or hostile bytes can raise.
_FAULTS: Final = (
    pickle.UnpicklingError,
    AttributeError,
    LookupError,
    MemoryError,
    OverflowError,
    TypeError,
    ValueError,
    Warning,  # where warnings are errors
)


def load_arrays(content: bytes) -> Any:
    """Return the value of a pickle: a dictionary of numeric numpy arrays and other plain values.

    It may only contain the names of numpy's own pickles of arrays (numpy 1 and 2, protocols 0 to
    5). Stand-ins for these names record the content of arrays, from which the arrays are made.
    Anything else raises pickle.UnpicklingError, and nothing of it has run.
    """
    try:
        layout = next((layout for layout in layouts if layout.fits(content)), None)
        if layout is not None:
            return _Values(content).converted(layout.value)
        machine = Machine(content, _NAMES, MAX_OPCODES)
        value = _Values(content).converted(machine.value)
    except _FAULTS as error:
        message = shortened(fault_text(error), _MAX_MESSAGE_LENGTH)
        if not message.isprintable():  # a pickle's own text may hold control characters
            message = ascii(message)[1:-1]
        raise pickle.UnpicklingError(message) from error
    if machine.slices:
        parts = []
        start = 0
        for part in machine.slices:
            parts.append((start, content[start : part.start]))
            start = part.stop
        parts.append((start, content[start:]))
        new_layout = _Layout(len(content), parts, machine.value)
        layouts[:] = [new_layout, *layouts[: _MAX_LAYOUTS - 1]]
    return value


def load_stacked(contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
    """Return the arrays of N pickles of one layout by key, shape (N, …), in their own dtypes.

    Return None if one of them has another layout, or one that `load_arrays` has not read, or holds
    more than a dictionary of C-ordered arrays: each pickle must then be loaded separately.
    """
    for layout in layouts:
        arrays = layout.stacked(contents)
        if arrays is not None:
            return arrays
    return None


def pickled(value: object) -> bytes:
    """Return a value as a pickle."""
    return _with_old_names(pickle.dumps(value, protocol=_PROTOCOL))


def pickled_items(items: Iterable[object]) -> bytes:
    """Return items as a piece for `write_joined`.

    The bytes depend only on the values of the items, not on objects that they share. Items are
    plain values and arrays of numbers or text.
    """
    stream = BytesIO()
    for item in items:
        stream.write(_opcodes(item))
    return stream.getvalue()


def write_joined(
    file: BinaryIO, name: str, pieces: Iterable[bytes], other_items: Mapping[str, object]
) -> None:
    """Write the pickle of `{name: [items of all pieces], **other_items}`.

    Only one piece at a time is in memory.
    """
    file.write(_BEGIN + pickle.EMPTY_DICT + pickle.MARK + _opcodes(name) + pickle.EMPTY_LIST)
    file.writelines(pickle.MARK + piece + pickle.APPENDS for piece in pieces)
    file.write(pickled_items(part for item in other_items.items() for part in item))
    file.write(pickle.SETITEMS + pickle.STOP)


class _Pickler(pickle.Pickler):
    """A writer of pickles without a memo, so that pieces can follow each other.

    A dtype is written as its code.
    """

    def __init__(self, stream: BytesIO) -> None:
        """Write to a stream."""
        super().__init__(stream, protocol=_PROTOCOL)
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        """Return the form of an array or a dtype; other objects have their usual form."""
        if isinstance(obj, np.ndarray):
            array: AnyArray = np.ascontiguousarray(obj)
            reduced = cast("tuple[Any, Any, tuple[Any, ...]]", array.__reduce__())
            constructor, arguments, (version, _, *state) = reduced
            return constructor, arguments, (version, obj.shape, *state)
        if isinstance(obj, np.dtype):
            return np.dtype, (obj.str,)
        return NotImplemented


def _opcodes(value: object) -> bytes:
    """Return the opcodes that push a value on the stack."""
    stream = BytesIO()
    _Pickler(stream).dump(value)
    return _with_old_names(stream.getvalue()[len(_BEGIN) : -len(pickle.STOP)])


def _with_old_names(content: bytes) -> bytes:
    """Return a pickle with the path of numpy 1."""
    return content.replace(_NEW_NAME, _OLD_NAME)


class _Layout(NamedTuple):
    """The layout of a pickle that was read: everything except the contents of its byte strings.

    The contents decide nothing, so that a pickle with the same layout has the same value.

    Attributes:
        size: Size of the pickle, bytes.
        parts: Begin and content of each part between the byte strings.
        value: Value of the machine, with slices instead of byte strings.
    """

    size: int
    parts: list[tuple[int, bytes]]
    value: Any

    def fits(self, content: bytes) -> bool:
        """Return whether a pickle has this layout."""
        if len(content) != self.size:
            return False
        return all(content.startswith(part, start) for start, part in self.parts)

    def stacked(self, contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """Return the stacked arrays of pickles with this layout, or None.

        The value must be a dictionary of arrays with bytes of their own.
        """
        arrays = self.value if isinstance(self.value, dict) else {}
        are_plain = all(
            isinstance(array, _Array) and isinstance(array.content, slice) and array.order == "C"
            for array in arrays.values()
        )
        if not arrays or not are_plain or {self.size} != set(map(len, contents)):
            return None
        rows = np.frombuffer(b"".join(contents), np.uint8).reshape(-1, self.size)
        for start, part in self.parts:
            if (rows[:, start : start + len(part)] != np.frombuffer(part, np.uint8)).any():
                return None
        stacked = {}
        for key, array in arrays.items():
            columns = rows[:, array.content].copy()
            stacked[key] = columns.view(array.dtype).reshape(-1, *array.shape)
        return stacked


# The newest layout comes first.
layouts: list[_Layout] = []


class _Kind:
    """A stand-in for `numpy.dtype`: only plain numbers, no objects, no records."""

    __slots__ = ("dtype",)

    def __init__(self, code: object, *_flags: object) -> None:
        """Take the dtype of a code; raises pickle.UnpicklingError."""
        if not isinstance(code, str) or not _PLAIN_NUMBER.fullmatch(code):
            kind = repr(code) if isinstance(code, str) else "what is no text"
            raise pickle.UnpicklingError(f"an array of {kind} is not allowed")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        """Take the byte order from the state that numpy writes."""
        if state[1] not in ("<", ">", "=", "|") or state != (3, state[1], *_NUMBER_STATE):
            raise pickle.UnpicklingError(
                "an array of numbers with parts, or in no known byte order, is not allowed"
            )
        self.dtype = self.dtype.newbyteorder(state[1])


class _Encoded(NamedTuple):
    """A stand-in for `_codecs.encode`, by which protocols 0 to 2 write bytes as latin1 text."""

    text: str
    encoding: str = "latin1"


class _Array:
    """Record of a `numpy.ndarray` in a pickle."""

    __slots__ = ("content", "dtype", "order", "shape")

    def __init__(self, *_class_shape_and_code: object) -> None:
        """Begin without content."""
        self.content: object = None

    def __setstate__(self, state: Any) -> None:
        """Record version, shape, dtype, Fortran order and content, as numpy writes them."""
        version, shape, kind, fortran, content = state
        if version != 1 or not isinstance(kind, _Kind):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        self.shape, self.dtype, self.content = shape, kind.dtype, content
        self.order: Literal["C", "F"] = "F" if fortran else "C"


def _from_buffer(content: object, kind: object, shape: Sequence[int], order: str = "C") -> _Array:
    """Stand in for `numpy.core.numeric._frombuffer`, by which protocol 5 writes arrays."""
    if order not in ("C", "F"):
        raise pickle.UnpicklingError("an array of another order than C or F is not allowed")
    array = _Array()
    array.__setstate__((1, shape, kind, order == "F", content))
    return array


_NAMES: Final[Mapping[str, object]] = {
    "numpy ndarray": object(),
    "numpy dtype": _Kind,
    "_codecs encode": _Encoded,
    **{f"numpy.{core}.multiarray _reconstruct": _Array for core in ("core", "_core")},
    **{f"numpy.{core}.numeric _frombuffer": _from_buffer for core in ("core", "_core")},
}


class _Values:
    """Conversion of a machine's value, with a limit on its size.

    A part of the value may be in many places, or in itself.
    """

    __slots__ = ("_content", "_remaining_bytes")

    def __init__(self, content: bytes) -> None:
        """Convert values of a pickle with this content."""
        self._content = memoryview(content)
        self._remaining_bytes = len(content) + _EXTRA_BYTES

    def converted(self, value: Any, depth: int = 0) -> Any:
        """Return a value with arrays instead of records; raises pickle.UnpicklingError."""
        self._use_bytes(_MIN_BYTES_PER_VALUE)
        if depth > _MAX_DEPTH:
            raise pickle.UnpicklingError(
                f"more than {_MAX_DEPTH} containers within each other are not allowed"
            )
        kind = type(value)
        if kind is _Array:
            return self._array(value)
        if kind is dict:
            if not all(type(key) is str and key.isprintable() for key in value):
                raise pickle.UnpicklingError(
                    "a key that is no text, or cannot be printed, is not allowed"
                )
            self._use_bytes(sum(map(len, value)))
            return {key: self.converted(item, depth + 1) for key, item in value.items()}
        if kind is list or kind is tuple:
            return kind([self.converted(item, depth + 1) for item in value])
        if kind is slice or kind is _Encoded:
            return bytes(self._bytes(value))
        if kind not in _PLAIN_TYPES:
            raise pickle.UnpicklingError("a part of numpy in place of a value is not allowed")
        return value

    def _array(self, record: _Array) -> AnyArray:
        """Return the array of a record."""
        if record.content is None:
            raise pickle.UnpicklingError("an array without its numbers is not allowed")
        flat: AnyArray = np.frombuffer(self._bytes(record.content), dtype=record.dtype)
        array = flat.reshape(record.shape, order=record.order)
        if array.shape != record.shape:  # reshape itself would replace a negative length
            raise pickle.UnpicklingError(
                "an array whose shape is not what its bytes have is not allowed"
            )
        return array.astype(record.dtype.newbyteorder("="))

    def _bytes(self, content: object) -> bytes | memoryview:
        """Return the bytes of a recorded byte string."""
        if isinstance(content, str):  # of Python 2
            content = _Encoded(content)
        if isinstance(content, slice):
            self._use_bytes(content.stop - content.start)
            return self._content[content]
        if not isinstance(content, _Encoded) or not isinstance(content.text, str):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        if content.encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("_codecs.encode is allowed for latin1 text only")
        self._use_bytes(len(content.text))
        return content.text.encode("latin1")

    def _use_bytes(self, size: int) -> None:
        """Subtract bytes from the limit, or raise pickle.UnpicklingError."""
        self._remaining_bytes -= size
        if self._remaining_bytes < 0:
            raise pickle.UnpicklingError(
                "values that are far larger than their pickle are not allowed"
            )
