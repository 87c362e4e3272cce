"""What a pickle would make, found from its opcodes before anything of it is made.

A pickle is a program for a machine with a stack and a memo. Here that machine runs on kinds of values alone (text,
tuple, array), and refuses what pickles of plain values and numeric arrays never do in protocols 0 to 5. What passes
takes time and memory in proportion to its bytes: containers are used once, so they form a tree of limited depth; keys
are text; the memo has no more places than there may be opcodes.
"""

import pickle
from collections.abc import Callable, Mapping
from typing import Final, NoReturn, TypeAlias

_MOST_OPCODES: Final = 10_000
"""A calib file has 263 to 543."""
_DEEPEST: Final = 20
"""Containers within each other; an array's pickle has 2."""
_LONGEST_NUMBER: Final = 32
"""Characters of a number written as text: reading it takes time in proportion to the square of them."""
_LONG: Final = 32
"""Bytes of a text that is taken for an array's contents, not for a name."""
_MOST_LAYOUTS: Final = 16
"""Layouts that are remembered."""

_PLAIN, _TEXT, _BYTES, _NAME, _MADE, _TUPLE, _LIST, _DICT = range(8)
"""The kinds of values. To a container's kind its depth is added, times `_DEPTH`."""
_DEPTH: Final = 8
_WORDS: Final = ("a number", "text", "bytes", "a global", "an array", "a tuple", "a list", "a dict")


class _Layout:
    """A checked pickle but its long texts and bytes, which decide nothing: what else is the same needs no check.

    The calib files of a release have few layouts: they differ in what is in their arrays.
    """

    __slots__ = ("_end", "_parts")

    def __init__(self, content: bytes, contents: list[tuple[int, int, int]]) -> None:
        self._parts = []
        at = 0
        for start, width, end in contents:
            self._parts.append((content[at:start], start - at, width))
            at = end
        self._end = content[at:]

    def fits(self, content: bytes) -> bool:
        at = 0
        for part, size, width in self._parts:
            if not content.startswith(part, at):
                return False
            at += size
            if width:
                at += width + int.from_bytes(content[at : at + width], "little")
            else:
                at = content.find(b"\n", at) + 1 or len(content)
        return content[at:] == self._end


_checked: list[_Layout] = []
"""The latest first."""


def check_pickle(content: bytes) -> None:
    """Refuse a pickle that does anything but make plain values and arrays, or too much of that.

    Raises:
        pickle.UnpicklingError: what was found, and at which byte.
    """
    for layout in _checked:
        if layout.fits(content):
            return
    scan = _Scan(content)
    scan.run()
    if scan.contents:
        _checked[:] = [_Layout(content, scan.contents), *_checked[: _MOST_LAYOUTS - 1]]


class _Scan:
    """The machine, with kinds of values on its stack and in its memo."""

    def __init__(self, content: bytes) -> None:
        self.contents: list[tuple[int, int, int]] = []
        """Long texts and bytes: where they begin, the width of their size, 0 for a line, and where they end."""
        self.stack: list[int] = []
        self._content = content
        self._opcode_at = 0
        self._at = 0
        self._below_marks: list[list[int]] = []
        self._memo: dict[int, int] = {}

    def run(self) -> None:
        """Check all opcodes up to the one that stops."""
        for _ in range(_MOST_OPCODES):
            self._opcode_at = self._at
            self.skip(1)
            code = self._content[self._opcode_at]
            step = _STEPS.get(code)
            if step is None:
                self.refuse(f"{_opcode_name(code)} is not allowed")
            try:
                step(self)
            except IndexError:
                self.refuse("an opcode without the values that it takes is not allowed")
            if code == pickle.STOP[0]:
                return
        self.refuse(f"more than {_MOST_OPCODES:,} opcodes are not allowed")

    def refuse(self, fault: str) -> NoReturn:
        raise pickle.UnpicklingError(f"at byte {self._opcode_at:,}: {fault}")

    def skip(self, size: int) -> int:
        """Go on by so many bytes, which must be there; return where they begin."""
        start, self._at = self._at, self._at + size
        if self._at > len(self._content):
            self.refuse("the pickle ends too early")
        return start

    def number(self, width: int) -> int:
        """The number in the next bytes."""
        start = self.skip(width)
        return int.from_bytes(self._content[start : self._at], "little")

    def line(self) -> bytes:
        """The bytes up to the next line end."""
        end = self._content.find(b"\n", self._at)
        start = self.skip(end + 1 - self._at if end >= 0 else len(self._content))
        return self._content[start:end]

    def counted(self, width: int) -> None:
        """Go past text or bytes whose size is in the next bytes."""
        start = self._at
        size = self.number(width)
        self.skip(size)
        if size >= _LONG:
            self.contents.append((start, width, self._at))

    def text_line(self) -> None:
        start = self._at
        if len(self.line()) >= _LONG:
            self.contents.append((start, 0, self._at))

    def pop(self, kind: int) -> int:
        """Take the value on top, which must be of this kind."""
        value = self.stack.pop()
        if value % _DEPTH != kind:
            self.refuse(f"{_WORDS[value % _DEPTH]} in place of {_WORDS[kind]} is not allowed")
        return value

    def mark(self) -> None:
        self._below_marks.append(self.stack)
        self.stack = []

    def pop_many(self, count: int) -> list[int]:
        return [self.stack.pop() for _ in range(count)][::-1]

    def pop_to_mark(self) -> list[int]:
        items, self.stack = self.stack, self._below_marks.pop()
        return items

    def push_container(self, kind: int, items: list[int]) -> None:
        depth = 1 + max(items, default=0) // _DEPTH
        if depth > _DEEPEST:
            self.refuse(f"more than {_DEEPEST} containers within each other are not allowed")
        self.stack.append(kind + depth * _DEPTH)

    def extend(self, kind: int, items: list[int]) -> None:
        """Put values into the list on top, or keys and values in turn into the dict on top."""
        before = self.pop(kind)
        if kind == _DICT:
            if len(items) % 2:
                self.refuse("a key without a value is not allowed")
            for key in items[::2]:
                if key != _TEXT:  # a tuple's hash can take all time, and all of the interpreter's stack
                    self.refuse(f"{_WORDS[key % _DEPTH]} as a key is not allowed")
        self.push_container(kind, items)
        self.stack[-1] = max(self.stack[-1], before)

    def put(self, place: int) -> None:
        if place >= _MOST_OPCODES:  # the memo is a list with so many places
            self.refuse(f"a place in the memo above {_MOST_OPCODES:,} is not allowed")
        self._memo[place] = self.stack[-1]

    def memoize(self) -> None:
        self.put(len(self._memo))

    def get(self, place: int) -> None:
        value = self._memo.get(place)
        if value is None:
            self.refuse("taking from an empty place in the memo is not allowed")
        if value >= _DEPTH:  # what contains the same twice, again and again, doubles each time
            self.refuse(f"using {_WORDS[value % _DEPTH]} twice is not allowed")
        self.stack.append(value)

    def number_in_text(self) -> bytes:
        line = self.line()
        if len(line) > _LONGEST_NUMBER:
            self.refuse(f"a number of {len(line):,} characters is not allowed")
        return line

    def place_in_text(self) -> int:
        line = self.number_in_text()
        if not line.isdigit():
            self.refuse("a place in the memo that is no number is not allowed")
        return int(line)

    def call(self) -> None:
        self.pop(_TUPLE)
        self.stack.pop()  # the unpickler says what may be called
        self.stack.append(_MADE)

    def build(self) -> None:
        self.pop(_TUPLE)
        self.stack.append(self.pop(_MADE))


_Step: TypeAlias = Callable[[_Scan], object]


def _opcode_name(code: int) -> str:
    import pickletools  # for faults alone

    known = {ord(info.code): info.name for info in pickletools.opcodes}.get(code)
    return f"the opcode {known}" if known else f"the byte {code:#04x}, which is no opcode,"


def _pushes(kind: int, argument: Callable[[_Scan], object] = lambda _: None) -> _Step:
    """A step that reads an argument and puts a value on the stack."""

    def step(scan: _Scan) -> None:
        argument(scan)
        scan.stack.append(kind)

    return step


def _dict_from_mark(scan: _Scan) -> None:
    items = scan.pop_to_mark()
    scan.push_container(_DICT, [])
    scan.extend(_DICT, items)


def _global_from_stack(scan: _Scan) -> None:
    scan.pop(_TEXT)
    scan.pop(_TEXT)
    scan.stack.append(_NAME)


_STEPS: Final[Mapping[int, _Step]] = {
    opcode[0]: step
    for opcode, step in {
        pickle.PROTO: lambda scan: scan.skip(1),
        pickle.FRAME: lambda scan: scan.skip(8),
        pickle.STOP: lambda scan: scan.stack.pop(),
        pickle.MARK: _Scan.mark,
        pickle.PUT: lambda scan: scan.put(scan.place_in_text()),
        pickle.BINPUT: lambda scan: scan.put(scan.number(1)),
        pickle.LONG_BINPUT: lambda scan: scan.put(scan.number(4)),
        pickle.MEMOIZE: _Scan.memoize,
        pickle.GET: lambda scan: scan.get(scan.place_in_text()),
        pickle.BINGET: lambda scan: scan.get(scan.number(1)),
        pickle.LONG_BINGET: lambda scan: scan.get(scan.number(4)),
        pickle.NONE: _pushes(_PLAIN),
        pickle.NEWTRUE: _pushes(_PLAIN),
        pickle.NEWFALSE: _pushes(_PLAIN),
        pickle.INT: _pushes(_PLAIN, _Scan.number_in_text),
        pickle.LONG: _pushes(_PLAIN, _Scan.number_in_text),
        pickle.FLOAT: _pushes(_PLAIN, _Scan.number_in_text),
        pickle.BININT1: _pushes(_PLAIN, lambda scan: scan.skip(1)),
        pickle.BININT2: _pushes(_PLAIN, lambda scan: scan.skip(2)),
        pickle.BININT: _pushes(_PLAIN, lambda scan: scan.skip(4)),
        pickle.BINFLOAT: _pushes(_PLAIN, lambda scan: scan.skip(8)),
        pickle.LONG1: _pushes(_PLAIN, lambda scan: scan.counted(1)),
        # text: of Python 2 (read as latin1), and of Python 3
        pickle.STRING: _pushes(_TEXT, _Scan.text_line),
        pickle.SHORT_BINSTRING: _pushes(_TEXT, lambda scan: scan.counted(1)),
        pickle.BINSTRING: _pushes(_TEXT, lambda scan: scan.counted(4)),
        pickle.UNICODE: _pushes(_TEXT, _Scan.text_line),
        pickle.SHORT_BINUNICODE: _pushes(_TEXT, lambda scan: scan.counted(1)),
        pickle.BINUNICODE: _pushes(_TEXT, lambda scan: scan.counted(4)),
        pickle.SHORT_BINBYTES: _pushes(_BYTES, lambda scan: scan.counted(1)),
        pickle.BINBYTES: _pushes(_BYTES, lambda scan: scan.counted(4)),
        pickle.BYTEARRAY8: _pushes(_BYTES, lambda scan: scan.counted(8)),
        pickle.EMPTY_TUPLE: lambda scan: scan.push_container(_TUPLE, []),
        pickle.TUPLE1: lambda scan: scan.push_container(_TUPLE, scan.pop_many(1)),
        pickle.TUPLE2: lambda scan: scan.push_container(_TUPLE, scan.pop_many(2)),
        pickle.TUPLE3: lambda scan: scan.push_container(_TUPLE, scan.pop_many(3)),
        pickle.TUPLE: lambda scan: scan.push_container(_TUPLE, scan.pop_to_mark()),
        pickle.EMPTY_LIST: lambda scan: scan.push_container(_LIST, []),
        pickle.LIST: lambda scan: scan.push_container(_LIST, scan.pop_to_mark()),
        pickle.APPEND: lambda scan: scan.extend(_LIST, scan.pop_many(1)),
        pickle.APPENDS: lambda scan: scan.extend(_LIST, scan.pop_to_mark()),
        pickle.EMPTY_DICT: lambda scan: scan.push_container(_DICT, []),
        pickle.DICT: _dict_from_mark,
        pickle.SETITEM: lambda scan: scan.extend(_DICT, scan.pop_many(2)),
        pickle.SETITEMS: lambda scan: scan.extend(_DICT, scan.pop_to_mark()),
        pickle.GLOBAL: _pushes(_NAME, lambda scan: (scan.line(), scan.line())),
        pickle.STACK_GLOBAL: _global_from_stack,
        pickle.REDUCE: _Scan.call,
        pickle.BUILD: _Scan.build,
    }.items()
}
"""What plain values and arrays need. What they do not: calls and names of other kinds, buffers and persistent ids from
elsewhere, sets, removing from the stack, values of over 4 GiB."""
