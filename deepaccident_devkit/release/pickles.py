"""Pickles that old readers open: Python 3.7 and numpy 1.16 or later.

Protocol 3 names globals in plain text. numpy 2 writes its private path there, which numpy 1 does not have; numpy 2
reads the old one. (`reducer_override` cannot give a function another name: it must lead to that very function.)
"""

import pickle
from collections.abc import Iterable, Mapping
from io import BytesIO
from typing import Any, BinaryIO, Final, cast

import numpy as np

from deepaccident_devkit.arrays import AnyArray

_PROTOCOL: Final = 3
_BEGIN: Final = pickle.PROTO + bytes([_PROTOCOL])
_OLD_NAME: Final = b"cnumpy.core.multiarray\n"
_NEW_NAME: Final = b"cnumpy._core.multiarray\n"


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


def write_joined(file: BinaryIO, name: str, pieces: Iterable[bytes], beside: Mapping[str, object]) -> None:
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
            make, arguments, (version, _, *rest) = cast("tuple[Any, Any, tuple[Any, ...]]", array.__reduce__())
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
