"""Checkpoints as `torch.save` writes them, read without PyTorch: what they say of tensors, and the bytes of these.

A checkpoint is a pickle in which a tensor is a view of a storage: an offset, a shape and strides. The storages' bytes
lie beside the pickle, in a zip whose members are not compressed; before PyTorch 1.6 they follow it in one file.

The pickle is a program for a machine with a stack and a memo. The machine here knows only what tensors in dicts need,
in protocols 2 to 5; it imports and runs nothing of the file, and takes time and memory in proportion to its bytes. Who
makes tensors adds up their `size` first, since a view may be larger than its storage.
"""

import io
import math
import pickletools
import zipfile
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple, TypeAlias

from deepaccident_devkit.archives import DAMAGED_ARCHIVE, open_zip, read_member
from deepaccident_devkit.reading import shortened

FAULTS: Final = (TypeError, AttributeError, IndexError, *DAMAGED_ARCHIVE)
"""What a file that is no checkpoint, a damaged or a hostile one can raise."""
SIZES: Final[Mapping[str, int]] = {
    **dict.fromkeys(("float64", "int64"), 8),
    **dict.fromkeys(("float32", "int32"), 4),
    **dict.fromkeys(("float16", "bfloat16", "int16"), 2),
    **dict.fromkeys(("int8", "uint8", "bool"), 1),
}
"""Kind of numbers, as PyTorch calls it → bytes of one."""
_OLD: Final = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
"""How a file begins that is no zip: two pickles, of a number that stands for the format, and of its version."""
_MOST_PICKLE: Final = 64 << 20
"""Bytes of a pickle."""
_MOST_OPCODES: Final = 500_000
"""Some 30 are a tensor."""
_MOST_DIMENSIONS: Final = 64
_MOST_ARGUMENTS: Final = 64
"""Of a call; a path has one for each part."""
Storages: TypeAlias = Callable[[str], bytes | memoryview]
"""From a storage's name to its bytes; raises one of `FAULTS`."""


class StoredTensor(NamedTuple):
    """A view of a storage.

    Attributes:
        storage: its name.
        dtype: kind of numbers, one of `SIZES`.
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
        return math.prod(self.shape) * SIZES[self.dtype]


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
    return _Machine(member("data.pkl")).value, lambda name: member(f"data/{name}")


def _of_old_file(content: bytes) -> tuple[object, Storages]:
    if not content.startswith(_OLD):
        raise ValueError("it begins in another way")
    about = _Machine(content, len(_OLD))
    if about.value["little_endian"] is not True:
        raise ValueError("its numbers are big-endian")
    held = _Machine(content, about.end)
    names = _Machine(content, held.end)
    storages, at = {}, names.end
    for name in names.value:
        first = at + 8  # bytes that say how many elements it has
        at = first + int.from_bytes(content[at:first], "little") * SIZES[held.kinds[name]]
        storages[name] = memoryview(content)[first:at]
    if at != len(content):
        raise ValueError("its storages do not end where the file does")
    return held.value, storages.__getitem__


class _Machine:
    """Reads the pickle that begins at a byte.

    Attributes:
        value: what it holds.
        kinds: storage → kind of its numbers.
        end: the byte after it.
    """

    def __init__(self, content: bytes, start: int = 0) -> None:
        self.kinds: dict[str, str] = {}
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self._below_marks: list[list[Any]] = []
        file = io.BytesIO(content[start : start + _MOST_PICKLE])
        for count, (opcode, argument, _) in enumerate(pickletools.genops(file)):
            if opcode.name not in _STEPS or count == _MOST_OPCODES:
                raise ValueError(f"the opcode {opcode.name}, number {count:,}, is not allowed")
            _STEPS[opcode.name](self, argument)
        self.value: Any = self.stack.pop()
        self.end = start + file.tell()

    def push(self, value: object) -> None:
        self.stack.append(value)

    def mark(self) -> None:
        self._below_marks.append(self.stack)
        self.stack = []

    def items(self, count: int | None = None) -> list[Any]:
        """Take so many values, or those down to the mark."""
        if count is None:
            items, self.stack = self.stack, self._below_marks.pop()
            return items
        return [self.stack.pop() for _ in range(count)][::-1]

    def append(self, items: list[Any]) -> None:
        list.extend(self.stack[-1], items)

    def fill(self, items: list[Any]) -> None:
        dict.update(self.stack[-1], _named(zip(items[::2], items[1::2], strict=True)))

    def storage(self) -> None:
        what, kind, name, _device, _count, *view = self.stack.pop()
        if what != "storage" or kind not in SIZES or any(view):
            raise ValueError("a storage of another form is not allowed")
        self.kinds[name] = kind
        self.stack.append(StoredTensor(name, kind, 0, (), ()))

    def call(self) -> None:
        function, arguments = self.items(2)
        if len(arguments) > _MOST_ARGUMENTS:  # which are copied, as often as the file calls
            raise ValueError(f"a call with {len(arguments):,} values is not allowed")
        self.stack.append(function(*arguments))


def _named(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """A dict by texts and whole numbers: a tuple's hash can take all time, and many long numbers can have the same."""
    items = list(pairs)
    if not all(type(name) is str or (type(name) is int and abs(name) < 1 << 63) for name, _ in items):
        raise ValueError("a name that is no text and no whole number is not allowed")
    return dict(items)


def _ordered(items: list[Any] | None = None) -> dict[Any, Any]:
    """An ordered dict; Python 2 gives its items, which are taken away, since they may be given to many."""
    made = _named(items or ())
    if items is not None:
        items.clear()
    return made


def _tensor(storage: StoredTensor, offset: Any, shape: Any, strides: Any, *_further: object) -> StoredTensor:
    if not len(shape) == len(strides) <= _MOST_DIMENSIONS:
        raise ValueError(f"a tensor of more than {_MOST_DIMENSIONS} dimensions is not allowed")
    if not all(type(each) is int and each >= 0 for each in (offset, *shape, *strides)):
        raise ValueError("a tensor whose shape is not of whole numbers is not allowed")
    return storage._replace(offset=offset, shape=tuple(shape), strides=tuple(strides))


def _known(name: str) -> object:
    if name not in _NAMES:
        raise ValueError(f"it asks for {shortened(name)!r}, which is not allowed")
    return _NAMES[name]


_NAMES: Final[Mapping[str, object]] = {
    "collections OrderedDict": _ordered,
    **{f"torch._utils _rebuild_{name}": _tensor for name in ("tensor", "tensor_v2")},
    **dict.fromkeys(
        ("torch Size", "torch._utils _rebuild_parameter", "torch._utils _rebuild_parameter_with_state"),
        lambda value, *_: value,
    ),
    **dict.fromkeys(
        (
            *("numpy dtype", "numpy ndarray", "_codecs encode", "torch device", "pathlib PosixPath"),
            *(f"numpy.{core}.multiarray {name}" for core in ("core", "_core") for name in ("scalar", "_reconstruct")),
            *(f"torch {kind}" for kind in SIZES),
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
"""What a pickle may name, and what stands for it."""
_PLAIN: Final = (
    *("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "NONE", "SHORT_BINSTRING", "BINSTRING"),
    *("SHORT_BINUNICODE", "BINUNICODE", "SHORT_BINBYTES", "BINBYTES"),
)
_Step: TypeAlias = Callable[[_Machine, Any], object]
_STEPS: Final[Mapping[str, _Step]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda *_: None),
    **dict.fromkeys(_PLAIN, lambda machine, value: machine.push(value)),
    "NEWTRUE": lambda machine, _: machine.stack.append(True),
    "NEWFALSE": lambda machine, _: machine.stack.append(False),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "MARK": lambda machine, _: machine.mark(),
    "TUPLE1": lambda machine, _: machine.push(tuple(machine.items(1))),
    "TUPLE2": lambda machine, _: machine.push(tuple(machine.items(2))),
    "TUPLE3": lambda machine, _: machine.push(tuple(machine.items(3))),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.items())),
    "APPEND": lambda machine, _: machine.append(machine.items(1)),
    "APPENDS": lambda machine, _: machine.append(machine.items()),
    "SETITEM": lambda machine, _: machine.fill(machine.items(2)),
    "SETITEMS": lambda machine, _: machine.fill(machine.items()),
    **dict.fromkeys(("BINPUT", "LONG_BINPUT"), lambda machine, place: machine.memo.update({place: machine.stack[-1]})),
    "MEMOIZE": lambda machine, _: machine.memo.update({len(machine.memo): machine.stack[-1]}),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), lambda machine, place: machine.push(machine.memo[place])),
    "GLOBAL": lambda machine, name: machine.push(_known(name)),
    "STACK_GLOBAL": lambda machine, _: machine.push(_known(" ".join(machine.items(2)))),
    "BINPERSID": lambda machine, _: machine.storage(),
    "REDUCE": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.stack.pop(),  # of attributes nothing is read
}
"""What each opcode does."""
