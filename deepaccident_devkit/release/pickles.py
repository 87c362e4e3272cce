"""Pickles of arrays: read without running anything of them, and written so that old readers open them.

Old ones are Python 3.7 and numpy 1.16. Protocol 3 names globals in plain text. numpy 2 writes its private path there,
which numpy 1 does not have; numpy 2 reads the old one. (`reducer_override` cannot give a function another name: it must
lead to that very function.)
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
# A calib file has 263 to 543.
MOST_OPCODES: Final = 10_000
# Containers within each other; a calib file has 1.
_DEEPEST: Final = 20
# Bytes that values may take beyond those of the pickle, which may hold an array twice and store it once.
_ROOM: Final = 1 << 20
# Bytes of a value, at least.
_A_VALUE: Final = 64
# Layouts that are remembered; the calib files of a release have few, which differ in what is in their arrays.
_MOST_LAYOUTS: Final = 16
_LONGEST_SENTENCE: Final = 200
# The only dtypes allowed: numpy itself would evaluate other strings.
_PLAIN_NUMBER: Final = re.compile(r"[<>=|]?[fiub][1-9][0-9]?", re.ASCII)
# What numpy's pickles of a number's dtype say after version and byte order: no fields, no size of its own.
_NUMBER_STATE: Final = (None, None, None, -1, -1, 0)
# What damaged or hostile bytes can raise.
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
    """The value of a pickle: a dict of numeric numpy arrays, beside which other plain values stay what they are.

    It may name only what numpy's own pickles of arrays name (numpy 1 and 2, protocols 0 to 5). What stands for those
    names notes what an array is made of; the arrays are made from the notes. Anything else raises
    pickle.UnpicklingError, and nothing of it has run.
    """
    try:
        layout = next((each for each in layouts if each.fits(content)), None)
        if layout is not None:
            return _Values(content).made(layout.value)
        machine = Machine(content, _NAMES, MOST_OPCODES)
        value = _Values(content).made(machine.value)
    except _FAULTS as error:
        said = shortened(
            fault_text(error), _LONGEST_SENTENCE
        )  # a pickle's own text may be no text for a screen
        raise pickle.UnpicklingError(said if said.isprintable() else ascii(said)[1:-1]) from error
    if machine.slices:
        starts, ends = (
            [0, *(each.stop for each in machine.slices)],
            [*(each.start for each in machine.slices), None],
        )
        parts = [(start, content[start:end]) for start, end in zip(starts, ends, strict=True)]
        layouts[:] = [_Layout(len(content), parts, machine.value), *layouts[: _MOST_LAYOUTS - 1]]
    return value


def load_stacked(contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
    """The arrays of several pickles of one layout, by key: (N, …) of N pickles, in their own dtypes.

    None if one of them is of no layout that `load_arrays` has read, or another's, or more than a dict of C-ordered
    arrays: then each is to be loaded by itself.
    """
    return next((found for each in layouts if (found := each.stacked(contents)) is not None), None)


def pickled(value: object) -> bytes:
    """A value as a pickle."""
    return _with_old_names(pickle.dumps(value, protocol=_PROTOCOL))


def pickled_items(items: Iterable[object]) -> bytes:
    """Items as a piece for `write_joined`; their bytes depend on their values alone, not on which objects are shared.

    Items are plain values and arrays of numbers or text.
    """
    stream = BytesIO()
    for item in items:
        stream.write(_opcodes(item))
    return stream.getvalue()


def write_joined(
    file: BinaryIO, name: str, pieces: Iterable[bytes], beside: Mapping[str, object]
) -> None:
    """Write the pickle of `{name: [items of all pieces], **beside}`; one piece at a time is in memory."""
    file.write(_BEGIN + pickle.EMPTY_DICT + pickle.MARK + _opcodes(name) + pickle.EMPTY_LIST)
    file.writelines(pickle.MARK + piece + pickle.APPENDS for piece in pieces)
    file.write(pickled_items(part for item in beside.items() for part in item))
    file.write(pickle.SETITEMS + pickle.STOP)


class _Pickler(pickle.Pickler):
    """Notes nothing of what it wrote, so that pieces can follow each other; a dtype is no more than its code."""

    def __init__(self, stream: BytesIO) -> None:
        super().__init__(stream, protocol=_PROTOCOL)
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        """How an array or a dtype is written; anything else as usual."""
        if isinstance(obj, np.ndarray):
            array: AnyArray = np.ascontiguousarray(obj)
            make, arguments, (version, _, *rest) = cast(
                "tuple[Any, Any, tuple[Any, ...]]", array.__reduce__()
            )
            return make, arguments, (version, obj.shape, *rest)
        if isinstance(obj, np.dtype):
            return np.dtype, (obj.str,)
        return NotImplemented


def _opcodes(value: object) -> bytes:
    """What pushes a value on the stack."""
    stream = BytesIO()
    _Pickler(stream).dump(value)
    return _with_old_names(stream.getvalue()[len(_BEGIN) : -len(pickle.STOP)])


def _with_old_names(content: bytes) -> bytes:
    return content.replace(_NEW_NAME, _OLD_NAME)


class _Layout(NamedTuple):
    """A pickle that was read, without the bytes in it, which decide nothing: one that is the same else has its value.

    Attributes:
        size: bytes.
        parts: what is between the bytes in it, and where each part begins.
        value: of the machine, with slices in the place of bytes.
    """

    size: int
    parts: list[tuple[int, bytes]]
    value: Any

    def fits(self, content: bytes) -> bool:
        return len(content) == self.size and all(
            content.startswith(part, start) for start, part in self.parts
        )

    def stacked(self, contents: Sequence[bytes]) -> dict[str, AnyArray] | None:
        """The arrays of all contents if they fit, and the value is a dict of arrays with bytes of their own."""
        arrays = self.value if isinstance(self.value, dict) else {}
        plain = all(
            isinstance(each, _Array) and isinstance(each.content, slice) and each.order == "C"
            for each in arrays.values()
        )
        if not arrays or not plain or {self.size} != set(map(len, contents)):
            return None
        rows = np.frombuffer(b"".join(contents), np.uint8).reshape(-1, self.size)
        for start, part in self.parts:
            if (rows[:, start : start + len(part)] != np.frombuffer(part, np.uint8)).any():
                return None
        return {
            key: rows[:, each.content].copy().view(each.dtype).reshape(-1, *each.shape)
            for key, each in arrays.items()
        }


# The latest first.
layouts: list[_Layout] = []


class _Kind:
    """Stands for `numpy.dtype`: plain numbers only, no objects, no records."""

    __slots__ = ("dtype",)

    def __init__(self, code: object, *_flags: object) -> None:
        if not isinstance(code, str) or not _PLAIN_NUMBER.fullmatch(code):
            found = repr(code) if isinstance(code, str) else "what is no text"
            raise pickle.UnpicklingError(f"an array of {found} is not allowed")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        """Take the byte order from the state that numpy writes."""
        if state[1] not in ("<", ">", "=", "|") or state != (3, state[1], *_NUMBER_STATE):
            raise pickle.UnpicklingError(
                "an array of numbers with parts, or in no known byte order, is not allowed"
            )
        self.dtype = self.dtype.newbyteorder(state[1])


class _Encoded(NamedTuple):
    """Stands for `_codecs.encode`, by which protocols 0 to 2 write bytes: the text that has them in latin1."""

    text: str
    encoding: str = "latin1"


class _Array:
    """What a pickle says of a `numpy.ndarray`."""

    __slots__ = ("content", "dtype", "order", "shape")

    def __init__(self, *_class_shape_and_code: object) -> None:
        self.content: object = None

    def __setstate__(self, state: Any) -> None:
        """Take down version, shape, dtype, Fortran order and content, as numpy writes them."""
        version, shape, kind, fortran, content = state
        if version != 1 or not isinstance(kind, _Kind):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        self.shape, self.dtype, self.content = shape, kind.dtype, content
        self.order: Literal["C", "F"] = "F" if fortran else "C"


def _from_buffer(content: object, kind: object, shape: Sequence[int], order: str = "C") -> _Array:
    """Stands for `numpy.core.numeric._frombuffer`, by which protocol 5 writes arrays."""
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
_PLAIN: Final = (type(None), bool, int, float, str)


class _Values:
    """Makes the values that a machine noted, up to so many bytes: one may be in many places, or in itself."""

    __slots__ = ("_content", "_room")

    def __init__(self, content: bytes) -> None:
        self._content = memoryview(content)
        self._room = len(content) + _ROOM

    def made(self, value: Any, depth: int = 0) -> Any:
        self._take(_A_VALUE)
        if depth > _DEEPEST:
            raise pickle.UnpicklingError(
                f"more than {_DEEPEST} containers within each other are not allowed"
            )
        kind = type(value)
        if kind is _Array:
            return self._array(value)
        if kind is dict:
            if not all(type(key) is str and key.isprintable() for key in value):
                raise pickle.UnpicklingError(
                    "a key that is no text, or cannot be printed, is not allowed"
                )
            self._take(sum(map(len, value)))
            return {key: self.made(item, depth + 1) for key, item in value.items()}
        if kind is list or kind is tuple:
            return kind([self.made(item, depth + 1) for item in value])
        if kind is slice or kind is _Encoded:
            return bytes(self._bytes(value))
        if kind not in _PLAIN:
            raise pickle.UnpicklingError("a part of numpy in place of a value is not allowed")
        return value

    def _array(self, notes: _Array) -> AnyArray:
        if notes.content is None:
            raise pickle.UnpicklingError("an array without its numbers is not allowed")
        flat: AnyArray = np.frombuffer(self._bytes(notes.content), dtype=notes.dtype)
        array = flat.reshape(notes.shape, order=notes.order)
        if array.shape != notes.shape:  # reshape itself would fill in a negative length
            raise pickle.UnpicklingError(
                "an array whose shape is not what its bytes have is not allowed"
            )
        return array.astype(notes.dtype.newbyteorder("="))

    def _bytes(self, noted: object) -> bytes | memoryview:
        if isinstance(noted, str):  # of Python 2
            noted = _Encoded(noted)
        if isinstance(noted, slice):
            self._take(noted.stop - noted.start)
            return self._content[noted]
        if not isinstance(noted, _Encoded) or not isinstance(noted.text, str):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        if noted.encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("_codecs.encode is allowed for latin1 text only")
        self._take(len(noted.text))
        return noted.text.encode("latin1")

    def _take(self, size: int) -> None:
        self._room -= size
        if self._room < 0:
            raise pickle.UnpicklingError(
                "values that are far larger than their pickle are not allowed"
            )
