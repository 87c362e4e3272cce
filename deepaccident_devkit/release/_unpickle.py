"""The only reader of pickles: it makes plain values, and runs nothing of the file.

All names come from a table. A pickle is a program for a machine with a stack and a memo. The
machine here knows the opcodes of plain values, arrays and tensors in protocols 0 to 5, and refuses
all others, such as the opcodes of classes, extensions and buffers. It imports nothing and sets no
attribute; it only calls functions of its caller's table, with values that it has made itself.

It takes time and memory in proportion to the pickle's bytes: no opcode reads beyond the end, the
memo is a dictionary, and only values with a cheap hash may be keys. A value may be in many places,
or in itself: code that walks through the values needs limits.
"""

import codecs
import pickle
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NoReturn, TypeAlias

from deepaccident_devkit.errors import shortened

# Reading a number as text takes time in proportion to the square of its length.
_MAX_NUMBER_LENGTH: Final = 32
# A call copies its arguments; a path has one for each part.
_MAX_ARGUMENTS: Final = 64


class Machine:
    """A reader of the pickle that begins at the byte `start`.

    Byte strings in it are slices of the content, since most are large.

    Attributes:
        value: Value of the pickle.
        end: Position of the byte after it.
        slices: Slices of all its byte strings, in their order.
    """

    def __init__(
        self,
        content: bytes,
        names: Mapping[str, object],
        max_opcodes: int,
        *,
        start: int = 0,
        refer: Callable[[Any], object] | None = None,
    ) -> None:
        """Read a pickle.

        Args:
            content: The bytes that hold the pickle.
            names: Module and name, with a blank between them → stand-in; the result of its call
                gets the pickle's state by `__setstate__`, if it has this method.
            max_opcodes: Largest number of opcodes.
            start: Position of the first byte.
            refer: Function from a persistent id to a value; None allows no ids.

        Raises:
            pickle.UnpicklingError: The pickle is not allowed; wrong values raise other errors, such
                as TypeError.
        """
        self.value: Any = None
        self.end = self._opcode_at = start
        self.slices: list[slice] = []
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self._content, self._names, self._refer = content, names, refer
        self._below_marks: list[list[Any]] = []
        for _ in range(max_opcodes):
            self._opcode_at = self.end
            code = self.take(1)
            if code not in _STEPS:
                self.refuse(f"{_opcode_name(code)} is not allowed")
            try:
                _STEPS[code](self)
            except IndexError:
                self.refuse("an opcode without the values that it takes is not allowed")
            if code == pickle.STOP:
                return
        self.refuse(f"more than {max_opcodes:,} opcodes are not allowed")

    def refuse(self, fault: str) -> NoReturn:
        """Raise pickle.UnpicklingError with the position of the opcode."""
        raise pickle.UnpicklingError(f"at byte {self._opcode_at:,}: {fault}")

    def take(self, size: int) -> bytes:
        """Read the next bytes; refuse a pickle that ends before."""
        start, self.end = self.end, self.end + size
        if self.end > len(self._content):
            self.refuse("the pickle ends too early")
        return self._content[start : self.end]

    def number(self, width: int) -> int:
        """Read an unsigned number of `width` bytes."""
        return int.from_bytes(self.take(width), "little")

    def string(self, width: int) -> bytes:
        """Read a length of `width` bytes, and as many bytes."""
        return self.take(self.number(width))

    def string_slice(self, width: int) -> slice:
        """Read a byte string as a slice of the content."""
        size = len(self.string(width))
        self.slices.append(slice(self.end - size, self.end))
        return self.slices[-1]

    def line(self) -> bytes:
        """Read up to the next line end."""
        line_end = self._content.find(b"\n", self.end)
        if line_end < 0:
            line_end = len(self._content)
        return self.take(1 + line_end - self.end)[:-1]

    def digits(self) -> str:
        """Read a line with a number."""
        line = self.line()
        if len(line) > _MAX_NUMBER_LENGTH:
            self.refuse(f"a number of {len(line):,} characters is not allowed")
        return line.decode("ascii")

    def frame(self) -> None:
        """Compare the size of a frame with the content; frames have no other use here."""
        if self.number(8) > len(self._content) - self.end:
            self.refuse("the pickle ends too early")

    def mark(self) -> None:
        """Begin a new stack above the mark."""
        self._below_marks.append(self.stack)
        self.stack = []

    def items(self, count: int | None = None) -> list[Any]:
        """Take `count` values from the stack, or all down to the mark."""
        if count is None:
            items, self.stack = self.stack, self._below_marks.pop()
            return items
        return [self.stack.pop() for _ in range(count)][::-1]

    def extend(self, items: list[Any]) -> None:
        """Append items to the list on the stack."""
        list.extend(self.stack[-1], items)

    def update(self, items: list[Any]) -> None:
        """Add alternating keys and values to the dictionary on the stack."""
        dict.update(self.stack[-1], dict_of(zip(items[::2], items[1::2], strict=True)))

    def push_dict(self) -> None:
        """Push a dictionary of the items down to the mark."""
        items = self.items()
        self.stack.append({})
        self.update(items)

    def put(self, index: int) -> None:
        """Store the value on the stack in the memo."""
        self.memo[index] = self.stack[-1]

    def get(self, index: int) -> Any:
        """Return a value of the memo."""
        if index not in self.memo:
            self.refuse("taking from an empty place in the memo is not allowed")
        return self.memo[index]

    def stand_in(self, name: str) -> object:
        """Return the stand-in for a name."""
        if name not in self._names:
            self.refuse(
                f"the pickle asks for {shortened(name.replace(' ', '.'))}, which is not allowed"
            )
        return self._names[name]

    def persistent_value(self) -> object:
        """Return the value of the persistent id on the stack."""
        if self._refer is None:
            self.refuse("a persistent id is not allowed")
        return self._refer(self.stack.pop())

    def call_result(self) -> object:
        """Return the result of a call of a stand-in; no other value on the stack is callable."""
        function, arguments = self.items(2)
        if len(arguments) > _MAX_ARGUMENTS:
            self.refuse(f"a call with {len(arguments):,} values is not allowed")
        return function(*arguments)

    def build(self) -> None:
        """Set the state of the value on the stack, if it takes one."""
        state = self.stack.pop()
        if hasattr(self.stack[-1], "__setstate__"):  # no other attribute of values is read
            self.stack[-1].__setstate__(state)

    def stop(self) -> None:
        """Take the value of the pickle from the stack."""
        self.value = self.stack.pop()


def dict_of(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return a dictionary with texts and whole numbers as keys.

    The hash of a tuple can take unlimited time, and many long numbers can have the same hash.
    """
    items = list(pairs)
    if not all(type(key) is str or (type(key) is int and abs(key) < 1 << 63) for key, _ in items):
        raise pickle.UnpicklingError(
            "a key that is no text and no whole number of 64 bits is not allowed"
        )
    return dict(items)


def _opcode_name(code: bytes) -> str:
    """Return the name of an opcode for messages."""
    import pickletools  # only needed for faults

    names = {info.code: info.name for info in pickletools.opcodes}
    name = names.get(code.decode("latin1"))
    return f"the opcode {name}" if name else f"the byte {code[0]:#04x}, which is no opcode,"


def _whole_number(text: str) -> int:
    """Return a whole number, or a boolean of protocol 0, from its text."""
    return text == "01" if text in ("00", "01") else int(text.removesuffix("L"))


_Step: TypeAlias = Callable[[Machine], object]


def _pushes(value: _Step) -> _Step:
    """Return the step that pushes a value on the stack."""

    def step(machine: Machine) -> None:
        pushed = value(machine)  # may change the stack, so that it comes first
        machine.stack.append(pushed)

    return step


# opcode → the value that it pushes onto the stack
_PUSHED: Final[Mapping[bytes, _Step]] = {
    pickle.GET: lambda machine: machine.get(int(machine.digits())),
    pickle.BINGET: lambda machine: machine.get(machine.number(1)),
    pickle.LONG_BINGET: lambda machine: machine.get(machine.number(4)),
    pickle.NONE: lambda _: None,
    pickle.NEWTRUE: lambda _: True,
    pickle.NEWFALSE: lambda _: False,
    pickle.INT: lambda machine: _whole_number(machine.digits()),
    pickle.LONG: lambda machine: _whole_number(machine.digits()),
    pickle.FLOAT: lambda machine: float(machine.digits()),
    pickle.BININT1: lambda machine: machine.number(1),
    pickle.BININT2: lambda machine: machine.number(2),
    pickle.BININT: lambda machine: int.from_bytes(machine.take(4), "little", signed=True),
    pickle.LONG1: lambda machine: int.from_bytes(machine.string(1), "little", signed=True),
    pickle.BINFLOAT: lambda machine: struct.unpack(">d", machine.take(8))[0],
    # text: of Python 2 (read as latin1), and of Python 3
    pickle.STRING: lambda machine: codecs.escape_decode(machine.line()[1:-1])[0].decode("latin1"),
    pickle.SHORT_BINSTRING: lambda machine: machine.string(1).decode("latin1"),
    pickle.BINSTRING: lambda machine: machine.string(4).decode("latin1"),
    pickle.UNICODE: lambda machine: machine.line().decode("raw-unicode-escape"),
    pickle.SHORT_BINUNICODE: lambda machine: machine.string(1).decode("utf-8", "surrogatepass"),
    pickle.BINUNICODE: lambda machine: machine.string(4).decode("utf-8", "surrogatepass"),
    pickle.SHORT_BINBYTES: lambda machine: machine.string_slice(1),
    pickle.BINBYTES: lambda machine: machine.string_slice(4),
    pickle.BYTEARRAY8: lambda machine: machine.string_slice(8),
    pickle.EMPTY_TUPLE: lambda _: (),
    pickle.TUPLE1: lambda machine: tuple(machine.items(1)),
    pickle.TUPLE2: lambda machine: tuple(machine.items(2)),
    pickle.TUPLE3: lambda machine: tuple(machine.items(3)),
    pickle.TUPLE: lambda machine: tuple(machine.items()),
    pickle.EMPTY_LIST: lambda _: [],
    pickle.LIST: Machine.items,
    pickle.EMPTY_DICT: lambda _: {},
    pickle.GLOBAL: lambda machine: machine.stand_in(
        f"{machine.line().decode()} {machine.line().decode()}"
    ),
    pickle.STACK_GLOBAL: lambda machine: machine.stand_in(" ".join(machine.items(2))),
    pickle.BINPERSID: Machine.persistent_value,
    pickle.REDUCE: Machine.call_result,
}
_STEPS: Final[Mapping[bytes, _Step]] = {
    **{opcode: _pushes(value) for opcode, value in _PUSHED.items()},
    pickle.PROTO: lambda machine: machine.take(1),
    pickle.FRAME: Machine.frame,
    pickle.STOP: Machine.stop,
    pickle.MARK: Machine.mark,
    pickle.PUT: lambda machine: machine.put(int(machine.digits())),
    pickle.BINPUT: lambda machine: machine.put(machine.number(1)),
    pickle.LONG_BINPUT: lambda machine: machine.put(machine.number(4)),
    pickle.MEMOIZE: lambda machine: machine.put(len(machine.memo)),
    pickle.APPEND: lambda machine: machine.extend(machine.items(1)),
    pickle.APPENDS: lambda machine: machine.extend(machine.items()),
    pickle.DICT: Machine.push_dict,
    pickle.SETITEM: lambda machine: machine.update(machine.items(2)),
    pickle.SETITEMS: lambda machine: machine.update(machine.items()),
    pickle.BUILD: Machine.build,
}
