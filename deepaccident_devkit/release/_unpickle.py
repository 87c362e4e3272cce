"""The only reader of pickles: it creates plain values, and executes nothing in the file.

A pickle is a program for a machine with a stack and a memo. The machine here knows the opcodes of
plain values, arrays and tensors in protocols 0 to 5, and refuses all others, such as the opcodes of
classes, extensions and buffers. It imports nothing and sets no attribute. Names are looked up in
the caller's table; only functions in this table are called, with values that the machine created
itself.

Time and memory are proportional to the pickle's size: no opcode reads beyond the end, the memo is a
dictionary, and only values with a cheap hash may be keys. A value may occur in many places, or
contain itself, so code that walks through the values needs limits.
"""

import codecs
import pickle
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NoReturn, TypeAlias

from deepaccident_devkit.errors import shortened

# Parsing a decimal number takes time proportional to the square of its length.
_MAX_NUMBER_LENGTH = 32
# A call copies its arguments; a path has one argument per part.
_MAX_ARGUMENTS = 64


class Machine:
    """A reader of the pickle that begins at the byte `start`.

    Byte strings are represented by slices of the content, since most are large.

    Attributes:
        value: Value of the pickle.
        end: Position of the first byte after the pickle.
        slices: Slices of all byte strings in the pickle, in order.
        stack: Values on the stack, above the last mark.
        memo: Number → stored value.
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
            names: Module and name, separated by a blank → stand-in. If the result of calling a
                stand-in has a `__setstate__`, this method receives the state in the pickle.
            max_opcodes: Largest number of opcodes.
            start: Position of the first byte.
            refer: Function that maps a persistent id to a value; None refuses such ids.

        Raises:
            pickle.UnpicklingError: If the pickle contains anything that is not allowed; wrong
                values raise other errors, such as TypeError.
        """
        self.value: Any = None
        self.end = start
        self._opcode_position = start
        self.slices: list[slice] = []
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self._content = content
        self._names = names
        self._refer = refer
        self._stacks_below_marks: list[list[Any]] = []
        for _ in range(max_opcodes):
            self._opcode_position = self.end
            code = self.take(1)
            if code not in _STEPS:
                self.refuse(f"{_describe_opcode(code)} is not allowed")
            try:
                _STEPS[code](self)
            except IndexError:
                self.refuse("an opcode without the values that it takes is not allowed")
            if code == pickle.STOP:
                return
        self.refuse(f"more than {max_opcodes:,} opcodes are not allowed")

    def refuse(self, fault: str) -> NoReturn:
        """Raise pickle.UnpicklingError with the position of the opcode."""
        raise pickle.UnpicklingError(f"at byte {self._opcode_position:,}: {fault}")

    def take(self, size: int) -> bytes:
        """Read the next `size` bytes; refuse a pickle that ends earlier."""
        start = self.end
        self.end += size
        if self.end > len(self._content):
            self.refuse("the pickle ends too early")
        return self._content[start : self.end]

    def read_number(self, width: int) -> int:
        """Read an unsigned number of `width` bytes."""
        return int.from_bytes(self.take(width), "little")

    def read_string(self, width: int) -> bytes:
        """Read a length stored in `width` bytes, and then that many bytes."""
        size = self.read_number(width)
        return self.take(size)

    def read_string_slice(self, width: int) -> slice:
        """Read a byte string as a slice of the content."""
        size = len(self.read_string(width))
        byte_slice = slice(self.end - size, self.end)
        self.slices.append(byte_slice)
        return byte_slice

    def read_line(self) -> bytes:
        """Read a line, without its line end."""
        line_end = self._content.find(b"\n", self.end)
        if line_end < 0:
            line_end = len(self._content)
        line = self.take(1 + line_end - self.end)
        return line[:-1]

    def read_digits(self) -> str:
        """Read a line with a number."""
        line = self.read_line()
        if len(line) > _MAX_NUMBER_LENGTH:
            self.refuse(f"a number of {len(line):,} characters is not allowed")
        return line.decode("ascii")

    def check_frame(self) -> None:
        """Refuse a frame that is larger than the content; frames have no other use here."""
        if self.read_number(8) > len(self._content) - self.end:
            self.refuse("the pickle ends too early")

    def push_mark(self) -> None:
        """Start a new stack above a mark."""
        self._stacks_below_marks.append(self.stack)
        self.stack = []

    def pop_items(self, count: int | None = None) -> list[Any]:
        """Pop `count` values from the stack; None pops all down to the mark."""
        if count is None:
            items = self.stack
            self.stack = self._stacks_below_marks.pop()
            return items
        items = [self.stack.pop() for _ in range(count)]
        return items[::-1]

    def extend_list(self, items: list[Any]) -> None:
        """Append items to the list on the stack."""
        list.extend(self.stack[-1], items)

    def update_dict(self, items: list[Any]) -> None:
        """Add alternating keys and values to the dictionary on the stack."""
        pairs = zip(items[::2], items[1::2], strict=True)
        dict.update(self.stack[-1], dict_of(pairs))

    def push_dict(self) -> None:
        """Replace the items down to the mark with a dictionary of them."""
        items = self.pop_items()
        self.stack.append({})
        self.update_dict(items)

    def store_in_memo(self, index: int) -> None:
        """Store the value on the stack in the memo."""
        self.memo[index] = self.stack[-1]

    def load_from_memo(self, index: int) -> Any:
        """Return a value from the memo."""
        if index not in self.memo:
            self.refuse("taking from an empty place in the memo is not allowed")
        return self.memo[index]

    def find_stand_in(self, name: str) -> object:
        """Return the stand-in for a name."""
        if name not in self._names:
            dotted_name = shortened(name.replace(" ", "."))
            self.refuse(f"the pickle asks for {dotted_name}, which is not allowed")
        return self._names[name]

    def pop_persistent_value(self) -> object:
        """Pop a persistent id from the stack, and return its value."""
        if self._refer is None:
            self.refuse("a persistent id is not allowed")
        return self._refer(self.stack.pop())

    def call_stand_in(self) -> object:
        """Call the stand-in on the stack; no other value on the stack is callable."""
        function, arguments = self.pop_items(2)
        if len(arguments) > _MAX_ARGUMENTS:
            self.refuse(f"a call with {len(arguments):,} values is not allowed")
        return function(*arguments)

    def set_state(self) -> None:
        """Set the state of the value on the stack, if it takes one."""
        state = self.stack.pop()
        if hasattr(self.stack[-1], "__setstate__"):  # the only attribute of values that is read
            self.stack[-1].__setstate__(state)

    def stop(self) -> None:
        """Pop the pickle's value from the stack."""
        self.value = self.stack.pop()


def dict_of(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """Make a dictionary; refuse keys other than texts and 64-bit integers.

    The hash of a tuple can take unlimited time, and many long numbers can have the same hash.
    """
    items = list(pairs)
    for key, _ in items:
        is_short_number = type(key) is int and abs(key) < 1 << 63
        if type(key) is not str and not is_short_number:
            raise pickle.UnpicklingError(
                "a key that is neither text nor a whole number of 64 bits is not allowed"
            )
    return dict(items)


def _describe_opcode(code: bytes) -> str:
    """Return the name of an opcode for messages."""
    import pickletools  # only needed for faults

    names = {info.code: info.name for info in pickletools.opcodes}
    name = names.get(code.decode("latin1"))
    if name:
        return f"the opcode {name}"
    return f"the byte {code[0]:#04x}, which is no opcode,"


def _parse_whole_number(text: str) -> int:
    """Parse a whole number, or a boolean of protocol 0."""
    if text in ("00", "01"):
        return text == "01"
    digits = text.removesuffix("L")
    return int(digits)


_Step: TypeAlias = Callable[[Machine], object]


def _make_push_step(read_value: _Step) -> _Step:
    """Return a step that pushes the value of another step onto the stack."""

    def push_value(machine: Machine) -> None:
        value = read_value(machine)  # this may replace the stack, so it comes first
        machine.stack.append(value)

    return push_value


# Opcode → step that returns the value which the opcode pushes onto the stack.
_PUSHED: Mapping[bytes, _Step] = {
    pickle.GET: lambda machine: machine.load_from_memo(int(machine.read_digits())),
    pickle.BINGET: lambda machine: machine.load_from_memo(machine.read_number(1)),
    pickle.LONG_BINGET: lambda machine: machine.load_from_memo(machine.read_number(4)),
    pickle.NONE: lambda _: None,
    pickle.NEWTRUE: lambda _: True,
    pickle.NEWFALSE: lambda _: False,
    pickle.INT: lambda machine: _parse_whole_number(machine.read_digits()),
    pickle.LONG: lambda machine: _parse_whole_number(machine.read_digits()),
    pickle.FLOAT: lambda machine: float(machine.read_digits()),
    pickle.BININT1: lambda machine: machine.read_number(1),
    pickle.BININT2: lambda machine: machine.read_number(2),
    pickle.BININT: lambda machine: int.from_bytes(machine.take(4), "little", signed=True),
    pickle.LONG1: lambda machine: int.from_bytes(machine.read_string(1), "little", signed=True),
    pickle.BINFLOAT: lambda machine: struct.unpack(">d", machine.take(8))[0],
    # text: of Python 2 (read as latin1), and of Python 3
    pickle.STRING: lambda machine: codecs.escape_decode(machine.read_line()[1:-1])[0].decode(
        "latin1"
    ),
    pickle.SHORT_BINSTRING: lambda machine: machine.read_string(1).decode("latin1"),
    pickle.BINSTRING: lambda machine: machine.read_string(4).decode("latin1"),
    pickle.UNICODE: lambda machine: machine.read_line().decode("raw-unicode-escape"),
    pickle.SHORT_BINUNICODE: lambda machine: machine.read_string(1).decode(
        "utf-8", "surrogatepass"
    ),
    pickle.BINUNICODE: lambda machine: machine.read_string(4).decode("utf-8", "surrogatepass"),
    pickle.SHORT_BINBYTES: lambda machine: machine.read_string_slice(1),
    pickle.BINBYTES: lambda machine: machine.read_string_slice(4),
    pickle.BYTEARRAY8: lambda machine: machine.read_string_slice(8),
    pickle.EMPTY_TUPLE: lambda _: (),
    pickle.TUPLE1: lambda machine: tuple(machine.pop_items(1)),
    pickle.TUPLE2: lambda machine: tuple(machine.pop_items(2)),
    pickle.TUPLE3: lambda machine: tuple(machine.pop_items(3)),
    pickle.TUPLE: lambda machine: tuple(machine.pop_items()),
    pickle.EMPTY_LIST: lambda _: [],
    pickle.LIST: Machine.pop_items,
    pickle.EMPTY_DICT: lambda _: {},
    pickle.GLOBAL: lambda machine: machine.find_stand_in(
        f"{machine.read_line().decode()} {machine.read_line().decode()}"
    ),
    pickle.STACK_GLOBAL: lambda machine: machine.find_stand_in(" ".join(machine.pop_items(2))),
    pickle.BINPERSID: Machine.pop_persistent_value,
    pickle.REDUCE: Machine.call_stand_in,
}
_STEPS: Mapping[bytes, _Step] = {
    **{opcode: _make_push_step(value) for opcode, value in _PUSHED.items()},
    pickle.PROTO: lambda machine: machine.take(1),
    pickle.FRAME: Machine.check_frame,
    pickle.STOP: Machine.stop,
    pickle.MARK: Machine.push_mark,
    pickle.PUT: lambda machine: machine.store_in_memo(int(machine.read_digits())),
    pickle.BINPUT: lambda machine: machine.store_in_memo(machine.read_number(1)),
    pickle.LONG_BINPUT: lambda machine: machine.store_in_memo(machine.read_number(4)),
    pickle.MEMOIZE: lambda machine: machine.store_in_memo(len(machine.memo)),
    pickle.APPEND: lambda machine: machine.extend_list(machine.pop_items(1)),
    pickle.APPENDS: lambda machine: machine.extend_list(machine.pop_items()),
    pickle.DICT: Machine.push_dict,
    pickle.SETITEM: lambda machine: machine.update_dict(machine.pop_items(2)),
    pickle.SETITEMS: lambda machine: machine.update_dict(machine.pop_items()),
    pickle.BUILD: Machine.set_state,
}
