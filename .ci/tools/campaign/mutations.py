"""What strangers do to a file: bytes, numbers, types, bombs, links and names; the same with the
same seed.
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
from typing import Any

import numpy as np
import yaml
from fault_injection.kinds import cut, garbage
from fault_injection.mutations.calib import Bomb

Rng = np.random.Generator
Change = Callable[[bytes, Rng], bytes]
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
"""The folder beside the changed files that a pickle makes whose code is run."""
HTML = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>')
"""Texts that must not become part of a page."""
_SEAL = 16
"""Bytes after a result in a store."""
_SPARSE = 5 << 30
"""Bytes of a file that is mostly a hole."""
_MOST_ROWS, _MOST_BYTES = 40, 200_000
"""What a mutation that takes long keeps of an array."""
_MOST_ADDED = 100_000_000
"""Bytes of lines that are added."""
_TEXTS = ("text", *_JSON, "lines", *_YAML)
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class Mutation:
    """One way to change a file.

    Attributes:
        name: of the mutation.
        group: one of `GROUPS`.
        forms: the forms of files that it is made for.
        apply: changes the file at a path. Files are hard links: it replaces them, and never writes
            into one.
    """

    name: str
    group: str
    forms: Collection[str]
    apply: Callable[[Path, Rng], None]


MUTATIONS: dict[str, Mutation] = {}
"""By name."""


def by_path(
    group: str, *forms: str
) -> Callable[[Callable[[Path, Rng], None]], Callable[[Path, Rng], None]]:
    """Enter a function that changes what is at a path."""

    def enter(apply: Callable[[Path, Rng], None]) -> Callable[[Path, Rng], None]:
        MUTATIONS[apply.__name__] = Mutation(apply.__name__, group, forms or FORMS, apply)
        return apply

    return enter


def by_content(group: str, *forms: str) -> Callable[[Change], Change]:
    """Enter a function of the file's bytes; for files of some forms, of those before the seal of a
    store's record.
    """

    def enter(change: Change) -> Change:
        def apply(path: Path, rng: Rng) -> None:
            content = path.read_bytes()
            seal = content[-_SEAL:] if forms and path.name == "done" else b""
            replace(path, change(content.removesuffix(seal), rng) + seal)

        MUTATIONS[change.__name__] = Mutation(change.__name__, group, forms or FORMS, apply)
        return change

    return enter


def replace(path: Path, content: bytes) -> None:
    """Put a new file in the place of another."""
    path.unlink()
    path.write_bytes(content)


def fitting(form: str, group: str) -> list[str]:
    """The names of the mutations of a group for a form, in a fixed order."""
    return sorted(
        name for name, each in MUTATIONS.items() if each.group == group and form in each.forms
    )


def outside_of(path: Path) -> Path:
    """The folder that nothing may change, for a file of a case."""
    return next(folder for folder in path.parents if folder.name == "case").with_name("outside")


def any_of(rng: Rng, options: Any) -> Any:
    return options[int(rng.integers(len(options)))]


def _span(content: bytes, rng: Rng) -> tuple[int, int]:
    """Begin and end of a short part."""
    begin = int(rng.integers(len(content)))
    return begin, min(len(content), begin + int(rng.integers(1, 65)))


# ---- bytes


@by_content("bytes")
def bits_flipped(content: bytes, rng: Rng) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


@by_content("bytes")
def bytes_overwritten(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + garbage(content[begin:end], rng)[: end - begin] + content[end:]


@by_content("bytes")
def cut_off(content: bytes, rng: Rng) -> bytes:
    return cut(content, rng)


@by_content("bytes")
def bytes_inserted(content: bytes, rng: Rng) -> bytes:
    begin, _ = _span(content, rng)
    return content[:begin] + garbage(b"", rng) + content[begin:]


@by_content("bytes")
def part_removed(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + content[end:]


@by_content("bytes")
def part_doubled(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:end] + content[begin:]


@by_content("bytes")
def parts_swapped(content: bytes, rng: Rng) -> bytes:
    size = min(64, len(content) // 2)
    first = int(rng.integers(len(content) - 2 * size + 1))
    second = int(rng.integers(first + size, len(content) - size + 1))
    parts = (content[:first], content[second : second + size], content[first + size : second])
    return b"".join(parts) + content[first : first + size] + content[second + size :]


@by_content("bytes")
def bytes_appended(content: bytes, rng: Rng) -> bytes:
    return content + any_of(rng, (garbage(bytes(64), rng), bytes(64), b"\n", content))


@by_content("bytes")
def zeros_at_the_end(content: bytes, rng: Rng) -> bytes:
    kept = int(rng.integers(len(content)))
    return content[:kept] + bytes(len(content) - kept)


@by_content("bytes")
def emptied(_before: bytes, _rng: Rng) -> bytes:
    return b""


@by_content("bytes")
def all_garbage(content: bytes, rng: Rng) -> bytes:
    return garbage(content, rng)


@by_content("bytes", *_TEXTS)
def odd_line_ends_or_marks(content: bytes, rng: Rng) -> bytes:
    mark = b"\xef\xbb\xbf"
    options = (
        content.replace(b"\n", b"\r\n"),
        content.replace(b"\n", b"\r"),
        mark + content,
        mark + mark + content,
    )
    return any_of(
        rng, (*options, content.replace(b"\n", b"\n" + mark, 1), content.decode().encode("utf-16"))
    )


@by_content("bytes", *_TEXTS)
def lines_mixed(content: bytes, rng: Rng) -> bytes:
    lines = content.splitlines(keepends=True)
    one, other = (int(rng.integers(len(lines))) for _ in range(2))
    lines[one], lines[other] = lines[other], lines[one]
    kept = int(rng.integers(3))
    return b"".join([lines, [*lines, lines[one]], lines[:one] + lines[one + 1 :]][kept])


# ---- numbers

_HUGE = (
    b"1e999",
    b"-1e308",
    b"nan",
    b"-inf",
    b"9" * 400,
    b"9" * 5000,
    b"-9223372036854775809",
    b"18446744073709551616",
)
_ODD = (
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


@by_content("numbers", *_TEXTS)
def number_replaced(content: bytes, rng: Rng) -> bytes:
    spans = [match.span() for match in _NUMBER.finditer(content)] or [(0, 0)]
    begin, end = any_of(rng, spans)
    return content[:begin] + any_of(rng, (*_HUGE, *_ODD)) + content[end:]


@by_content("numbers", "pickle", "npz", "image", "arrow", "parquet", "shard", *_OTHERS)
def bytes_to_a_huge_number(content: bytes, rng: Rng) -> bytes:
    number = any_of(
        rng,
        (0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1 << 33, 0),
    )
    form = any_of(rng, ("<Q", ">Q") if number >= 1 << 32 else ("<I", ">I", "<Q"))
    packed = struct.pack(form, number)
    begin = any_of(
        rng, (int(rng.integers(len(content))), int(rng.integers(min(256, len(content)))))
    )
    return content[:begin] + packed + content[begin + len(packed) :]


@by_content("numbers", "image")
def image_of_another_size(content: bytes, rng: Rng) -> bytes:
    size = any_of(rng, ((65535, 65535), (0, 0), (1, 65535), (17, 9)))
    begin = re.search(rb"\xff\xc0..\x08", content, re.DOTALL).end()  # type: ignore[union-attr]
    return content[:begin] + struct.pack(">HH", *size) + content[begin + 4 :]


@by_content("numbers", "npz")
def array_of_another_size(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        shape = any_of(
            rng,
            (
                b"(999999999999, 4)",
                b"(-1, 4)",
                b"(4,)",
                b"()",
                b"(0, 4)",
                b"(1e3, 4)",
                b"(" * 99,
                b"(9" * 9,
            ),
        )
        return _header(member, rb"\([^)]*\)", shape)

    return _zipped(content, rng, change)


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


@by_content("types", *_JSON)
def json_value_replaced(content: bytes, rng: Rng) -> bytes:
    return _edited_json(content, rng, lambda _: any_of(rng, _VALUES))


@by_content("types", *_JSON)
def json_key_lost_or_added(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    inside = any_of(rng, [each for each in containers(tree) if each])
    if isinstance(inside, list):
        del inside[int(rng.integers(len(inside)))]
    elif rng.integers(2):
        del inside[any_of(rng, list(inside))]
    else:
        inside["another"] = any_of(rng, _VALUES)
    return json.dumps(tree).encode()


@by_content("types", *_JSON)
def json_key_twice(content: bytes, rng: Rng) -> bytes:
    spans = [match.span() for match in re.finditer(rb'"[^"]+":', content)]
    begin, end = any_of(rng, spans)
    return content[:begin] + content[begin:end] + b" 7, " + content[begin:]


@by_content("types", *_JSON, *_YAML)
def another_top(_before: bytes, rng: Rng) -> bytes:
    return any_of(
        rng,
        (b"[]", b"{}", b"null", b"1", b'"text"', b"[" * 50 + b"]" * 50, b"{}{}", b"NaN", b"true"),
    )


@by_content("types", *_YAML)
def yaml_value_replaced(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    inside = any_of(rng, [each for each in containers(tree) if each])
    inside[any_of(rng, list(inside) if isinstance(inside, dict) else range(len(inside)))] = any_of(
        rng, _VALUES[:14] + _VALUES[15:]
    )
    return yaml.safe_dump(tree).encode("utf-8", "surrogatepass")


@by_path("types", *_YAML)
def yaml_tags(path: Path, rng: Rng) -> None:
    made = json.dumps(str(path.parent / MARKER)).encode()
    tags = (
        b"!!python/object/apply:os.mkdir [" + made + b"]",
        b"!!python/name:os.system",
        b"!!binary aGk=",
        b"!!int x",
    )
    odd = (
        b"!!set {a, b}",
        b"!!timestamp 2001-01-01",
        b"*unknown",
        b"&a [*a]",
        b"{? [a] : b}",
        b"0o7",
        b"1:30",
    )
    lines = path.read_bytes().splitlines()
    at = any_of(
        rng, [number for number, line in enumerate(lines) if b": " in line and b"{" not in line]
    )
    lines[at] = lines[at].split(b": ")[0] + b": " + any_of(rng, (*tags, *odd))
    replace(path, b"\n".join(lines) + b"\n")


@by_path("types", "pickle")
def pickle_runs_code(path: Path, rng: Rng) -> None:
    arrays = pickle.loads(path.read_bytes())
    arrays[any_of(rng, [*arrays, "extra"])] = Bomb(path.parent / MARKER)
    replace(path, pickle.dumps(arrays, protocol=int(rng.integers(6))))


@by_content("types", "pickle")
def pickle_of_other_things(content: bytes, rng: Rng) -> bytes:
    arrays = pickle.loads(content)
    key = any_of(rng, list(arrays))
    here = arrays[key]
    odd = (
        here.astype("c8"),
        here.astype("f2"),
        here.astype(">f8"),
        here.astype("i4"),
        here.astype(object),
        here[0],
    )
    more = (
        here.tolist(),
        str(here),
        np.asfortranarray(here),
        here[None],
        np.ma.array(here),
        None,
        np.float64(1),
        b"",
    )
    arrays[key] = any_of(
        rng, (*odd, *more, np.zeros(here.shape, "M8[s]"), np.full(here.shape, np.nan), here * 1e300)
    )
    return pickle.dumps(arrays, protocol=int(rng.integers(6)))


@by_content("types", "pickle")
def pickle_asks_for_a_name(content: bytes, rng: Rng) -> bytes:
    names = (
        b"os\nsystem",
        b"builtins\neval",
        b"builtins\nexec",
        b"subprocess\nPopen",
        b"numpy\nload",
        b"copyreg\n_reconstructor",
    )
    name = any_of(
        rng,
        (
            *names,
            b"numpy\nfromfile",
            b"numpy.core.multiarray\nfrombuffer",
            b"posix\nfork",
            b"\n",
            b"a.b\nc.d",
        ),
    )
    end = any_of(rng, (b"(S'ls'\ntR.", b".", b"(tR.", b"}b.", b")\x81.", b"0" + content))
    return any_of(rng, (b"", b"\x80\x04")) + b"c" + name + b"\n" + end


@by_content("types", "npz")
def array_of_another_type(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        array = np.atleast_1d(np.lib.format.read_array(io.BytesIO(member)))[:_MOST_ROWS]
        kinds = ("c16", "?", "U3", "S3", "M8[s]", "f2", ">f8", "i1", "u8", "O", "V8")
        odd = np.full(array.shape, 1).astype(any_of(rng, kinds))
        fields = np.zeros(array.shape, [("a", "f8"), ("b", "O" if rng.integers(2) else "i4")])
        turned = np.asfortranarray(array.T if rng.integers(2) else array)
        buffer = io.BytesIO()
        np.lib.format.write_array(
            buffer, any_of(rng, (odd, fields, turned, array[..., None], array[:0], array.ravel()))
        )
        return buffer.getvalue()

    return _zipped(content, rng, change)


@by_content("types", "npz")
def array_with_another_header(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        version = any_of(rng, (b"\x02\x00", b"\x03\x00", b"\x09\x09"))
        text = any_of(
            rng,
            (
                b"'|O'",
                b"'<f9'",
                b"'<U99999999'",
                b"[('a', '<f8')]",
                b"__import__('os')",
                b"{}",
                b"'f8,f8'",
            ),
        )
        edits = (
            _header(member, rb"'[<>|=][a-zA-Z]\d+'", text),
            member[:6] + version + member[8:],
            member[10:],
        )
        return any_of(
            rng,
            (
                *edits,
                _header(member, rb"False", b"True"),
                _header(member, rb"'shape'", b"'shapes'"),
            ),
        )

    return _zipped(content, rng, change)


@by_content("types", "npz")
def archive_of_other_members(content: bytes, rng: Rng) -> bytes:
    members = members_of(content)
    name = any_of(rng, list(members))
    choice = int(rng.integers(5))
    if choice == 0:
        del members[name]
    elif choice == 1:
        members = {f"../{name}": member for name, member in members.items()}
    elif choice == 2:
        members["another.npy"] = members[name]
    elif choice == 3:
        members[name] = garbage(bytes(100), rng)
    members = {name: member[:_MOST_BYTES] for name, member in members.items()}
    stored = packed(
        members,
        any_of(
            rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
        ),
    )
    return (
        stored
        if choice != 4
        else stored.replace(zlib.crc32(members[name]).to_bytes(4, "little"), b"\1\2\3\4")
    )


@by_content("types", "npz", *_ARCHIVES)
def archive_that_lies(content: bytes, rng: Rng) -> bytes:
    """A field of the archive's directory or of a local header is another."""
    at = any_of(
        rng, [match.start() for match in re.finditer(rb"PK(?:\x01\x02|\x03\x04|\x05\x06)", content)]
    )
    at += int(rng.integers(4, 40))
    return (
        content[:at] + any_of(rng, (b"\xff\xff", b"\1\0", b"\x63\0", b"\0\0")) + content[at + 2 :]
    )


@by_content("types", "image")
def image_of_another_format(content: bytes, rng: Rng) -> bytes:
    from PIL import Image

    form = any_of(rng, ("PNG", "GIF", "TIFF", "BMP", "WEBP", "PPM", "EPS", "ICO", "TGA", "PDF"))
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(content)) as image:
        (image if rng.integers(2) else image.convert("L")).convert("RGB").save(buffer, form)
    return buffer.getvalue()


@by_content("types", "arrow", "parquet")
def table_of_other_columns(content: bytes, rng: Rng) -> bytes:
    import pyarrow as pa

    table = _table(content)
    at = int(rng.integers(table.num_columns))
    name, rows = table.column_names[at], table.num_rows
    odd = (
        pa.array(["text"] * rows),
        pa.nulls(rows),
        pa.array([[1]] * rows),
        pa.array([2**62] * rows),
        pa.array([-7] * rows),
    )
    edits = (
        lambda: table.drop_columns([name]),
        lambda: table.append_column("another", pa.array([1] * rows)),
        lambda: table.set_column(at, name, any_of(rng, odd)),
        lambda: table.slice(0, rows // 2),
        lambda: table.slice(0, 0),
        lambda: table.rename_columns([f"{HTML[0]}{each}" for each in table.column_names]),
        lambda: pa.concat_tables([table, table]),
    )
    return _stored(any_of(rng, edits)(), content)


# ---- bombs


@by_path("bombs")
def hole_of_gigabytes(path: Path, rng: Rng) -> None:
    """A file of 5 GB that takes no room: zeros after the content, or alone."""
    replace(path, path.read_bytes() if rng.integers(2) else b"")
    os.truncate(path, _SPARSE)


@by_content("bombs", *_TEXTS)
def endless_line(content: bytes, rng: Rng) -> bytes:
    return (
        any_of(rng, (content, b"")) + any_of(rng, (b"9", b" ", b"x", b"-", b'"', b"1 ")) * 4_000_000
    )


@by_content("bombs", *_TEXTS)
def many_lines(content: bytes, rng: Rng) -> bytes:
    line = any_of(rng, (content.splitlines(keepends=True)[-1], b"\n", b"-\n"))
    return (
        content
        + (b"\n" if not content.endswith(b"\n") else b"")
        + line * min(50_000, _MOST_ADDED // len(line))
    )


@by_content("bombs", *_JSON, *_YAML)
def deep_nesting(content: bytes, rng: Rng) -> bytes:
    depth = any_of(rng, (900, 5_000, 200_000))
    nest = any_of(
        rng, (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth, b"[" * depth)
    )
    spans = [match.span() for match in _NUMBER.finditer(content)] or [(0, len(content))]
    begin, end = any_of(rng, (any_of(rng, spans), (0, len(content))))
    return content[:begin] + nest + content[end:]


@by_content("bombs", *_YAML)
def many_laughs(content: bytes, rng: Rng) -> bytes:
    levels = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    return "\n".join(["a0: &a0 [lol]", *levels, content.decode()]).encode()


@by_content("bombs", "pickle")
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
    return any_of(rng, options)


@by_content("bombs", "npz")
def archive_bomb(content: bytes, rng: Rng) -> bytes:
    """A megabyte that unpacks to 900."""
    members = members_of(content)
    name = any_of(rng, list(members))
    shape = any_of(rng, (b"(28125000, 4)", b"(900000000, 1)", b"(1, 900000000)"))
    text = b"{'descr': '%s', 'fortran_order': False, 'shape': %s, }" % (
        any_of(rng, (b"<f8", b"|u1")),
        shape,
    )
    head = b"\x93NUMPY\1\0" + struct.pack("<H", 118) + text.ljust(117) + b"\n"
    stored, checksum, size = squeezed(any_of(rng, (head, members[name])))
    return packed(
        {other: member for other, member in members.items() if other != name},
        zipfile.ZIP_STORED,
        (name, stored, checksum, size),
    )


@by_content("bombs", "image")
def image_bomb(_before: bytes, rng: Rng) -> bytes:
    """A PNG of 900 million pixels in a megabyte, or one that only says so."""
    side = any_of(rng, (30_000, 65_500))
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    rows = (
        zlib.compress(bytes((side // 8 + 1) * 2000), 1) if rng.integers(2) else zlib.compress(b"")
    )
    text = zlib.compress(bytes(50_000_000), 1)
    chunks = (
        (b"IHDR", head),
        *any_of(rng, ((), ((b"zTXt", b"a\0\0" + text),), ((b"iCCP", b"a\0\0" + text),))),
        (b"IDAT", rows),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


@by_content("bombs", "parquet")
def table_of_many_rows(content: bytes, _rng: Rng) -> bytes:
    import pyarrow as pa

    table = _table(content)
    return _stored(pa.concat_tables([table.slice(0, 1)] * 20_000).combine_chunks(), content)


# ---- links, and what is no file


def _gone(path: Path) -> Path:
    path.unlink()
    return path


@by_path("links")
def missing(path: Path, _rng: Rng) -> None:
    _gone(path)


@by_path("links")
def link_to_itself(path: Path, _rng: Rng) -> None:
    _gone(path).symlink_to(path.name)


@by_path("links")
def links_in_a_loop(path: Path, _rng: Rng) -> None:
    other = path.with_name(f"{path.stem}_other{path.suffix}")
    _gone(path).symlink_to(other.name)
    other.symlink_to(path.name)


@by_path("links")
def link_elsewhere(path: Path, rng: Rng) -> None:
    place = any_of(
        rng,
        (
            "/dev/zero",
            "/dev/urandom",
            "/dev/full",
            "/dev/tty",
            "/proc/self/mem",
            "/etc/passwd",
            "/nowhere",
            ".",
            "/",
        ),
    )
    _gone(path).symlink_to(place)


@by_path("links")
def link_to_the_same_content(path: Path, _rng: Rng) -> None:
    kept = path.with_name(f"kept {path.name}")
    path.rename(kept)
    path.symlink_to(kept.name)


@by_path("links")
def named_pipe(path: Path, _rng: Rng) -> None:
    os.mkfifo(_gone(path))


@by_path("links")
def folder_instead(path: Path, rng: Rng) -> None:
    _gone(path).mkdir()
    if rng.integers(2):
        (path / "loop").symlink_to(path)


@by_path("links")
def folder_is_a_link(path: Path, rng: Rng) -> None:
    """The folder of the file is a link to itself, to its parent, or to a device."""
    folder, kept = path.parent, path.parent.with_name(f"kept {path.parent.name}")
    folder.rename(kept)
    folder.symlink_to(any_of(rng, (folder.name, ".", "/dev/zero", kept.name)))


# ---- names

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


@by_path("names")
def neighbour_with_an_odd_name(path: Path, rng: Rng) -> None:
    """Beside the file, or beside its folder, there is one more with an odd name."""
    name = any_of(
        rng,
        (
            *ODD_NAMES,
            f"{path.stem}{path.suffix}~",
            path.stem.upper() + path.suffix,
            f"{path.stem} 2{path.suffix}",
        ),
    )
    name = name.replace("/", "∕")
    beside = any_of(rng, (path.parent, path.parent.parent))
    if (beside / name).exists():
        name += "~"
    kind = int(rng.integers(4))
    if kind == 0:
        (beside / name).mkdir()
    elif kind == 1:
        os.mkfifo(beside / name)
    elif kind == 2:
        Path(os.fsdecode(os.fsencode(beside) + b"/\xff\xfe" + path.suffix.encode())).write_bytes(
            path.read_bytes()
        )
    else:
        (beside / name[:200]).with_suffix(path.suffix).write_bytes(path.read_bytes())


@by_content("names", "text")
def word_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    begin, end = any_of(rng, [match.span() for match in re.finditer(rb"\S+", content)])
    return content[:begin] + any_of(rng, ODD_NAMES).encode() + content[end:]


@by_content("names", *_JSON)
def json_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    return _edited_json(content, rng, lambda _: any_of(rng, ODD_NAMES), only=str)


@by_content("names", *_JSON)
def json_key_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    inside = any_of(rng, [each for each in containers(tree) if each and isinstance(each, dict)])
    inside[any_of(rng, ODD_NAMES)] = inside.pop(any_of(rng, list(inside)))
    return json.dumps(tree).encode()


@by_content("names", *_YAML)
def yaml_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    tree[any_of(rng, list(tree))] = any_of(rng, ODD_NAMES)
    return yaml.safe_dump(tree).encode()


@by_content("names", "npz")
def member_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    members = members_of(content)
    members[f"{any_of(rng, ODD_NAMES)}.npy"] = members.pop(any_of(rng, list(members)))
    return packed(members, zipfile.ZIP_DEFLATED)


# ---- what several need


def containers(tree: Any) -> list[Any]:
    """Every list and mapping of a tree."""
    found, waiting = [], [tree]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict | list):
            found.append(each)
            waiting += each.values() if isinstance(each, dict) else each
    return found


def _edited_json(
    content: bytes, rng: Rng, edit: Callable[[Any], Any], only: type = object
) -> bytes:
    tree = json.loads(content)
    places = [
        (inside, key)
        for inside in containers(tree)
        for key in (list(inside) if isinstance(inside, dict) else range(len(inside)))
    ]
    fitting_ones = [(inside, key) for inside, key in places if isinstance(inside[key], only)]
    inside, key = any_of(rng, fitting_ones or places)  # a record may hold numbers alone
    inside[key] = edit(inside[key])
    return json.dumps(tree).encode()


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zipped(content: bytes, rng: Rng, change: Callable[[str, bytes], bytes]) -> bytes:
    """The archive with one member changed."""
    members = members_of(content)
    name = any_of(rng, list(members))
    members[name] = change(name, members[name])
    return packed(members, zipfile.ZIP_DEFLATED)


def _header(member: bytes, pattern: bytes, text: bytes) -> bytes:
    """A `.npy` file whose header has another text, padded as before where there is room."""
    size = struct.unpack("<H", member[8:10])[0]
    header = re.sub(pattern, lambda _: text, member[10 : 10 + size], count=1)
    header = header.rstrip(b" \n").ljust(size - 1) + b"\n"
    return member[:8] + struct.pack("<H", len(header)) + header + member[10 + size :]


def packed(
    members: dict[str, bytes], way: int, last: tuple[str, bytes, int, int] | None = None
) -> bytes:
    """An archive; the last member may be given as it is stored: name, deflated bytes, checksum and
    size.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", way) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
        if last is not None:
            name, stored, checksum, size = last
            archive.writestr(name, stored, zipfile.ZIP_STORED)
            entry = archive.getinfo(name)
            begin, head = entry.header_offset, entry.FileHeader()
            entry.compress_type, entry.CRC, entry.file_size = zipfile.ZIP_DEFLATED, checksum, size
            buffer.seek(begin)
            buffer.write(entry.FileHeader()[: len(head)])
            buffer.seek(0, io.SEEK_END)
    return buffer.getvalue()


@cache
def _zeros(count: int) -> tuple[bytes, int]:
    """So many megabytes of zeros, deflated, and how many bytes that are."""
    way = zlib.compressobj(9, zlib.DEFLATED, -15)
    way.compress(bytes(1 << 20))
    way.flush(zlib.Z_FULL_FLUSH)
    block = way.compress(bytes(1 << 20)) + way.flush(zlib.Z_FULL_FLUSH)
    return block * count, count << 20


def squeezed(head: bytes) -> tuple[bytes, int, int]:
    """Some bytes and then 900 MB of zeros, deflated; the checksum and the size."""
    way = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = way.compress(head) + way.flush(zlib.Z_FULL_FLUSH)
    zeros, size = _zeros(900)
    return start + zeros + b"\3\0", 0, len(head) + size


def _table(content: bytes) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    if content.startswith(b"PAR1"):
        return pq.read_table(io.BytesIO(content))
    return pa.ipc.open_file(io.BytesIO(content)).read_all()


def _stored(table: Any, before: bytes) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    if before.startswith(b"PAR1"):
        pq.write_table(table, buffer)
    else:
        with pa.ipc.new_file(buffer, table.schema) as writer:
            writer.write_table(table)
    return buffer.getvalue()
