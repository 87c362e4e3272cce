"""Checkpoints as `torch.save` writes them, read without PyTorch: what they say of tensors, and the bytes of these.

A checkpoint is a pickle in which a tensor is a view of a storage: an offset, a shape and strides. The storages' bytes
lie beside the pickle, in a zip whose members are not compressed; before PyTorch 1.6 they follow it in one file.

The pickle goes through the gate of all pickles (`_unpickle`), which runs nothing of the file. Who makes tensors adds up
their `size` first, since a view may be larger than its storage.
"""

import math
import pickle
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeAlias

from deepaccident_devkit.release._unpickle import Machine, dict_of
from deepaccident_devkit.support.reading import DAMAGED_ARCHIVE, open_zip, read_member

# What a file that is no checkpoint, a damaged or a hostile one can raise; a Warning where warnings are errors.
FAULTS: Final = (
    pickle.UnpicklingError,
    TypeError,
    AttributeError,
    IndexError,
    Warning,
    *DAMAGED_ARCHIVE,
)
# Kind of numbers, as PyTorch calls it → bytes of one.
NUMBER_BYTES: Final[Mapping[str, int]] = {
    **dict.fromkeys(("float64", "int64"), 8),
    **dict.fromkeys(("float32", "int32"), 4),
    **dict.fromkeys(("float16", "bfloat16", "int16"), 2),
    **dict.fromkeys(("int8", "uint8", "bool"), 1),
}
# How a file begins that is no zip: two pickles, of a number that stands for the format, and of its version.
_OLD: Final = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
# Some 30 are a tensor.
_MOST_OPCODES: Final = 500_000
_MOST_DIMENSIONS: Final = 64
# From a storage's name to its bytes; raises one of `FAULTS`.
Storages: TypeAlias = Callable[[str], bytes | memoryview]


class StoredTensor(NamedTuple):
    """A view of a storage.

    Attributes:
        storage: its name.
        dtype: kind of numbers, one of `NUMBER_BYTES`.
        offset: of the first element, in elements.
        shape: of the tensor, which may be too large for the storage.
        strides: in elements, one for each dimension.
    """

    storage: str
    dtype: str
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    @property
    def size(self) -> int:
        """Bytes that a copy of it takes."""
        return math.prod(self.shape) * NUMBER_BYTES[self.dtype]


def read_checkpoint(content: bytes) -> tuple[object, Storages]:
    """What a checkpoint's pickle holds, with `StoredTensor` in the place of tensors, and the bytes of its storages.

    What trainings note beside tensors (numbers of numpy, paths) is None. Raises one of `FAULTS`.
    """
    if not content.startswith(b"PK"):
        return _of_old_file(content)
    archive = open_zip(content)
    entries = archive.infolist()
    stored = all(each.compress_type == zipfile.ZIP_STORED for each in entries)
    if not stored or sum(each.file_size for each in entries) > len(content):
        raise ValueError("its members are compressed, or larger than the file")
    names = archive.namelist()
    root = next((name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl")), "")

    def member(name: str) -> bytes:
        return read_member(archive, archive.getinfo(f"{root}{name}"), "weights")

    if f"{root}byteorder" in names and member("byteorder") != b"little":
        raise ValueError("its numbers are big-endian")
    return _read(member("data.pkl"), {}).value, lambda name: member(f"data/{name}")


def _of_old_file(content: bytes) -> tuple[object, Storages]:
    if not content.startswith(_OLD):
        raise ValueError("it begins in another way")
    kinds: dict[str, str] = {}
    about = _read(content, kinds, len(_OLD))
    if about.value["little_endian"] is not True:
        raise ValueError("its numbers are big-endian")
    held = _read(content, kinds, about.end)
    names = _read(content, kinds, held.end)
    storages, at = {}, names.end
    for name in names.value:
        if type(name) is not str:
            raise ValueError("a storage whose name is no text is not allowed")
        first = at + 8  # bytes that say how many elements it has
        at = first + int.from_bytes(content[at:first], "little") * NUMBER_BYTES[kinds[name]]
        storages[name] = memoryview(content)[first:at]
    if at != len(content):
        raise ValueError("its storages do not end where the file does")
    return held.value, storages.__getitem__


def _read(content: bytes, kinds: dict[str, str], start: int = 0) -> Machine:
    """The pickle that begins at a byte; the kinds of numbers of its storages are added to `kinds`."""

    def storage(notes: Any) -> StoredTensor:
        what, kind, name, _device, _count, *view = notes
        # first of all types: the hash of a tuple can take all time
        if (
            {type(kind), type(name)} != {str}
            or what != "storage"
            or kind not in NUMBER_BYTES
            or any(view)
        ):
            raise ValueError("a storage of another form is not allowed")
        kinds[name] = kind
        return StoredTensor(name, kind, 0, (), ())

    return Machine(content, _NAMES, _MOST_OPCODES, start=start, refer=storage)


def _ordered(items: list[Any] | None = None) -> dict[Any, Any]:
    """An ordered dict; Python 2 gives its items, which are taken away, since they may be given to many."""
    made = dict_of(items or ())
    if items is not None:
        items.clear()
    return made


def _tensor(
    storage: StoredTensor, offset: Any, shape: Any, strides: Any, *_further: object
) -> StoredTensor:
    if not len(shape) == len(strides) <= _MOST_DIMENSIONS:
        raise ValueError(f"a tensor of more than {_MOST_DIMENSIONS} dimensions is not allowed")
    if not all(type(each) is int and each >= 0 for each in (offset, *shape, *strides)):
        raise ValueError("a tensor whose shape is not of whole numbers is not allowed")
    return storage._replace(offset=offset, shape=tuple(shape), strides=tuple(strides))


# What a pickle may name, and what stands for it.
_NAMES: Final[Mapping[str, object]] = {
    "collections OrderedDict": _ordered,
    **{f"torch._utils _rebuild_{name}": _tensor for name in ("tensor", "tensor_v2")},
    **dict.fromkeys(
        (
            "torch Size",
            "torch._utils _rebuild_parameter",
            "torch._utils _rebuild_parameter_with_state",
        ),
        lambda value, *_: value,
    ),
    **dict.fromkeys(
        (
            *(
                "numpy dtype",
                "numpy ndarray",
                "_codecs encode",
                "torch device",
                "pathlib PosixPath",
            ),
            *(
                f"numpy.{core}.multiarray {name}"
                for core in ("core", "_core")
                for name in ("scalar", "_reconstruct")
            ),
            *(f"torch {kind}" for kind in NUMBER_BYTES),
        ),
        lambda *_: None,
    ),
    "torch DoubleStorage": "float64",
    "torch FloatStorage": "float32",
    "torch HalfStorage": "float16",
    "torch BFloat16Storage": "bfloat16",
    "torch LongStorage": "int64",
    "torch IntStorage": "int32",
    "torch ShortStorage": "int16",
    "torch CharStorage": "int8",
    "torch ByteStorage": "uint8",
    "torch BoolStorage": "bool",
}
