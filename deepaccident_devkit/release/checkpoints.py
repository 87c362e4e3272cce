"""Checkpoints of `torch.save`, read without PyTorch: descriptions of tensors, and their bytes.

A checkpoint is a pickle in which a tensor is a view of a storage: an offset, a shape and strides.
The storages' bytes are separate, uncompressed members of the same zip archive; before PyTorch 1.6
they followed the pickle in one file.

The pickle is read by `_unpickle`, which executes nothing in the file. Callers should add up the
`size` of all tensors before they create any, because a view may be larger than its storage.
"""

import math
import pickle
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeAlias

from deepaccident_devkit.release._unpickle import Machine, dict_of
from deepaccident_devkit.support.reading import DAMAGED_ARCHIVE, open_zip, read_member

# Errors for a file that is damaged, hostile or not a checkpoint (Warning: if warnings are errors).
FAULTS: Final = (
    pickle.UnpicklingError,
    TypeError,
    AttributeError,
    IndexError,
    Warning,
    *DAMAGED_ARCHIVE,
)
# PyTorch's name of a number type → bytes per number.
NUMBER_BYTES: Final[Mapping[str, int]] = {
    **dict.fromkeys(("float64", "int64"), 8),
    **dict.fromkeys(("float32", "int32"), 4),
    **dict.fromkeys(("float16", "bfloat16", "int16"), 2),
    **dict.fromkeys(("int8", "uint8", "bool"), 1),
}
# First bytes of a file that is not a zip: the pickles of a magic number and of a version.
_OLD_SIGNATURE = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
# A tensor has about 30 opcodes.
_MAX_OPCODES = 500_000
_MAX_DIMENSIONS = 64
# Function from a storage's name to its bytes; raises one of `FAULTS`.
Storages: TypeAlias = Callable[[str], bytes | memoryview]


class StoredTensor(NamedTuple):
    """A view of a storage.

    Attributes:
        storage: Name of the storage.
        dtype: Type of the numbers, one of `NUMBER_BYTES`.
        offset: Position of the first element, in elements.
        shape: Shape of the tensor, which may be too large for the storage.
        strides: Strides of all dimensions, in elements.
    """

    storage: str
    dtype: str
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    @property
    def size(self) -> int:
        """Size of a copy of the tensor, bytes."""
        num_elements = math.prod(self.shape)
        return num_elements * NUMBER_BYTES[self.dtype]


def read_checkpoint(content: bytes) -> tuple[object, Storages]:
    """Return the value of a checkpoint's pickle, and a function that returns its storages' bytes.

    The value has a `StoredTensor` for each tensor, and None for other objects that trainings save
    (numpy scalars, paths). One of `FAULTS` is raised if the file is not a valid checkpoint.
    """
    if not content.startswith(b"PK"):
        return _read_old_file(content)
    archive = open_zip(content)
    entries = archive.infolist()
    are_stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
    if not are_stored or sum(entry.file_size for entry in entries) > len(content):
        raise ValueError("its members are compressed, or larger than the file")
    names = archive.namelist()
    root = ""
    for name in names:
        if name.endswith("/data.pkl"):
            root = name.removesuffix("data.pkl")
            break

    def read_file(name: str) -> bytes:
        entry = archive.getinfo(f"{root}{name}")
        return read_member(archive, entry, "weights")

    if f"{root}byteorder" in names and read_file("byteorder") != b"little":
        raise ValueError("its numbers are big-endian")
    value = _read_pickle(read_file("data.pkl"), {}).value
    return value, lambda name: read_file(f"data/{name}")


def _read_old_file(content: bytes) -> tuple[object, Storages]:
    """Read a file from before PyTorch 1.6, like `read_checkpoint`."""
    if not content.startswith(_OLD_SIGNATURE):
        raise ValueError("it does not begin like a checkpoint")
    dtypes: dict[str, str] = {}
    system = _read_pickle(content, dtypes, len(_OLD_SIGNATURE))
    if system.value["little_endian"] is not True:
        raise ValueError("its numbers are big-endian")
    checkpoint = _read_pickle(content, dtypes, system.end)
    names = _read_pickle(content, dtypes, checkpoint.end)
    storages = {}
    end = names.end
    for name in names.value:
        if type(name) is not str:
            raise ValueError("a storage whose name is not text is not allowed")
        start = end + 8  # after the number of elements
        num_elements = int.from_bytes(content[end:start], "little")
        end = start + num_elements * NUMBER_BYTES[dtypes[name]]
        storages[name] = memoryview(content)[start:end]
    if end != len(content):
        raise ValueError("its tensors do not end at the end of the file")
    return checkpoint.value, storages.__getitem__


def _read_pickle(content: bytes, dtypes: dict[str, str], start: int = 0) -> Machine:
    """Read the pickle that begins at byte `start`, and add its storages' types to `dtypes`."""

    def make_storage(persistent_id: Any) -> StoredTensor:
        form, dtype, name, _device, _count, *view = persistent_id
        # Types are checked first: the hash of a tuple can take unlimited time.
        is_text = {type(dtype), type(name)} == {str}
        if not is_text or form != "storage" or dtype not in NUMBER_BYTES or any(view):
            raise ValueError("a storage of another form is not allowed")
        dtypes[name] = dtype
        return StoredTensor(name, dtype, 0, (), ())

    return Machine(content, _NAMES, _MAX_OPCODES, start=start, refer=make_storage)


def _make_ordered_dict(items: list[Any] | None = None) -> dict[Any, Any]:
    """Make an ordered dictionary from the items that Python 2 passes, or an empty one.

    The list of items is emptied, because a pickle may pass it many times.
    """
    result = dict_of(items or ())
    if items is not None:
        items.clear()
    return result


def _make_tensor(
    storage: StoredTensor, offset: Any, shape: Any, strides: Any, *_unused: object
) -> StoredTensor:
    """Return a view of a storage."""
    if not len(shape) == len(strides) <= _MAX_DIMENSIONS:
        raise ValueError(f"a tensor of more than {_MAX_DIMENSIONS} dimensions is not allowed")
    for number in (offset, *shape, *strides):
        if type(number) is not int or number < 0:
            raise ValueError("a tensor whose shape has a number that is not whole is not allowed")
    return storage._replace(offset=offset, shape=tuple(shape), strides=tuple(strides))


# Names in NumPy and other modules that trainings save along with tensors.
_IGNORED_NAMES = (
    "numpy dtype",
    "numpy ndarray",
    "_codecs encode",
    "torch device",
    "pathlib PosixPath",
    "numpy.core.multiarray scalar",
    "numpy.core.multiarray _reconstruct",
    "numpy._core.multiarray scalar",
    "numpy._core.multiarray _reconstruct",
    *(f"torch {dtype}" for dtype in NUMBER_BYTES),
)
# Name that a pickle may contain → its stand-in.
_NAMES: Mapping[str, object] = {
    "collections OrderedDict": _make_ordered_dict,
    **{f"torch._utils _rebuild_{name}": _make_tensor for name in ("tensor", "tensor_v2")},
    **dict.fromkeys(
        (
            "torch Size",
            "torch._utils _rebuild_parameter",
            "torch._utils _rebuild_parameter_with_state",
        ),
        lambda value, *_: value,
    ),
    **dict.fromkeys(_IGNORED_NAMES, lambda *_: None),
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
