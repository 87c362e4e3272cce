"""A restricted unpickler: dicts of numeric numpy arrays, and nothing that a pickle could run.

A pickle is a program. This one may name only what numpy's own array pickles name (numpy 1 and 2, protocols 0 to 5),
and under those names it gets the devkit's stand-ins: they note what the array is made of, import nothing, and keep
no attribute that a pickle tries to set. The arrays are made from those notes afterwards. Before all this,
`check_pickle` refuses what would take more time and memory than its bytes explain.
"""

import io
import pickle
import re
from collections.abc import Sequence
from typing import Any, ClassVar, Final, Literal, NoReturn

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.reading import fault_text, shortened
from deepaccident_devkit.release._pickle_scan import check_pickle

_PLAIN_NUMBER = re.compile(r"[<>=|]?[fiub][1-9][0-9]?", re.ASCII)
"""The only dtypes allowed: numpy itself would evaluate other strings."""
_NUMBER_STATE: Final = (None, None, None, -1, -1, 0)
"""What numpy's pickles of a number's dtype say after version and byte order: no fields, no size of its own."""
_LONGEST_SENTENCE: Final = 200
_ROOM: Final = 1 << 20
"""Bytes that arrays may have beyond those of the pickle: a pickle may hold an array twice and store it once."""
_FAULTS = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    MemoryError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
    Warning,  # where warnings are errors
)
"""The errors that damaged or hostile bytes can raise."""


def load_arrays(content: bytes) -> Any:
    """Unpickle a dict of numeric numpy arrays; other plain values stay what they are.

    Raises:
        pickle.UnpicklingError: the bytes are no pickle, or one that names, nests or repeats what such a dict does not
            need (`check_pickle`); nothing of it has run.
    """
    try:
        check_pickle(content)
        # As one frame it is read at once, and no frame of its own can move the reader to a byte that was not checked.
        framed = b"".join((pickle.FRAME, len(content).to_bytes(8, "little"), content))
        # latin1 is how arrays pickled by Python 2 are read
        loaded = _RestrictedUnpickler(io.BytesIO(framed), encoding="latin1").load()
        return _Values(len(content) + _ROOM).made(loaded)
    except _FAULTS as error:
        raise pickle.UnpicklingError(_sentence(error)) from error


def _sentence(error: Exception) -> str:
    """What an error says; a pickle's own text may be long, and may be no text for a screen."""
    text = shortened(fault_text(error), _LONGEST_SENTENCE)
    return text if text.isprintable() else ascii(text)[1:-1]


class _Values:
    """Makes the values from the notes, up to so many bytes: notes may be there many times."""

    __slots__ = ("_room",)

    def __init__(self, room: int) -> None:
        self._room = room

    def made(self, value: Any) -> Any:
        kind = type(value)
        if kind is _ArrayNotes or kind is _Latin1Notes:
            self._room -= len(value)
            if self._room < 0:
                raise pickle.UnpicklingError("arrays that are far larger than their pickle are not allowed")
            return value.made()
        if kind is dict:
            if not all(map(str.isprintable, value)):
                raise pickle.UnpicklingError("a key that cannot be printed is not allowed")
            return {key: self.made(item) for key, item in value.items()}
        if kind is list or kind is tuple:
            return kind(map(self.made, value))
        if isinstance(value, _Inert | _DtypeNotes):
            raise pickle.UnpicklingError("a part of numpy in place of a value is not allowed")
        return value


class _Inert:
    """A stand-in that takes no attributes, so that a pickle's BUILD cannot change it."""

    __slots__ = ()

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise pickle.UnpicklingError("setting an attribute is not allowed")


class _Latin1Notes:
    """Bytes, noted as the text that has them in latin1."""

    __slots__ = ("_text",)

    def __init__(self, text: str) -> None:
        self._text = text

    def __setstate__(self, state: object) -> NoReturn:
        raise pickle.UnpicklingError("bytes that change are not allowed")

    def __len__(self) -> int:
        return len(self._text)

    def made(self) -> bytes:
        return self._text.encode("latin1")


class _DtypeNotes:
    """What a pickle says of a `numpy.dtype`: plain numbers only, no objects, no records."""

    __slots__ = ("dtype",)

    def __init__(self, code: object) -> None:
        if not isinstance(code, str) or not _PLAIN_NUMBER.fullmatch(code):
            found = repr(code) if isinstance(code, str) else "what is no text"
            raise pickle.UnpicklingError(f"an array of {found} is not allowed")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Sequence[Any]) -> None:
        """Take the byte order from the state that numpy writes."""
        if state[1] not in ("<", ">", "=", "|") or state != (3, state[1], *_NUMBER_STATE):
            raise pickle.UnpicklingError("an array of numbers with parts, or in no known byte order, is not allowed")
        self.dtype = self.dtype.newbyteorder(state[1])


class _ArrayNotes:
    """What a pickle says of a `numpy.ndarray`."""

    __slots__ = ("_content", "_dtype", "_order", "_shape")

    def __init__(self) -> None:
        self._content: bytes | bytearray | _Latin1Notes | None = None

    def __setstate__(self, state: Sequence[Any]) -> None:
        """Take down version, shape, dtype, Fortran order and content, as numpy writes them."""
        version, shape, dtype, fortran, content = state
        if isinstance(content, str):  # of Python 2
            content = _Latin1Notes(content)
        plain = isinstance(dtype, _DtypeNotes) and isinstance(content, bytes | bytearray | _Latin1Notes)
        if not plain or version != 1:
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        self._shape, self._dtype, self._content = shape, dtype.dtype, content
        self._order: Literal["C", "F"] = "F" if fortran else "C"

    def __len__(self) -> int:
        if self._content is None:
            raise pickle.UnpicklingError("an array without its numbers is not allowed")
        return len(self._content)

    def made(self) -> AnyArray:
        content = self._content.made() if isinstance(self._content, _Latin1Notes) else self._content
        flat: AnyArray = np.frombuffer(content or b"", dtype=self._dtype)
        array = flat.reshape(self._shape, order=self._order)
        if array.shape != self._shape:  # reshape itself would fill in a negative length
            raise pickle.UnpicklingError("an array whose shape is not what its bytes have is not allowed")
        return array.astype(self._dtype.newbyteorder("="))


class _NdarrayType(_Inert):
    """Stands for the class `numpy.ndarray`; cannot be called."""

    __slots__ = ()


_NDARRAY = _NdarrayType()


class _Dtype(_Inert):
    """Stands for `numpy.dtype`."""

    __slots__ = ()

    def __call__(self, code: object, *_flags: object) -> _DtypeNotes:
        return _DtypeNotes(code)


class _Reconstruct(_Inert):
    """Stands for `numpy.core.multiarray._reconstruct`: the empty array that the pickle then fills."""

    __slots__ = ()

    def __call__(self, subtype: object, _shape: object, _code: object) -> _ArrayNotes:
        if subtype is not _NDARRAY:
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        return _ArrayNotes()


class _FromBuffer(_Inert):
    """Stands for `numpy.core.numeric._frombuffer`, by which protocol 5 writes arrays."""

    __slots__ = ()

    def __call__(self, content: Any, dtype: object, shape: Sequence[int], order: str = "C") -> _ArrayNotes:
        if order not in ("C", "F"):
            raise pickle.UnpicklingError("an array of another order than C or F is not allowed")
        notes = _ArrayNotes()
        notes.__setstate__((1, shape, dtype, order == "F", content))
        return notes


class _Latin1(_Inert):
    """Stands for `_codecs.encode`, by which protocols 0 to 2 write bytes."""

    __slots__ = ()

    def __call__(self, text: object, encoding: object = "latin1") -> _Latin1Notes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("_codecs.encode is allowed for latin1 text only")
        return _Latin1Notes(text)


def _stand_ins() -> dict[tuple[str, str], _Inert]:
    names: dict[tuple[str, str], _Inert] = {
        ("numpy", "ndarray"): _NDARRAY,
        ("numpy", "dtype"): _Dtype(),
        ("_codecs", "encode"): _Latin1(),
    }
    for core in ("numpy.core", "numpy._core"):  # numpy 1, numpy 2
        names[f"{core}.multiarray", "_reconstruct"] = _Reconstruct()
        names[f"{core}.numeric", "_frombuffer"] = _FromBuffer()
    return names


class _RestrictedUnpickler(pickle.Unpickler):
    """Resolves names to the stand-ins alone; imports nothing."""

    allowed: ClassVar[dict[tuple[str, str], _Inert]] = _stand_ins()

    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in, or refuse."""
        try:
            return self.allowed[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}, which is not allowed") from None
