"""Mutations of files by strangers: bytes, numbers, types, bombs, links and names.

The same seed changes a file in the same way.
"""

import io
import json
import os
import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import yaml
from fault_injection.kinds import cut, garbage
from fault_injection.mutations.calib import Bomb

Rng = np.random.Generator
Change = Callable[[bytes, Rng], bytes]
PathChange = Callable[[Path, Rng], None]
JsonObject = dict[str, Any]
_JSON = ("json", "manifest", "record", "address", "tables")
_ARCHIVES = ("zip", "pt")
_YAML = ("yaml", "recipe")
_OTHERS = ("journal", "images", "safetensors", "pth", *_ARCHIVES)
FORMS = (
    "text",
    *_JSON,
    "lines",
    *_YAML,
    "pickle",
    "npz",
    "image",
    "arrow",
    "parquet",
    "shard",
    *_OTHERS,
)
GROUPS = ("bytes", "numbers", "types", "bombs", "links", "names")
MARKER = "a pickle has run"
"""Folder beside the changed files, made by a pickle whose code is run."""
HTML = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>')
"""Texts that must not become part of a page."""
ODD_NAMES = (
    *HTML,
    "a\nb",
    "\x1b[31mred",
    "\u202efdp.exe",
    "x" * 250,
    "名前",
    "$(touch ran)",
    "; rm -r x",
    "%s{0}",
    "-rf",
)
_SEAL_BYTES = 16
"""Length of the seal after a result in a store."""
_SPARSE_FILE_BYTES = 5 << 30
_MAX_SLOW_ROWS = 40
"""Rows that a slow mutation keeps of an array."""
_MAX_SLOW_BYTES = 200_000
"""Bytes that a slow mutation keeps of an archive's member."""
_MAX_ADDED_BYTES = 100_000_000
_MEGABYTE = 1 << 20
_BOMB_MEGABYTES = 900
_TEXTS = ("text", *_JSON, "lines", *_YAML)
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_NPY_HEADER_BEGIN = 10
"""Position of the header's text in a `.npy` file, after signature, version and length."""


@dataclass(frozen=True, slots=True)
class Mutation:
    """One way to change a file.

    Attributes:
        name: Name of the mutation.
        group: One of `GROUPS`.
        forms: Forms of files that the mutation fits.
        apply: Function that changes the file at a path. As files are hard links, it replaces the
            file and never writes into it.
    """

    name: str
    group: str
    forms: Collection[str]
    apply: PathChange


MUTATIONS: dict[str, Mutation] = {}
"""All mutations by their names."""


def path_mutation(group: str, *forms: str) -> Callable[[PathChange], PathChange]:
    """Register a function that changes what is at a path.

    Args:
        group: Group of the mutation.
        forms: Forms of files that it fits; all of them if none is given.
    """

    def register(apply: PathChange) -> PathChange:
        MUTATIONS[apply.__name__] = Mutation(apply.__name__, group, forms or FORMS, apply)
        return apply

    return register


def content_mutation(group: str, *forms: str) -> Callable[[Change], Change]:
    """Register a function that changes the bytes of a file.

    Args:
        group: Group of the mutation.
        forms: Forms of files that it fits; all of them if none is given. If some are given, the
            seal of a store's record stays as it is.
    """

    def register(change: Change) -> Change:
        def apply(path: Path, rng: Rng) -> None:
            content = path.read_bytes()
            seal = content[-_SEAL_BYTES:] if forms and path.name == "done" else b""
            replace_file(path, change(content.removesuffix(seal), rng) + seal)

        MUTATIONS[change.__name__] = Mutation(change.__name__, group, forms or FORMS, apply)
        return change

    return register


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file by a new one, which no other hard link shares."""
    path.unlink()
    path.write_bytes(content)


def replace_bytes(content: bytes, begin: int, end: int, replacement: bytes) -> bytes:
    """Return content in which the bytes from `begin` to `end` are replaced."""
    return content[:begin] + replacement + content[end:]


def mutation_names(form: str, group: str) -> list[str]:
    """Return the names of a group's mutations that fit a form, in alphabetical order."""
    mutations = [mutation for mutation in MUTATIONS.values() if mutation.group == group]
    return sorted(mutation.name for mutation in mutations if form in mutation.forms)


def find_outside_folder(path: Path) -> Path:
    """Return the folder that nothing may change, for a file of a case."""
    case_folder = next(folder for folder in path.parents if folder.name == "case")
    return case_folder.with_name("outside")


def choose(rng: Rng, options: Any) -> Any:
    """Return one of several options at random."""
    return options[choose_index(rng, options)]


def choose_index(rng: Rng, options: Any) -> int:
    """Return the index of one of several options at random."""
    return int(rng.integers(len(options)))


def _draw_span(content: bytes, rng: Rng) -> tuple[int, int]:
    """Return the begin and the end of a short part, at most 64 bytes long."""
    begin = choose_index(rng, content)
    length = int(rng.integers(1, 65))
    return begin, min(len(content), begin + length)


def _find_spans(pattern: re.Pattern[bytes], content: bytes) -> list[tuple[int, int]]:
    """Return the begin and the end of each match of a pattern."""
    return [match.span() for match in pattern.finditer(content)]


# ---- bytes


@content_mutation("bytes")
def bits_flipped(content: bytes, rng: Rng) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.integers(1, 9)):
        position = choose_index(rng, changed)
        changed[position] ^= 1 << int(rng.integers(8))
    return bytes(changed)


@content_mutation("bytes")
def bytes_overwritten(content: bytes, rng: Rng) -> bytes:
    begin, end = _draw_span(content, rng)
    random_bytes = garbage(content[begin:end], rng)
    return replace_bytes(content, begin, end, random_bytes[: end - begin])


@content_mutation("bytes")
def cut_off(content: bytes, rng: Rng) -> bytes:
    return cut(content, rng)


@content_mutation("bytes")
def bytes_inserted(content: bytes, rng: Rng) -> bytes:
    begin, _ = _draw_span(content, rng)
    return replace_bytes(content, begin, begin, garbage(b"", rng))


@content_mutation("bytes")
def part_removed(content: bytes, rng: Rng) -> bytes:
    begin, end = _draw_span(content, rng)
    return replace_bytes(content, begin, end, b"")


@content_mutation("bytes")
def part_doubled(content: bytes, rng: Rng) -> bytes:
    begin, end = _draw_span(content, rng)
    return content[:end] + content[begin:]


@content_mutation("bytes")
def parts_swapped(content: bytes, rng: Rng) -> bytes:
    size = min(64, len(content) // 2)
    first = int(rng.integers(len(content) - 2 * size + 1))
    second = int(rng.integers(first + size, len(content) - size + 1))
    first_part = content[first : first + size]
    second_part = content[second : second + size]
    changed = replace_bytes(content, first, first + size, second_part)
    return replace_bytes(changed, second, second + size, first_part)


@content_mutation("bytes")
def bytes_appended(content: bytes, rng: Rng) -> bytes:
    random_bytes = garbage(bytes(64), rng)
    return content + choose(rng, (random_bytes, bytes(64), b"\n", content))


@content_mutation("bytes")
def zeros_at_the_end(content: bytes, rng: Rng) -> bytes:
    begin = choose_index(rng, content)
    return content[:begin] + bytes(len(content) - begin)


@content_mutation("bytes")
def emptied(_content: bytes, _rng: Rng) -> bytes:
    return b""


@content_mutation("bytes")
def all_garbage(content: bytes, rng: Rng) -> bytes:
    return garbage(content, rng)


@content_mutation("bytes", *_TEXTS)
def odd_line_ends_or_marks(content: bytes, rng: Rng) -> bytes:
    mark = b"\xef\xbb\xbf"
    options = (
        content.replace(b"\n", b"\r\n"),
        content.replace(b"\n", b"\r"),
        mark + content,
        mark + mark + content,
        content.replace(b"\n", b"\n" + mark, 1),
        content.decode().encode("utf-16"),
    )
    return choose(rng, options)


@content_mutation("bytes", *_TEXTS)
def lines_mixed(content: bytes, rng: Rng) -> bytes:
    """Swap two lines; perhaps repeat or remove one of them."""
    lines = content.splitlines(keepends=True)
    first = choose_index(rng, lines)
    second = choose_index(rng, lines)
    lines[first], lines[second] = lines[second], lines[first]
    choice = rng.integers(3)
    if choice == 1:
        lines.append(lines[first])
    elif choice == 2:
        del lines[first]
    return b"".join(lines)


# ---- numbers

_HUGE_NUMBERS = (
    b"1e999",
    b"-1e308",
    b"nan",
    b"-inf",
    b"9" * 400,
    b"9" * 5000,
    b"-9223372036854775809",
    b"18446744073709551616",
)
_ODD_NUMBERS = (
    b"0x10",
    b"1_000",
    b"\xd9\xa1",
    b"--1",
    b"+5",
    b"1e",
    b"010",
    b".5",
    b"0",
    b"-0.0",
    b"2147483648",
    b"1e-400",
)


@content_mutation("numbers", *_TEXTS)
def number_replaced(content: bytes, rng: Rng) -> bytes:
    spans = _find_spans(_NUMBER, content) or [(0, 0)]
    begin, end = choose(rng, spans)
    return replace_bytes(content, begin, end, choose(rng, (*_HUGE_NUMBERS, *_ODD_NUMBERS)))


@content_mutation("numbers", "pickle", "npz", "image", "arrow", "parquet", "shard", *_OTHERS)
def bytes_to_a_huge_number(content: bytes, rng: Rng) -> bytes:
    numbers = (
        0x7FFFFFFF,
        0xFFFFFFFF,
        0x80000000,
        0x7FFFFFFFFFFFFFFF,
        0xFFFFFFFFFFFFFFFF,
        1 << 33,
        0,
    )
    number = choose(rng, numbers)
    formats = ("<Q", ">Q") if number >= 1 << 32 else ("<I", ">I", "<Q")
    number_bytes = struct.pack(choose(rng, formats), number)
    anywhere = choose_index(rng, content)
    in_head = int(rng.integers(min(256, len(content))))
    begin = choose(rng, (anywhere, in_head))
    return replace_bytes(content, begin, begin + len(number_bytes), number_bytes)


@content_mutation("numbers", "image")
def image_of_another_size(content: bytes, rng: Rng) -> bytes:
    height, width = choose(rng, ((65535, 65535), (0, 0), (1, 65535), (17, 9)))
    begin = re.search(rb"\xff\xc0..\x08", content, re.DOTALL).end()  # type: ignore[union-attr]
    return replace_bytes(content, begin, begin + 4, struct.pack(">HH", height, width))


@content_mutation("numbers", "npz")
def array_of_another_size(content: bytes, rng: Rng) -> bytes:
    shapes = (
        b"(999999999999, 4)",
        b"(-1, 4)",
        b"(4,)",
        b"()",
        b"(0, 4)",
        b"(1e3, 4)",
        b"(" * 99,
        b"(9" * 9,
    )

    def change(member: bytes) -> bytes:
        return _edit_npy_header(member, rb"\([^)]*\)", choose(rng, shapes))

    return _edit_member(content, rng, change)


# ---- types

_VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        -1,
        0,
        2**63,
        10**30,
        1.5,
        float("nan"),
        float("inf"),
        "",
        "text",
        "<b>",
        "../..",
        "\0",
        "\ud800",
    ),
    *([], {}, [[]], [None], {"": {}}, {"a": [1, "b"]}, [1, 2, 3], list(range(5000))),
)


@content_mutation("types", *_JSON)
def json_value_replaced(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    container, key = choose(rng, list_places(tree))
    container[key] = choose(rng, _VALUES)
    return json.dumps(tree).encode()


@content_mutation("types", *_JSON)
def json_key_lost_or_added(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    container = choose_container(rng, tree)
    if isinstance(container, list):
        del container[choose_index(rng, container)]
    elif rng.integers(2):
        del container[choose(rng, list(container))]
    else:
        container["another"] = choose(rng, _VALUES)
    return json.dumps(tree).encode()


@content_mutation("types", *_JSON)
def json_key_twice(content: bytes, rng: Rng) -> bytes:
    begin, end = choose(rng, _find_spans(re.compile(rb'"[^"]+":'), content))
    return replace_bytes(content, begin, begin, content[begin:end] + b" 7, ")


@content_mutation("types", *_JSON, *_YAML)
def another_top(_content: bytes, rng: Rng) -> bytes:
    nested_lists = b"[" * 50 + b"]" * 50
    scalars = (b"null", b"1", b'"text"')
    options = (b"[]", b"{}", *scalars, nested_lists, b"{}{}", b"NaN", b"true")
    return choose(rng, options)


@content_mutation("types", *_YAML)
def yaml_value_replaced(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    container = choose_container(rng, tree)
    value = choose(rng, [value for value in _VALUES if value != "\ud800"])
    container[choose(rng, list_keys(container))] = value
    return yaml.safe_dump(tree).encode("utf-8", "surrogatepass")


@path_mutation("types", *_YAML)
def yaml_tags(path: Path, rng: Rng) -> None:
    marker = json.dumps(str(path.parent / MARKER)).encode()
    values = (
        b"!!python/object/apply:os.mkdir [" + marker + b"]",
        b"!!python/name:os.system",
        b"!!binary aGk=",
        b"!!int x",
        b"!!set {a, b}",
        b"!!timestamp 2001-01-01",
        b"*unknown",
        b"&a [*a]",
        b"{? [a] : b}",
        b"0o7",
        b"1:30",
    )
    lines = path.read_bytes().splitlines()
    is_plain = [b": " in line and b"{" not in line for line in lines]
    position = choose(rng, np.flatnonzero(is_plain))
    key, *_ = lines[position].split(b": ")
    lines[position] = key + b": " + choose(rng, values)
    replace_file(path, b"\n".join(lines) + b"\n")


@path_mutation("types", "pickle")
def pickle_runs_code(path: Path, rng: Rng) -> None:
    arrays = pickle.loads(path.read_bytes())
    arrays[choose(rng, [*arrays, "extra"])] = Bomb(path.parent / MARKER)
    replace_file(path, pickle.dumps(arrays, protocol=int(rng.integers(6))))


@content_mutation("types", "pickle")
def pickle_of_other_things(content: bytes, rng: Rng) -> bytes:
    arrays = pickle.loads(content)
    key = choose(rng, list(arrays))
    array = arrays[key]
    options = (
        array.astype("c8"),
        array.astype("f2"),
        array.astype(">f8"),
        array.astype("i4"),
        array.astype(object),
        array[0],
        array.tolist(),
        str(array),
        np.asfortranarray(array),
        array[None],
        np.ma.array(array),
        None,
        np.float64(1),
        b"",
        np.zeros(array.shape, "M8[s]"),
        np.full(array.shape, np.nan),
        array * 1e300,
    )
    arrays[key] = choose(rng, options)
    return pickle.dumps(arrays, protocol=int(rng.integers(6)))


@content_mutation("types", "pickle")
def pickle_asks_for_a_name(content: bytes, rng: Rng) -> bytes:
    names = (
        b"os\nsystem",
        b"builtins\neval",
        b"builtins\nexec",
        b"subprocess\nPopen",
        b"numpy\nload",
        b"copyreg\n_reconstructor",
        b"numpy\nfromfile",
        b"numpy.core.multiarray\nfrombuffer",
        b"posix\nfork",
        b"\n",
        b"a.b\nc.d",
    )
    name = choose(rng, names)
    end = choose(rng, (b"(S'ls'\ntR.", b".", b"(tR.", b"}b.", b")\x81.", b"0" + content))
    begin = choose(rng, (b"", b"\x80\x04"))
    return begin + b"c" + name + b"\n" + end


@content_mutation("types", "npz")
def array_of_another_type(content: bytes, rng: Rng) -> bytes:
    def change(member: bytes) -> bytes:
        array = np.lib.format.read_array(io.BytesIO(member))
        array = np.atleast_1d(array)[:_MAX_SLOW_ROWS]
        dtypes = ("c16", "?", "U3", "S3", "M8[s]", "f2", ">f8", "i1", "u8", "O", "V8")
        ones = np.full(array.shape, 1).astype(choose(rng, dtypes))
        fields = np.zeros(array.shape, [("a", "f8"), ("b", "O" if rng.integers(2) else "i4")])
        fortran_array = np.asfortranarray(array.T if rng.integers(2) else array)
        options = (ones, fields, fortran_array, array[..., None], array[:0], array.ravel())
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, choose(rng, options))
        return buffer.getvalue()

    return _edit_member(content, rng, change)


@content_mutation("types", "npz")
def array_with_another_header(content: bytes, rng: Rng) -> bytes:
    dtypes = (
        b"'|O'",
        b"'<f9'",
        b"'<U99999999'",
        b"[('a', '<f8')]",
        b"__import__('os')",
        b"{}",
        b"'f8,f8'",
    )

    def change(member: bytes) -> bytes:
        version = choose(rng, (b"\x02\x00", b"\x03\x00", b"\x09\x09"))
        dtype = choose(rng, dtypes)
        options = (
            _edit_npy_header(member, rb"'[<>|=][a-zA-Z]\d+'", dtype),
            replace_bytes(member, 6, 8, version),
            member[_NPY_HEADER_BEGIN:],
            _edit_npy_header(member, rb"False", b"True"),
            _edit_npy_header(member, rb"'shape'", b"'shapes'"),
        )
        return choose(rng, options)

    return _edit_member(content, rng, change)


@content_mutation("types", "npz")
def archive_of_other_members(content: bytes, rng: Rng) -> bytes:
    members = read_members(content)
    name = choose(rng, list(members))
    choice = rng.integers(5)
    if choice == 0:
        del members[name]
    elif choice == 1:
        members = {f"../{name}": member for name, member in members.items()}
    elif choice == 2:
        members["another.npy"] = members[name]
    elif choice == 3:
        members[name] = garbage(bytes(100), rng)
    members = {name: member[:_MAX_SLOW_BYTES] for name, member in members.items()}
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    archive = pack_archive(members, choose(rng, methods))
    if choice != 4:
        return archive
    checksum = zlib.crc32(members[name])
    return archive.replace(checksum.to_bytes(4, "little"), b"\1\2\3\4")


@content_mutation("types", "npz", *_ARCHIVES)
def archive_that_lies(content: bytes, rng: Rng) -> bytes:
    """Change a field of the archive's directory or of a member's own header."""
    begin, _ = choose(rng, _find_spans(re.compile(rb"PK(?:\x01\x02|\x03\x04|\x05\x06)"), content))
    begin += int(rng.integers(4, 40))
    field = choose(rng, (b"\xff\xff", b"\1\0", b"\x63\0", b"\0\0"))
    return replace_bytes(content, begin, begin + 2, field)


@content_mutation("types", "image")
def image_of_another_format(content: bytes, rng: Rng) -> bytes:
    from PIL import Image

    formats = ("PNG", "GIF", "TIFF", "BMP", "WEBP", "PPM", "EPS", "ICO", "TGA", "PDF")
    image_format = choose(rng, formats)
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(content)) as image:
        pixels = image if rng.integers(2) else image.convert("L")
        pixels.convert("RGB").save(buffer, image_format)
    return buffer.getvalue()


@content_mutation("types", "arrow", "parquet")
def table_of_other_columns(content: bytes, rng: Rng) -> bytes:
    import pyarrow as pa

    table = _read_table(content)
    position = int(rng.integers(table.num_columns))
    name, rows = table.column_names[position], table.num_rows
    columns = (
        pa.array(["text"] * rows),
        pa.nulls(rows),
        pa.array([[1]] * rows),
        pa.array([2**62] * rows),
        pa.array([-7] * rows),
    )
    edits = (
        lambda: table.drop_columns([name]),
        lambda: table.append_column("another", pa.array([1] * rows)),
        lambda: table.set_column(position, name, choose(rng, columns)),
        lambda: table.slice(0, rows // 2),
        lambda: table.slice(0, 0),
        lambda: table.rename_columns([f"{HTML[0]}{column}" for column in table.column_names]),
        lambda: pa.concat_tables([table, table]),
    )
    edit = choose(rng, edits)
    return _write_table(edit(), content)


# ---- bombs


@path_mutation("bombs")
def hole_of_gigabytes(path: Path, rng: Rng) -> None:
    """Extend the content, or an empty file, by zeros to 5 GB that take no space on the disk."""
    replace_file(path, path.read_bytes() if rng.integers(2) else b"")
    os.truncate(path, _SPARSE_FILE_BYTES)


@content_mutation("bombs", *_TEXTS)
def endless_line(content: bytes, rng: Rng) -> bytes:
    begin = choose(rng, (content, b""))
    return begin + choose(rng, (b"9", b" ", b"x", b"-", b'"', b"1 ")) * 4_000_000


@content_mutation("bombs", *_TEXTS)
def many_lines(content: bytes, rng: Rng) -> bytes:
    line = choose(rng, (content.splitlines(keepends=True)[-1], b"\n", b"-\n"))
    count = min(50_000, _MAX_ADDED_BYTES // len(line))
    if not content.endswith(b"\n"):
        content += b"\n"
    return content + line * count


@content_mutation("bombs", *_JSON, *_YAML)
def deep_nesting(content: bytes, rng: Rng) -> bytes:
    nested = nest_deeply(rng)
    spans = _find_spans(_NUMBER, content) or [(0, len(content))]
    begin, end = choose(rng, (choose(rng, spans), (0, len(content))))
    return replace_bytes(content, begin, end, nested)


@content_mutation("bombs", *_YAML)
def many_laughs(content: bytes, rng: Rng) -> bytes:
    """Add an anchor that refers to the one before nine times, and so on for nine levels."""
    lines = ["a0: &a0 [lol]"]
    for level in range(1, 10):
        references = ", ".join([f"*a{level - 1}"] * 9)
        lines.append(f"a{level}: &a{level} [{references}]")
    return "\n".join([*lines, content.decode()]).encode()


@content_mutation("bombs", "pickle")
def pickle_bomb(content: bytes, rng: Rng) -> bytes:
    deep = b"(" * 1_000_000 + b"t" * 1_000_000
    tuples = b")" + b"\x85" * 1_000_000
    doubled = b"]" + b"q\0" + b"".join(b"0]h%ch%c\x86q%c" % (n, n, n + 1) for n in range(60))
    options = (
        b"\x80\x04}" + tuples + b"K\1s.",  # a key that is nested deep
        b"\x80\x04" + tuples + b".",
        b"\x80\x02" + deep + b".",
        b"\x80\x02" + b"]" * 500_000 + b"a" * 499_999 + b".",
        b"\x80\x02Nr\xff\xff\xff\x7f.",  # a memo index of two thousand million
        b"\x80\x02Nr\xff\xff\xff\x07.",
        b"Np999999999\n.",
        b"\x80\x04" + doubled + b".",
        b"\x80\x04\x95" + struct.pack("<Q", 1 << 40) + content[2:],
        b"\x80\x04\x8e" + struct.pack("<Q", 1 << 35) + b"x.",  # bytes of 34 GB
        b"\x80\x04\x8b" + struct.pack("<i", 1 << 30) + b"\1.",
        b"\x80\x02L" + b"9" * 2_000_000 + b"L\n.",
        b"\x80\x05\x96" + struct.pack("<Q", 1 << 36) + b"x.",
        b"\x80\x02" + b"N" * 5_000_000 + b".",
        b"\x80\x02" + b"2" * 1000 + content[2:],
        content[:-1] + b"0" * 3 + content[2:],
    )
    return choose(rng, options)


@content_mutation("bombs", "npz")
def archive_bomb(content: bytes, rng: Rng) -> bytes:
    """Replace an array by a megabyte that unpacks to 900."""
    members = read_members(content)
    name = choose(rng, list(members))
    shape = choose(rng, (b"(28125000, 4)", b"(900000000, 1)", b"(1, 900000000)"))
    dtype = choose(rng, (b"<f8", b"|u1"))
    text = b"{'descr': '%s', 'fortran_order': False, 'shape': %s, }" % (dtype, shape)
    header = b"\x93NUMPY\1\0" + struct.pack("<H", 118) + text.ljust(117) + b"\n"
    deflated, checksum, size = deflate_with_zeros(choose(rng, (header, members[name])))
    del members[name]
    return pack_archive(members, zipfile.ZIP_STORED, (name, deflated, checksum, size))


@content_mutation("bombs", "image")
def image_bomb(_content: bytes, rng: Rng) -> bytes:
    """Return a PNG of about 900 million pixels or more in a megabyte, with or without the data."""
    side = choose(rng, (30_000, 65_500))
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    row_bytes = side // 8 + 1
    rows = zlib.compress(bytes(row_bytes * 2000), 1) if rng.integers(2) else zlib.compress(b"")
    text = b"a\0\0" + zlib.compress(bytes(50_000_000), 1)
    text_chunks = choose(rng, ((), ((b"zTXt", text),), ((b"iCCP", text),)))
    chunks = ((b"IHDR", head), *text_chunks, (b"IDAT", rows), (b"IEND", b""))
    image = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        image += struct.pack(">I", len(data)) + kind + data + checksum
    return image


@content_mutation("bombs", "parquet")
def table_of_many_rows(content: bytes, _rng: Rng) -> bytes:
    import pyarrow as pa

    first_row = _read_table(content).slice(0, 1)
    table = pa.concat_tables([first_row] * 20_000)
    return _write_table(table.combine_chunks(), content)


# ---- links, and what is no file


def _remove(path: Path) -> Path:
    """Remove a file; return its path."""
    path.unlink()
    return path


@path_mutation("links")
def missing(path: Path, _rng: Rng) -> None:
    _remove(path)


@path_mutation("links")
def link_to_itself(path: Path, _rng: Rng) -> None:
    _remove(path).symlink_to(path.name)


@path_mutation("links")
def links_in_a_loop(path: Path, _rng: Rng) -> None:
    other = path.with_name(f"{path.stem}_other{path.suffix}")
    _remove(path).symlink_to(other.name)
    other.symlink_to(path.name)


@path_mutation("links")
def link_elsewhere(path: Path, rng: Rng) -> None:
    targets = (
        "/dev/zero",
        "/dev/urandom",
        "/dev/full",
        "/dev/tty",
        "/proc/self/mem",
        "/etc/passwd",
        "/nowhere",
        ".",
        "/dev",  # a small folder: to search all of "/" takes as long as the machine is full
    )
    target = choose(rng, targets)
    _remove(path).symlink_to(target)


@path_mutation("links")
def link_to_the_same_content(path: Path, _rng: Rng) -> None:
    target = path.with_name(f"kept {path.name}")
    path.rename(target)
    path.symlink_to(target.name)


@path_mutation("links")
def named_pipe(path: Path, _rng: Rng) -> None:
    os.mkfifo(_remove(path))


@path_mutation("links")
def folder_instead(path: Path, rng: Rng) -> None:
    _remove(path).mkdir()
    if rng.integers(2):
        (path / "loop").symlink_to(path)


@path_mutation("links")
def folder_is_a_link(path: Path, rng: Rng) -> None:
    """Replace the file's folder by a link to itself, to its parent, to a device or to a copy."""
    folder = path.parent
    target = folder.with_name(f"kept {folder.name}")
    folder.rename(target)
    folder.symlink_to(choose(rng, (folder.name, ".", "/dev/zero", target.name)))


# ---- names


@path_mutation("names")
def neighbour_with_an_odd_name(path: Path, rng: Rng) -> None:
    """Add a file or a folder with an odd name beside the file or beside its folder."""
    names = (
        *ODD_NAMES,
        f"{path.stem}{path.suffix}~",
        path.stem.upper() + path.suffix,
        f"{path.stem} 2{path.suffix}",
    )
    name = choose(rng, names).replace("/", "∕")
    folder = choose(rng, (path.parent, path.parent.parent))
    if (folder / name).exists():
        name += "~"
    choice = rng.integers(4)
    if choice == 0:
        (folder / name).mkdir()
    elif choice == 1:
        os.mkfifo(folder / name)
    elif choice == 2:
        name_that_is_not_utf8 = b"\xff\xfe" + path.suffix.encode()
        neighbour = os.fsencode(folder) + b"/" + name_that_is_not_utf8
        Path(os.fsdecode(neighbour)).write_bytes(path.read_bytes())
    else:
        neighbour_path = (folder / name[:200]).with_suffix(path.suffix)
        neighbour_path.write_bytes(path.read_bytes())


@content_mutation("names", "text")
def word_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    begin, end = choose(rng, _find_spans(re.compile(rb"\S+"), content))
    return replace_bytes(content, begin, end, choose(rng, ODD_NAMES).encode())


@content_mutation("names", *_JSON)
def json_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    container, key = choose_place(rng, tree, str)
    container[key] = choose(rng, ODD_NAMES)
    return json.dumps(tree).encode()


@content_mutation("names", *_JSON)
def json_key_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    container = choose_container(rng, tree, dict)
    old_key = choose(rng, list(container))
    container[choose(rng, ODD_NAMES)] = container.pop(old_key)
    return json.dumps(tree).encode()


@content_mutation("names", *_YAML)
def yaml_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    name = choose(rng, ODD_NAMES)
    tree[choose(rng, list(tree))] = name
    return yaml.safe_dump(tree).encode()


@content_mutation("names", "npz")
def member_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    members = read_members(content)
    old_name = choose(rng, list(members))
    name = choose(rng, ODD_NAMES)
    members[f"{name}.npy"] = members.pop(old_name)
    return pack_archive(members, zipfile.ZIP_DEFLATED)


# ---- helpers for several mutations


def list_containers(tree: Any) -> list[Any]:
    """Return all lists and mappings of a tree."""
    containers = []
    waiting = [tree]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict | list):
            containers.append(value)
            waiting += value.values() if isinstance(value, dict) else value
    return containers


def choose_container(rng: Rng, tree: Any, kind: type | UnionType = dict | list) -> Any:
    """Return a list or a mapping of a tree at random, one that is not empty."""
    containers = list_containers(tree)
    return choose(rng, [item for item in containers if item and isinstance(item, kind)])


def list_keys(container: Any) -> list[Any]:
    """Return the keys of a mapping or the indices of a list."""
    return list(container if isinstance(container, dict) else range(len(container)))


def list_places(tree: Any) -> list[tuple[Any, Any]]:
    """Return the place of each value in a tree: its container, and its key or index there."""
    containers = list_containers(tree)
    return [(container, key) for container in containers for key in list_keys(container)]


def nest_deeply(rng: Rng) -> bytes:
    """Return deeply nested JSON, perhaps without its end."""
    depth = choose(rng, (900, 5_000, 200_000))
    lists = b"[" * depth + b"]" * depth
    mappings = b'{"a":' * depth + b"1" + b"}" * depth
    return choose(rng, (lists, mappings, b"[" * depth))


def choose_place(rng: Rng, tree: Any, kind: type | UnionType) -> tuple[Any, Any]:
    """Return the place of a value of a type at random; of any value if none has the type."""
    places = list_places(tree)
    typed_places = [(inside, key) for inside, key in places if isinstance(inside[key], kind)]
    return choose(rng, typed_places or places)


def read_members(content: bytes) -> dict[str, bytes]:
    """Return the members of an archive by their names."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _edit_member(content: bytes, rng: Rng, change: Callable[[bytes], bytes]) -> bytes:
    """Return an archive with one member changed."""
    members = read_members(content)
    name = choose(rng, list(members))
    members[name] = change(members[name])
    return pack_archive(members, zipfile.ZIP_DEFLATED)


def _edit_npy_header(member: bytes, pattern: bytes, text: bytes) -> bytes:
    """Return a `.npy` file with another text in its header, padded to the old length if it fits."""
    size = struct.unpack("<H", member[8:_NPY_HEADER_BEGIN])[0]
    end = _NPY_HEADER_BEGIN + size
    header = re.sub(pattern, lambda _: text, member[_NPY_HEADER_BEGIN:end], count=1)
    header = header.rstrip(b" \n").ljust(size - 1) + b"\n"
    return replace_bytes(member, 8, end, struct.pack("<H", len(header)) + header)


def pack_archive(
    members: dict[str, bytes], method: int, deflated: tuple[str, bytes, int, int] | None = None
) -> bytes:
    """Return an archive.

    Args:
        members: Bytes of the members by their names.
        method: Compression method of the members.
        deflated: Name, deflated bytes, checksum and size of one more member.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
        if deflated is not None:
            name, content, checksum, size = deflated
            archive.writestr(name, content, zipfile.ZIP_STORED)
            entry = archive.getinfo(name)
            header_length = len(entry.FileHeader())
            entry.compress_type, entry.CRC, entry.file_size = zipfile.ZIP_DEFLATED, checksum, size
            buffer.seek(entry.header_offset)
            buffer.write(entry.FileHeader()[:header_length])
            buffer.seek(0, io.SEEK_END)
    return buffer.getvalue()


@cache
def _deflate_zeros(megabytes: int) -> bytes:
    """Return deflated zeros, which can follow any deflated block."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    compressor.compress(bytes(_MEGABYTE))
    compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(_MEGABYTE)) + compressor.flush(zlib.Z_FULL_FLUSH)
    return block * megabytes


def deflate_with_zeros(head: bytes) -> tuple[bytes, int, int]:
    """Return some bytes with 900 MB of zeros after them, deflated; a wrong checksum; their size."""
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = compressor.compress(head) + compressor.flush(zlib.Z_FULL_FLUSH)
    size = len(head) + _BOMB_MEGABYTES * _MEGABYTE
    return start + _deflate_zeros(_BOMB_MEGABYTES) + b"\3\0", 0, size


def _read_table(content: bytes) -> Any:
    """Return the table of a Parquet or Arrow file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if content.startswith(b"PAR1"):
        return pq.read_table(io.BytesIO(content))
    return pa.ipc.open_file(io.BytesIO(content)).read_all()


def _write_table(table: Any, old_content: bytes) -> bytes:
    """Return a table as a file of the same format as the old one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    if old_content.startswith(b"PAR1"):
        pq.write_table(table, buffer)
    else:
        with pa.ipc.new_file(buffer, table.schema) as writer:
            writer.write_table(table)
    return buffer.getvalue()
