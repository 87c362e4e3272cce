"""The one gate for pickles: it makes plain values, asks a table for all names, and runs nothing of the file.

A pickle is a program for a machine with a stack and a memo. The machine here knows the opcodes of plain values, arrays
and tensors in protocols 0 to 5, and refuses all others, such as those of classes, extensions and buffers. It imports
nothing and sets no attribute; it calls only functions of its caller's table, with values that it has made itself.

It takes time and memory in proportion to the pickle's bytes: no opcode gets more bytes than there are, the memo is a
dict, and what may be a key has a cheap hash. One value may be in many places, or in itself: who walks through the
values needs limits.
"""

import codecs
import pickle
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NoReturn, TypeAlias

from deepaccident_devkit.errors import shortened

# Characters of a number written as text: reading it takes time in proportion to the square of them.
_LONGEST_NUMBER: Final = 32
# Of a call, which copies them; a path has one for each part.
_MOST_ARGUMENTS: Final = 64


class Machine:
    """Reads the pickle that begins at the byte `start`. Bytes in it are slices of the content, since most are large.

    Attributes:
        value: what it holds.
        end: the byte after it.
        slices: of all bytes in it, in their order.
    """

    def __init__(
        self,
        content: bytes,
        names: Mapping[str, object],
        most: int,
        *,
        start: int = 0,
        refer: Callable[[Any], object] | None = None,
    ) -> None:
        """Read it; raises pickle.UnpicklingError, and what wrong values raise, such as TypeError.

        `names`: module and name, with a blank between them → what stands for it; what its call returns gets the
        pickle's state by `__setstate__`, if it has that. `most`: opcodes that it may have. `refer` makes a value from a
        persistent id; None allows none.
        """
        self.value: Any = None
        self.end = self._opcode_at = start
        self.slices: list[slice] = []
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self._content, self._names, self._refer = content, names, refer
        self._below_marks: list[list[Any]] = []
        for _ in range(most):
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
        self.refuse(f"more than {most:,} opcodes are not allowed")

    def refuse(self, fault: str) -> NoReturn:
        raise pickle.UnpicklingError(f"at byte {self._opcode_at:,}: {fault}")

    def take(self, size: int) -> bytes:
        """The next bytes, which must be there."""
        start, self.end = self.end, self.end + size
        if self.end > len(self._content):
            self.refuse("the pickle ends too early")
        return self._content[start : self.end]

    def number(self, width: int) -> int:
        return int.from_bytes(self.take(width), "little")

    def counted(self, width: int) -> bytes:
        """Bytes whose number is in the next ones."""
        return self.take(self.number(width))

    def noted(self, width: int) -> slice:
        size = len(self.counted(width))
        self.slices.append(slice(self.end - size, self.end))
        return self.slices[-1]

    def line(self) -> bytes:
        last = self._content.find(b"\n", self.end)
        return self.take(1 + (last if last >= 0 else len(self._content)) - self.end)[:-1]

    def digits(self) -> str:
        line = self.line()
        if len(line) > _LONGEST_NUMBER:
            self.refuse(f"a number of {len(line):,} characters is not allowed")
        return line.decode("ascii")

    def frame(self) -> None:
        """All is read without frames; the size of one is only compared."""
        if self.number(8) > len(self._content) - self.end:
            self.refuse("the pickle ends too early")

    def mark(self) -> None:
        self._below_marks.append(self.stack)
        self.stack = []

    def items(self, count: int | None = None) -> list[Any]:
        """Take so many values, or those down to the mark."""
        if count is None:
            items, self.stack = self.stack, self._below_marks.pop()
            return items
        return [self.stack.pop() for _ in range(count)][::-1]

    def extend(self, items: list[Any]) -> None:
        list.extend(self.stack[-1], items)

    def fill(self, items: list[Any]) -> None:
        dict.update(self.stack[-1], dict_of(zip(items[::2], items[1::2], strict=True)))

    def filled(self) -> None:
        items = self.items()
        self.stack.append({})
        self.fill(items)

    def put(self, place: int) -> None:
        self.memo[place] = self.stack[-1]

    def get(self, place: int) -> Any:
        if place not in self.memo:
            self.refuse("taking from an empty place in the memo is not allowed")
        return self.memo[place]

    def known(self, name: str) -> object:
        if name not in self._names:
            self.refuse(
                f"the pickle asks for {shortened(name.replace(' ', '.'))}, which is not allowed"
            )
        return self._names[name]

    def referred(self) -> object:
        if self._refer is None:
            self.refuse("a persistent id is not allowed")
        return self._refer(self.stack.pop())

    def called(self) -> object:
        """The result of what the table has for a name; nothing else that can be on the stack is callable."""
        function, arguments = self.items(2)
        if len(arguments) > _MOST_ARGUMENTS:
            self.refuse(f"a call with {len(arguments):,} values is not allowed")
        return function(*arguments)

    def build(self) -> None:
        state = self.stack.pop()
        if hasattr(self.stack[-1], "__setstate__"):  # of other values' attributes nothing is read
            self.stack[-1].__setstate__(state)

    def stop(self) -> None:
        self.value = self.stack.pop()


def dict_of(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """A dict by texts and whole numbers: a tuple's hash can take all time, and many long numbers can have the same."""
    items = list(pairs)
    if not all(type(key) is str or (type(key) is int and abs(key) < 1 << 63) for key, _ in items):
        raise pickle.UnpicklingError(
            "a key that is no text and no whole number of 64 bits is not allowed"
        )
    return dict(items)


def _opcode_name(code: bytes) -> str:
    import pickletools  # for faults alone

    known = {info.code: info.name for info in pickletools.opcodes}.get(code.decode("latin1"))
    return f"the opcode {known}" if known else f"the byte {code[0]:#04x}, which is no opcode,"


def _whole(text: str) -> int:
    return text == "01" if text in ("00", "01") else int(text.removesuffix("L"))


_Step: TypeAlias = Callable[[Machine], object]


def _pushes(value: _Step) -> _Step:
    def step(machine: Machine) -> None:
        pushed = value(machine)  # which may change the stack
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
    pickle.INT: lambda machine: _whole(machine.digits()),
    pickle.LONG: lambda machine: _whole(machine.digits()),
    pickle.FLOAT: lambda machine: float(machine.digits()),
    pickle.BININT1: lambda machine: machine.number(1),
    pickle.BININT2: lambda machine: machine.number(2),
    pickle.BININT: lambda machine: int.from_bytes(machine.take(4), "little", signed=True),
    pickle.LONG1: lambda machine: int.from_bytes(machine.counted(1), "little", signed=True),
    pickle.BINFLOAT: lambda machine: struct.unpack(">d", machine.take(8))[0],
    # text: of Python 2 (read as latin1), and of Python 3
    pickle.STRING: lambda machine: codecs.escape_decode(machine.line()[1:-1])[0].decode("latin1"),
    pickle.SHORT_BINSTRING: lambda machine: machine.counted(1).decode("latin1"),
    pickle.BINSTRING: lambda machine: machine.counted(4).decode("latin1"),
    pickle.UNICODE: lambda machine: machine.line().decode("raw-unicode-escape"),
    pickle.SHORT_BINUNICODE: lambda machine: machine.counted(1).decode("utf-8", "surrogatepass"),
    pickle.BINUNICODE: lambda machine: machine.counted(4).decode("utf-8", "surrogatepass"),
    pickle.SHORT_BINBYTES: lambda machine: machine.noted(1),
    pickle.BINBYTES: lambda machine: machine.noted(4),
    pickle.BYTEARRAY8: lambda machine: machine.noted(8),
    pickle.EMPTY_TUPLE: lambda _: (),
    pickle.TUPLE1: lambda machine: tuple(machine.items(1)),
    pickle.TUPLE2: lambda machine: tuple(machine.items(2)),
    pickle.TUPLE3: lambda machine: tuple(machine.items(3)),
    pickle.TUPLE: lambda machine: tuple(machine.items()),
    pickle.EMPTY_LIST: lambda _: [],
    pickle.LIST: Machine.items,
    pickle.EMPTY_DICT: lambda _: {},
    pickle.GLOBAL: lambda machine: machine.known(
        f"{machine.line().decode()} {machine.line().decode()}"
    ),
    pickle.STACK_GLOBAL: lambda machine: machine.known(" ".join(machine.items(2))),
    pickle.BINPERSID: Machine.referred,
    pickle.REDUCE: Machine.called,
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
    pickle.DICT: Machine.filled,
    pickle.SETITEM: lambda machine: machine.fill(machine.items(2)),
    pickle.SETITEMS: lambda machine: machine.fill(machine.items()),
    pickle.BUILD: Machine.build,
}
