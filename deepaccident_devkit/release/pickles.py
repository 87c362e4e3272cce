"""Pickles of arrays: read without executing anything in them, and written for old readers too.

The oldest supported readers are Python 3.7 and numpy 1.16. Protocol 3 names globals in plain text.
numpy 2 writes the path of a private module that numpy 1 lacks, so it is replaced by the old path,
which numpy 2 can read too. (`reducer_override` cannot give a function another name: it must lead to
that very function.)
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

_PROTOCOL = 3
_BEGIN = pickle.PROTO + bytes([_PROTOCOL])
_OLD_NAME = b"cnumpy.core.multiarray\n"
_NEW_NAME = b"cnumpy._core.multiarray\n"
# A calib file has 263 to 543 opcodes.
MAX_OPCODES: Final = 10_000
# Depth of nested containers; a calib file has depth 1.
_MAX_DEPTH = 20
# Values may take this many bytes more than the pickle, which may refer to a stored array twice.
_EXTRA_BYTES = 1 << 20
_MIN_BYTES_PER_VALUE = 64
# The calib files of a release have few layouts; files of one layout differ only in array contents.
_MAX_LAYOUTS = 16
_MAX_MESSAGE_LENGTH = 200
# The only allowed dtypes: numpy itself would evaluate other strings.
_PLAIN_NUMBER = re.compile(r"[<>=|]?[fiub][1-9][0-9]?", re.ASCII)
# State of a number's dtype in numpy's pickles after version and byte order: no fields, no size of
# its own.
_NUMBER_STATE = (None, None, None, -1, -1, 0)
_PLAIN_TYPES = (type(None), bool, int, float, str)
# Errors that damaged or malicious bytes can cause.
_FAULTS = (
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
    """Load the value of a pickle: a dictionary of numeric numpy arrays and other plain values.

    The pickle may only contain the names that numpy's pickles of arrays have (numpy 1 and 2,
    protocols 0 to 5). Stand-ins for these names record the contents of arrays, from which the
    arrays are made. Anything else raises pickle.UnpicklingError; nothing in the pickle is ever
    executed.
    """
    try:
        layout = next((layout for layout in layouts if layout.fits(content)), None)
        if layout is not None:
            return _ValueConverter(content).convert(layout.value)
        machine = Machine(content, _NAMES, MAX_OPCODES)
        value = _ValueConverter(content).convert(machine.value)
    except _FAULTS as error:
        message = shortened(fault_text(error), _MAX_MESSAGE_LENGTH)
        if not message.isprintable():  # a pickle's own text may hold control characters
            message = ascii(message)[1:-1]
        raise pickle.UnpicklingError(message) from error
    if machine.slices:
        parts = []
        start = 0
        for byte_slice in machine.slices:
            parts.append((start, content[start : byte_slice.start]))
            start = byte_slice.stop
        parts.append((start, content[start:]))
        new_layout = _Layout(len(content), parts, machine.value)
        layouts[:] = [new_layout, *layouts[: _MAX_LAYOUTS - 1]]
    return value


def load_stacked(contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
    """Load the arrays of N pickles with the same layout, by key, shape (N, …), in their own dtypes.

    The result is None, and each pickle must be loaded separately, if their layouts differ, if
    `load_arrays` has not read one with this layout before, or if they contain anything other than a
    dictionary of C-ordered arrays.
    """
    for layout in layouts:
        arrays = layout.stack_arrays(contents)
        if arrays is not None:
            return arrays
    return None


def pickled(value: object) -> bytes:
    """Return the pickle of a value."""
    content = pickle.dumps(value, protocol=_PROTOCOL)
    return _restore_old_names(content)


def pickled_items(items: Iterable[object]) -> bytes:
    """Return the piece of a pickle, for `write_joined`, that contains some items of its list.

    The bytes depend only on the values of the items, not on objects that they share. Items are
    plain values and arrays of numbers or text.
    """
    stream = BytesIO()
    for item in items:
        stream.write(_dump_opcodes(item))
    return stream.getvalue()


def write_joined(
    file: BinaryIO, name: str, pieces: Iterable[bytes], other_items: Mapping[str, object]
) -> None:
    """Write the pickle of `{name: [items of all pieces], **other_items}`.

    Only one piece is in memory at a time.
    """
    file.write(_BEGIN + pickle.EMPTY_DICT + pickle.MARK)
    file.write(_dump_opcodes(name) + pickle.EMPTY_LIST)
    file.writelines(pickle.MARK + piece + pickle.APPENDS for piece in pieces)
    file.writelines(map(pickled_items, other_items.items()))
    file.write(pickle.SETITEMS + pickle.STOP)


class _Pickler(pickle.Pickler):
    """A writer of pickles without a memo, so that one piece can follow another.

    A dtype is written as its code.
    """

    def __init__(self, stream: BytesIO) -> None:
        """Write to a stream."""
        super().__init__(stream, protocol=_PROTOCOL)
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        """Return how an array or a dtype is written; other objects are written as usual."""
        if isinstance(obj, np.ndarray):
            array: AnyArray = np.ascontiguousarray(obj)
            reduced = cast("tuple[Any, Any, tuple[Any, ...]]", array.__reduce__())
            constructor, arguments, (version, _, *state) = reduced
            return constructor, arguments, (version, obj.shape, *state)
        if isinstance(obj, np.dtype):
            return np.dtype, (obj.str,)
        return NotImplemented


def _dump_opcodes(value: object) -> bytes:
    """Return the opcodes that push a value onto the stack."""
    stream = BytesIO()
    _Pickler(stream).dump(value)
    opcodes = stream.getvalue()[len(_BEGIN) : -len(pickle.STOP)]
    return _restore_old_names(opcodes)


def _restore_old_names(content: bytes) -> bytes:
    """Replace numpy 2's module name in a pickle with the one that numpy 1 writes."""
    return content.replace(_NEW_NAME, _OLD_NAME)


class _Layout(NamedTuple):
    """The layout of a pickle that was read: everything except the contents of its byte strings.

    Apart from these contents, pickles with the same layout have the same value.

    Attributes:
        size: Size of the pickle, bytes.
        parts: Start and content of each part between the byte strings.
        value: Value of the machine, with slices instead of byte strings.
    """

    size: int
    parts: list[tuple[int, bytes]]
    value: Any

    def fits(self, content: bytes) -> bool:
        """Return whether a pickle has this layout."""
        if len(content) != self.size:
            return False
        for start, part in self.parts:
            if not content.startswith(part, start):
                return False
        return True

    def stack_arrays(self, contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """Return the stacked arrays of pickles with this layout, or None.

        The result is None unless the value is a dictionary of arrays that share no bytes.
        """
        arrays = self.value
        if not isinstance(arrays, dict) or not arrays or {self.size} != set(map(len, contents)):
            return None
        are_plain = all(
            isinstance(array, _ArrayRecord)
            and isinstance(array.content, slice)
            and array.order == "C"
            for array in arrays.values()
        )
        if not are_plain:
            return None
        rows = np.frombuffer(b"".join(contents), np.uint8).reshape(-1, self.size)
        for start, part in self.parts:
            columns = rows[:, start : start + len(part)]
            if (columns != np.frombuffer(part, np.uint8)).any():
                return None
        stacked = {}
        for key, array in arrays.items():
            columns = rows[:, array.content].copy()
            stacked[key] = columns.view(array.dtype).reshape(-1, *array.shape)
        return stacked


# The newest layout comes first.
layouts: list[_Layout] = []


class _DtypeRecord:
    """A stand-in for `numpy.dtype` that only allows plain numbers, not objects or records."""

    __slots__ = ("dtype",)

    def __init__(self, code: object, *_flags: object) -> None:
        """Store the dtype of a code; raise pickle.UnpicklingError unless it is a plain number."""
        if not isinstance(code, str) or not _PLAIN_NUMBER.fullmatch(code):
            kind = repr(code) if isinstance(code, str) else "a value that is not text"
            raise pickle.UnpicklingError(f"an array of {kind} is not allowed")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        """Take the byte order from the state that numpy writes."""
        if state[1] not in ("<", ">", "=", "|") or state != (3, state[1], *_NUMBER_STATE):
            raise pickle.UnpicklingError(
                "an array of numbers with parts, or in no known byte order, is not allowed"
            )
        self.dtype = self.dtype.newbyteorder(state[1])


class _EncodedBytes(NamedTuple):
    """A stand-in for `_codecs.encode`, by which protocols 0 to 2 write bytes as latin1 text."""

    text: str
    encoding: str = "latin1"


class _ArrayRecord:
    """Record of a `numpy.ndarray` in a pickle."""

    __slots__ = ("content", "dtype", "order", "shape")

    def __init__(self, *_class_shape_and_code: object) -> None:
        """Start without content."""
        self.content: object = None

    def __setstate__(self, state: Any) -> None:
        """Record version, shape, dtype, Fortran order and content, as numpy writes them."""
        version, shape, kind, fortran, content = state
        if version != 1 or not isinstance(kind, _DtypeRecord):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        self.shape = shape
        self.dtype = kind.dtype
        self.content = content
        self.order: Literal["C", "F"] = "F" if fortran else "C"


def _from_buffer(
    content: object, kind: object, shape: Sequence[int], order: str = "C"
) -> _ArrayRecord:
    """Record an array; stands in for numpy's `_frombuffer`, with which protocol 5 writes arrays."""
    if order not in ("C", "F"):
        raise pickle.UnpicklingError("an array in an order other than C or F is not allowed")
    array = _ArrayRecord()
    array.__setstate__((1, shape, kind, order == "F", content))
    return array


_NAMES: Mapping[str, object] = {
    "numpy ndarray": object(),
    "numpy dtype": _DtypeRecord,
    "_codecs encode": _EncodedBytes,
    **{f"numpy.{core}.multiarray _reconstruct": _ArrayRecord for core in ("core", "_core")},
    **{f"numpy.{core}.numeric _frombuffer": _from_buffer for core in ("core", "_core")},
}


class _ValueConverter:
    """A converter of a machine's value that limits the size of the result.

    A part of the value may occur in many places, or contain itself.
    """

    __slots__ = ("_content", "_remaining_bytes")

    def __init__(self, content: bytes) -> None:
        """Prepare to convert values of the pickle with these bytes."""
        self._content = memoryview(content)
        self._remaining_bytes = len(content) + _EXTRA_BYTES

    def convert(self, value: Any, depth: int = 0) -> Any:
        """Replace array records with arrays; raise pickle.UnpicklingError for forbidden values."""
        self._use_bytes(_MIN_BYTES_PER_VALUE)
        if depth > _MAX_DEPTH:
            raise pickle.UnpicklingError(
                f"more than {_MAX_DEPTH} containers within each other are not allowed"
            )
        kind = type(value)
        if kind is _ArrayRecord:
            return self._make_array(value)
        if kind is dict:
            if not all(type(key) is str and key.isprintable() for key in value):
                raise pickle.UnpicklingError(
                    "a key that is not text, or cannot be printed, is not allowed"
                )
            self._use_bytes(sum(map(len, value)))
            return {key: self.convert(item, depth + 1) for key, item in value.items()}
        if kind is list or kind is tuple:
            return kind([self.convert(item, depth + 1) for item in value])
        if kind is slice or kind is _EncodedBytes:
            return bytes(self._get_bytes(value))
        if kind not in _PLAIN_TYPES:
            raise pickle.UnpicklingError("a part of numpy instead of a value is not allowed")
        return value

    def _make_array(self, record: _ArrayRecord) -> AnyArray:
        """Return the array of a record."""
        if record.content is None:
            raise pickle.UnpicklingError("an array without its numbers is not allowed")
        numbers: AnyArray = np.frombuffer(self._get_bytes(record.content), dtype=record.dtype)
        array = numbers.reshape(record.shape, order=record.order)
        if array.shape != record.shape:  # reshape itself would replace a negative length
            raise pickle.UnpicklingError(
                "an array with a shape that does not match its bytes is not allowed"
            )
        return array.astype(record.dtype.newbyteorder("="))

    def _get_bytes(self, content: object) -> bytes | memoryview:
        """Return the bytes of a recorded byte string."""
        if isinstance(content, str):  # of Python 2
            content = _EncodedBytes(content)
        if isinstance(content, slice):
            self._use_bytes(content.stop - content.start)
            return self._content[content]
        if not isinstance(content, _EncodedBytes) or not isinstance(content.text, str):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        if content.encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("_codecs.encode is allowed for latin1 text only")
        self._use_bytes(len(content.text))
        return content.text.encode("latin1")

    def _use_bytes(self, size: int) -> None:
        """Subtract bytes from the limit; raise pickle.UnpicklingError if it is exceeded."""
        self._remaining_bytes -= size
        if self._remaining_bytes < 0:
            raise pickle.UnpicklingError(
                "values that are far larger than their pickle are not allowed"
            )
