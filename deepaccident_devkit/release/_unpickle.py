"""A restricted unpickler: dicts of numeric numpy arrays, and nothing that a pickle could run.

A pickle is a program. This one may name only what numpy's own array pickles name (numpy 1 and 2, protocols 0 to 5),
and under those names it gets the devkit's stand-ins: they note what the array is made of, import nothing, and keep
no attribute that a pickle tries to set. The arrays are made from those notes afterwards.
"""

import io
import pickle
import re
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np

from deepaccident_devkit.arrays import AnyArray

_PLAIN_NUMBER = re.compile(r"[<>=|]?[fiub][1-9][0-9]?", re.ASCII)
"""The only dtypes allowed: numpy itself would evaluate other strings."""
UNPICKLE_FAULTS = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    ImportError,
    IndexError,
    KeyError,
    MemoryError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
)
"""The errors that damaged or hostile bytes can raise."""


def load_arrays(content: bytes) -> Any:
    """Unpickle a dict of numeric numpy arrays; other plain values stay what they are.

    Raises:
        pickle.UnpicklingError: the pickle names anything else; nothing of it has run.
        Exception: another of `UNPICKLE_FAULTS`, if the bytes are no pickle.
    """
    # latin1 is how arrays pickled by Python 2 are read
    loaded = _RestrictedUnpickler(io.BytesIO(content), encoding="latin1").load()
    if not isinstance(loaded, dict):
        return loaded
    return {key: value.array() if isinstance(value, _ArrayNotes) else value for key, value in loaded.items()}


class _Inert:
    """A stand-in that takes no attributes, so that a pickle's BUILD cannot change it."""

    __slots__ = ()

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise pickle.UnpicklingError(f"a pickle tried to set {name!r}")


class _DtypeNotes:
    """What a pickle says of a `numpy.dtype`: plain numbers only, no objects, no records."""

    __slots__ = ("dtype",)

    def __init__(self, code: object) -> None:
        text = code.decode("ascii") if isinstance(code, bytes) else code
        if not isinstance(text, str) or not _PLAIN_NUMBER.fullmatch(text):
            raise pickle.UnpicklingError(f"an array of {text!r} is not allowed")
        self.dtype: np.dtype[Any] = np.dtype(text)

    def __setstate__(self, state: Sequence[Any]) -> None:
        """Take the byte order from the state that numpy writes."""
        self.dtype = self.dtype.newbyteorder(state[1])


class _ArrayNotes:
    """What a pickle says of a `numpy.ndarray`."""

    __slots__ = ("_content", "_dtype", "_order", "_shape")

    def __setstate__(self, state: Sequence[Any]) -> None:
        """Take down version, shape, dtype, Fortran order and content, as numpy writes them."""
        _version, shape, dtype, fortran, content = state
        if not isinstance(dtype, _DtypeNotes) or not isinstance(content, bytes | bytearray | str):
            raise pickle.UnpicklingError("not the pickle of a plain numpy array")
        self._shape, self._dtype = tuple(shape), dtype.dtype
        self._order = "F" if fortran else "C"
        self._content = content.encode("latin1") if isinstance(content, str) else bytes(content)

    def array(self) -> AnyArray:
        flat = np.frombuffer(self._content, dtype=self._dtype)
        return flat.reshape(self._shape, order=self._order).astype(self._dtype.newbyteorder("="))  # type: ignore[call-overload,no-any-return]


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
        notes = _ArrayNotes()
        notes.__setstate__((1, shape, dtype, order == "F", content))
        return notes


class _Latin1(_Inert):
    """Stands for `_codecs.encode`, by which protocols 0 to 2 write bytes."""

    __slots__ = ()

    def __call__(self, text: object, encoding: object = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError("_codecs.encode is allowed for latin1 text only")
        return text.encode("latin1")


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
