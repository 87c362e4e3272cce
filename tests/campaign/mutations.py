"""What strangers do to a file: bytes, numbers, types, bombs, links and names; the same with the same seed."""

import io
import json
import os
import pickle
import re
import struct
import warnings
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
_TABLES = ("arrow", "parquet", "shard")
FORMS = ("text", "json", "yaml", "pickle", "npz", "image", *_TABLES, "jsonl", "journal", "images", "zip")
WEIGHTS_FORMS = ("safetensors", "checkpoint", "old checkpoint")
"""Forms of files that only PyTorch's users have."""
GROUPS = ("bytes", "numbers", "types", "bombs", "links", "names")
MARKER = "a pickle has run"
"""The folder beside the changed files that a pickle makes whose code is run."""
HTML = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>')
"""Texts that must not become part of a page."""
_SPARSE, _SPARSE_WEIGHTS = 3 << 30, 5 << 30
"""Bytes of a file that is mostly a hole."""
_MOST_ROWS, _MOST_BYTES = 40, 200_000
"""What a mutation that takes long keeps of an array."""
_TEXTS = ("text", "json", "yaml", "jsonl")
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class Mutation:
    """One way to change a file.

    Attributes:
        name: of the mutation.
        group: one of `GROUPS`.
        forms: the forms of files that it is made for.
        apply: changes the file at a path. Files are hard links: it replaces them, and never writes into one.
    """

    name: str
    group: str
    forms: Collection[str]
    apply: Callable[[Path, Rng], None]


MUTATIONS: dict[str, Mutation] = {}
"""By name."""


def _place(group: str, *forms: str) -> Callable[[Callable[[Path, Rng], None]], Callable[[Path, Rng], None]]:
    """Enter a function that changes what is at a path."""

    def enter(apply: Callable[[Path, Rng], None]) -> Callable[[Path, Rng], None]:
        MUTATIONS[apply.__name__] = Mutation(apply.__name__, group, forms or (*FORMS, *WEIGHTS_FORMS), apply)
        return apply

    return enter


def _content(group: str, *forms: str) -> Callable[[Change], Change]:
    """Enter a function of the file's bytes."""

    def enter(change: Change) -> Change:
        def apply(path: Path, rng: Rng) -> None:
            replace(path, change(path.read_bytes(), rng))

        MUTATIONS[change.__name__] = Mutation(change.__name__, group, forms or (*FORMS, *WEIGHTS_FORMS), apply)
        return change

    return enter


def replace(path: Path, content: bytes) -> None:
    """Put a new file in the place of another."""
    path.unlink()
    path.write_bytes(content)


def fitting(form: str, group: str) -> list[str]:
    """The names of the mutations of a group for a form, in a fixed order."""
    return sorted(name for name, each in MUTATIONS.items() if each.group == group and form in each.forms)


def _any(rng: Rng, options: Any) -> Any:
    return options[int(rng.integers(len(options)))]


def _span(content: bytes, rng: Rng) -> tuple[int, int]:
    """Begin and end of a short part."""
    begin = int(rng.integers(len(content)))
    return begin, min(len(content), begin + int(rng.integers(1, 65)))


# ---- bytes


@_content("bytes")
def bits_flipped(content: bytes, rng: Rng) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


@_content("bytes")
def bytes_overwritten(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + garbage(rng, end - begin)[: end - begin] + content[end:]


@_content("bytes")
def cut_off(content: bytes, rng: Rng) -> bytes:
    return cut(content, rng)


@_content("bytes")
def bytes_inserted(content: bytes, rng: Rng) -> bytes:
    begin, _ = _span(content, rng)
    return content[:begin] + garbage(rng, 16) + content[begin:]


@_content("bytes")
def part_removed(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + content[end:]


@_content("bytes")
def part_doubled(content: bytes, rng: Rng) -> bytes:
    begin, end = _span(content, rng)
    return content[:end] + content[begin:]


@_content("bytes")
def parts_swapped(content: bytes, rng: Rng) -> bytes:
    size = min(64, len(content) // 2)
    first = int(rng.integers(len(content) - 2 * size + 1))
    second = int(rng.integers(first + size, len(content) - size + 1))
    parts = (content[:first], content[second : second + size], content[first + size : second])
    return b"".join(parts) + content[first : first + size] + content[second + size :]


@_content("bytes")
def bytes_appended(content: bytes, rng: Rng) -> bytes:
    return content + _any(rng, (garbage(rng, 64), bytes(64), b"\n", content))


@_content("bytes")
def zeros_at_the_end(content: bytes, rng: Rng) -> bytes:
    kept = int(rng.integers(len(content)))
    return content[:kept] + bytes(len(content) - kept)


@_content("bytes")
def emptied(_before: bytes, _rng: Rng) -> bytes:
    return b""


@_content("bytes")
def all_garbage(content: bytes, rng: Rng) -> bytes:
    return garbage(rng, len(content))


@_content("bytes", *_TEXTS)
def odd_line_ends_or_marks(content: bytes, rng: Rng) -> bytes:
    mark = b"\xef\xbb\xbf"
    options = (content.replace(b"\n", b"\r\n"), content.replace(b"\n", b"\r"), mark + content, mark + mark + content)
    return _any(rng, (*options, content.replace(b"\n", b"\n" + mark, 1), content.decode().encode("utf-16")))


@_content("bytes", *_TEXTS)
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
_ODD = (b"0x10", b"1_000", b"\xd9\xa1", b"--1", b"+5", b"1e", b"010", b".5", b"0", b"-0.0", b"2147483648", b"1e-400")


@_content("numbers", *_TEXTS)
def number_replaced(content: bytes, rng: Rng) -> bytes:
    spans = [match.span() for match in _NUMBER.finditer(content)] or [(0, 0)]
    begin, end = _any(rng, spans)
    return content[:begin] + _any(rng, (*_HUGE, *_ODD)) + content[end:]


@_content("numbers", "pickle", "npz", "image", "arrow", "parquet", "shard", "images", "zip", "journal", *WEIGHTS_FORMS)
def bytes_to_a_huge_number(content: bytes, rng: Rng) -> bytes:
    number = _any(rng, (0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1 << 33, 0))
    form = _any(rng, ("<Q", ">Q") if number >= 1 << 32 else ("<I", ">I", "<Q"))
    packed = struct.pack(form, number)
    begin = _any(rng, (int(rng.integers(len(content))), int(rng.integers(min(256, len(content))))))
    return content[:begin] + packed + content[begin + len(packed) :]


@_content("numbers", "image")
def image_of_another_size(content: bytes, rng: Rng) -> bytes:
    size = _any(rng, ((65535, 65535), (0, 0), (1, 65535), (17, 9)))
    begin = re.search(rb"\xff\xc0..\x08", content, re.DOTALL).end()  # type: ignore[union-attr]
    return content[:begin] + struct.pack(">HH", *size) + content[begin + 4 :]


@_content("numbers", "npz")
def array_of_another_size(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        shape = _any(
            rng, (b"(999999999999, 4)", b"(-1, 4)", b"(4,)", b"()", b"(0, 4)", b"(1e3, 4)", b"(" * 99, b"(9" * 9)
        )
        return _header(member, rb"\([^)]*\)", shape)

    return _zipped(content, rng, change)


# ---- types

_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**63, 10**30, 1.5, float("nan"), float("inf"), "", "text", "<b>", "../..", "\0", "\ud800"),
    *([], {}, [[]], [None], {"": {}}, {"a": [1, "b"]}, [1, 2, 3], list(range(5000))),
)


@_content("types", "json")
def json_value_replaced(content: bytes, rng: Rng) -> bytes:
    return _edited_json(content, rng, lambda _: _any(rng, _VALUES))


@_content("types", "json")
def json_key_lost_or_added(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    inside = _any(rng, [each for each in _containers(tree) if each])
    if isinstance(inside, list):
        del inside[int(rng.integers(len(inside)))]
    elif rng.integers(2):
        del inside[_any(rng, list(inside))]
    else:
        inside["another"] = _any(rng, _VALUES)
    return json.dumps(tree).encode()


@_content("types", "json")
def json_key_twice(content: bytes, rng: Rng) -> bytes:
    spans = [match.span() for match in re.finditer(rb'"[^"]+":', content)]
    begin, end = _any(rng, spans)
    return content[:begin] + content[begin:end] + b" 7, " + content[begin:]


@_content("types", "json", "yaml")
def another_top(_before: bytes, rng: Rng) -> bytes:
    return _any(rng, (b"[]", b"{}", b"null", b"1", b'"text"', b"[" * 50 + b"]" * 50, b"{}{}", b"NaN", b"true"))


@_content("types", "yaml")
def yaml_value_replaced(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    inside = _any(rng, [each for each in _containers(tree) if each])
    inside[_any(rng, list(inside) if isinstance(inside, dict) else range(len(inside)))] = _any(
        rng, _VALUES[:14] + _VALUES[15:]
    )
    return yaml.safe_dump(tree).encode("utf-8", "surrogatepass")


@_place("types", "yaml")
def yaml_tags(path: Path, rng: Rng) -> None:
    made = json.dumps(str(path.parent / MARKER)).encode()
    tags = (b"!!python/object/apply:os.mkdir [" + made + b"]", b"!!python/name:os.system", b"!!binary aGk=", b"!!int x")
    odd = (b"!!set {a, b}", b"!!timestamp 2001-01-01", b"*unknown", b"&a [*a]", b"{? [a] : b}", b"0o7", b"1:30")
    lines = path.read_bytes().splitlines()
    at = _any(rng, [number for number, line in enumerate(lines) if b": " in line and b"{" not in line])
    lines[at] = lines[at].split(b": ")[0] + b": " + _any(rng, (*tags, *odd))
    replace(path, b"\n".join(lines) + b"\n")


@_place("types", "pickle")
def pickle_runs_code(path: Path, rng: Rng) -> None:
    arrays = pickle.loads(path.read_bytes())
    arrays[_any(rng, [*arrays, "extra"])] = Bomb(path.parent / MARKER)
    replace(path, pickle.dumps(arrays, protocol=int(rng.integers(6))))


@_content("types", "pickle")
def pickle_of_other_things(content: bytes, rng: Rng) -> bytes:
    arrays = pickle.loads(content)
    key = _any(rng, list(arrays))
    here = arrays[key]
    odd = (here.astype("c8"), here.astype("f2"), here.astype(">f8"), here.astype("i4"), here.astype(object), here[0])
    more = (here.tolist(), str(here), np.asfortranarray(here), here[None], np.ma.array(here), None, np.float64(1), b"")
    arrays[key] = _any(rng, (*odd, *more, np.zeros(here.shape, "M8[s]"), np.full(here.shape, np.nan), here * 1e300))
    return pickle.dumps(arrays, protocol=int(rng.integers(6)))


@_content("types", "pickle")
def pickle_asks_for_a_name(content: bytes, rng: Rng) -> bytes:
    names = (
        b"os\nsystem",
        b"builtins\neval",
        b"builtins\nexec",
        b"subprocess\nPopen",
        b"numpy\nload",
        b"copyreg\n_reconstructor",
    )
    name = _any(
        rng, (*names, b"numpy\nfromfile", b"numpy.core.multiarray\nfrombuffer", b"posix\nfork", b"\n", b"a.b\nc.d")
    )
    end = _any(rng, (b"(S'ls'\ntR.", b".", b"(tR.", b"}b.", b")\x81.", b"0" + content))
    return _any(rng, (b"", b"\x80\x04")) + b"c" + name + b"\n" + end


@_content("types", "npz")
def array_of_another_type(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        array = np.atleast_1d(np.lib.format.read_array(io.BytesIO(member)))[:_MOST_ROWS]
        kinds = ("c16", "?", "U3", "S3", "M8[s]", "f2", ">f8", "i1", "u8", "O", "V8")
        odd = np.full(array.shape, 1).astype(_any(rng, kinds))
        fields = np.zeros(array.shape, [("a", "f8"), ("b", "O" if rng.integers(2) else "i4")])
        turned = np.asfortranarray(array.T if rng.integers(2) else array)
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, _any(rng, (odd, fields, turned, array[..., None], array[:0], array.ravel())))
        return buffer.getvalue()

    return _zipped(content, rng, change)


@_content("types", "npz")
def array_with_another_header(content: bytes, rng: Rng) -> bytes:
    def change(name: str, member: bytes) -> bytes:
        version = _any(rng, (b"\x02\x00", b"\x03\x00", b"\x09\x09"))
        text = _any(
            rng, (b"'|O'", b"'<f9'", b"'<U99999999'", b"[('a', '<f8')]", b"__import__('os')", b"{}", b"'f8,f8'")
        )
        edits = (_header(member, rb"'[<>|=][a-zA-Z]\d+'", text), member[:6] + version + member[8:], member[10:])
        return _any(rng, (*edits, _header(member, rb"False", b"True"), _header(member, rb"'shape'", b"'shapes'")))

    return _zipped(content, rng, change)


@_content("types", "npz")
def archive_of_other_members(content: bytes, rng: Rng) -> bytes:
    members = _members(content)
    name = _any(rng, list(members))
    choice = int(rng.integers(5))
    if choice == 0:
        del members[name]
    elif choice == 1:
        members = {f"../{name}": member for name, member in members.items()}
    elif choice == 2:
        members["another.npy"] = members[name]
    elif choice == 3:
        members[name] = garbage(rng, 100)
    members = {name: member[:_MOST_BYTES] for name, member in members.items()}
    packed = _packed(
        members, _any(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    )
    return packed if choice != 4 else packed.replace(zlib.crc32(members[name]).to_bytes(4, "little"), b"\1\2\3\4")


@_content("types", "npz", "zip", "checkpoint")
def archive_that_lies(content: bytes, rng: Rng) -> bytes:
    """A field of the archive's directory or of a local header is another."""
    at = _any(rng, [match.start() for match in re.finditer(rb"PK(?:\x01\x02|\x03\x04|\x05\x06)", content)])
    at += int(rng.integers(4, 40))
    return content[:at] + _any(rng, (b"\xff\xff", b"\1\0", b"\x63\0", b"\0\0")) + content[at + 2 :]


@_content("types", "image")
def image_of_another_format(content: bytes, rng: Rng) -> bytes:
    from PIL import Image

    form = _any(rng, ("PNG", "GIF", "TIFF", "BMP", "WEBP", "PPM", "EPS", "ICO", "TGA", "PDF"))
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(content)) as image:
        (image if rng.integers(2) else image.convert("L")).convert("RGB").save(buffer, form)
    return buffer.getvalue()


@_content("types", "arrow", "parquet")
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
        lambda: table.set_column(at, name, _any(rng, odd)),
        lambda: table.slice(0, rows // 2),
        lambda: table.slice(0, 0),
        lambda: table.rename_columns([f"{HTML[0]}{each}" for each in table.column_names]),
        lambda: pa.concat_tables([table, table]),
    )
    return _stored(_any(rng, edits)(), content)


# ---- bombs


@_place("bombs")
def hole_of_gigabytes(path: Path, rng: Rng) -> None:
    """A file of 3 GB, of weights 5 GB, that takes no room: zeros after the content, or alone."""
    replace(path, path.read_bytes() if rng.integers(2) else b"")
    os.truncate(path, _SPARSE_WEIGHTS if path.suffix in (".pt", ".pth", ".safetensors") else _SPARSE)


@_content("bombs", *_TEXTS)
def endless_line(content: bytes, rng: Rng) -> bytes:
    return _any(rng, (content, b"")) + _any(rng, (b"9", b" ", b"x", b"-", b'"', b"1 ")) * 4_000_000


@_content("bombs", *_TEXTS)
def many_lines(content: bytes, rng: Rng) -> bytes:
    lines = content.splitlines(keepends=True)
    return content + (b"\n" if not content.endswith(b"\n") else b"") + _any(rng, (lines[-1], b"\n", b"-\n")) * 50_000


@_content("bombs", "json", "yaml", "jsonl")
def deep_nesting(content: bytes, rng: Rng) -> bytes:
    depth = _any(rng, (900, 5_000, 200_000))
    nest = _any(rng, (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth, b"[" * depth))
    spans = [match.span() for match in _NUMBER.finditer(content)] or [(0, len(content))]
    begin, end = _any(rng, (_any(rng, spans), (0, len(content))))
    return content[:begin] + nest + content[end:]


@_content("bombs", "yaml")
def many_laughs(content: bytes, rng: Rng) -> bytes:
    levels = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10)]
    return "\n".join(["a0: &a0 [lol]", *levels, content.decode()]).encode()


@_content("bombs", "pickle")
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
    return _any(rng, options)


@_content("bombs", "npz")
def archive_bomb(content: bytes, rng: Rng) -> bytes:
    """A megabyte that unpacks to 900."""
    members = _members(content)
    name = _any(rng, list(members))
    shape = _any(rng, (b"(28125000, 4)", b"(900000000, 1)", b"(1, 900000000)"))
    text = b"{'descr': '%s', 'fortran_order': False, 'shape': %s, }" % (_any(rng, (b"<f8", b"|u1")), shape)
    head = b"\x93NUMPY\1\0" + struct.pack("<H", 118) + text.ljust(117) + b"\n"
    squeezed, checksum, size = _squeezed(_any(rng, (head, members[name])))
    return _packed(
        {other: member for other, member in members.items() if other != name},
        zipfile.ZIP_STORED,
        (name, squeezed, checksum, size),
    )


@_content("bombs", "image")
def image_bomb(_before: bytes, rng: Rng) -> bytes:
    """A PNG of 900 million pixels in a megabyte, or one that only says so."""
    side = _any(rng, (30_000, 65_500))
    head = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    rows = zlib.compress(bytes((side // 8 + 1) * 2000), 1) if rng.integers(2) else zlib.compress(b"")
    text = zlib.compress(bytes(50_000_000), 1)
    chunks = (
        (b"IHDR", head),
        *_any(rng, ((), ((b"zTXt", b"a\0\0" + text),), ((b"iCCP", b"a\0\0" + text),))),
        (b"IDAT", rows),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


@_content("bombs", "parquet")
def table_of_many_rows(content: bytes, _rng: Rng) -> bytes:
    import pyarrow as pa

    table = _table(content)
    return _stored(pa.concat_tables([table.slice(0, 1)] * 20_000).combine_chunks(), content)


# ---- links, and what is no file


def _gone(path: Path) -> Path:
    path.unlink()
    return path


@_place("links")
def missing(path: Path, _rng: Rng) -> None:
    _gone(path)


@_place("links")
def link_to_itself(path: Path, _rng: Rng) -> None:
    _gone(path).symlink_to(path.name)


@_place("links")
def links_in_a_loop(path: Path, _rng: Rng) -> None:
    other = path.with_name(f"{path.stem}_other{path.suffix}")
    _gone(path).symlink_to(other.name)
    other.symlink_to(path.name)


@_place("links")
def link_elsewhere(path: Path, rng: Rng) -> None:
    place = _any(
        rng,
        ("/dev/zero", "/dev/urandom", "/dev/full", "/dev/tty", "/proc/self/mem", "/etc/passwd", "/nowhere", ".", "/"),
    )
    _gone(path).symlink_to(place)


@_place("links")
def link_to_the_same_content(path: Path, _rng: Rng) -> None:
    kept = path.with_name(f"kept {path.name}")
    path.rename(kept)
    path.symlink_to(kept.name)


@_place("links")
def named_pipe(path: Path, _rng: Rng) -> None:
    os.mkfifo(_gone(path))


@_place("links")
def folder_instead(path: Path, rng: Rng) -> None:
    _gone(path).mkdir()
    if rng.integers(2):
        (path / "loop").symlink_to(path)


@_place("links")
def folder_is_a_link(path: Path, rng: Rng) -> None:
    """The folder of the file is a link to itself, to its parent, or to a device."""
    folder, kept = path.parent, path.parent.with_name(f"kept {path.parent.name}")
    folder.rename(kept)
    folder.symlink_to(_any(rng, (folder.name, ".", "/dev/zero", kept.name)))


# ---- names

_NAMES = (
    *HTML,
    "a\nb",
    "\x1b[31mred",
    "x" * 250,
    "名前",
    "$(touch ran)",
    "; rm -r x",
    "%s{0}",
    "-rf",
)


@_place("names")
def neighbour_with_an_odd_name(path: Path, rng: Rng) -> None:
    """Beside the file, or beside its folder, there is one more with an odd name."""
    name = _any(
        rng, (*_NAMES, f"{path.stem}{path.suffix}~", path.stem.upper() + path.suffix, f"{path.stem} 2{path.suffix}")
    )
    name = name.replace("/", "∕")
    beside = _any(rng, (path.parent, path.parent.parent))
    if (beside / name).exists():
        name += "~"
    kind = int(rng.integers(4))
    if kind == 0:
        (beside / name).mkdir()
    elif kind == 1:
        os.mkfifo(beside / name)
    elif kind == 2:
        Path(os.fsdecode(os.fsencode(beside) + b"/\xff\xfe" + path.suffix.encode())).write_bytes(path.read_bytes())
    else:
        (beside / name[:200]).with_suffix(path.suffix).write_bytes(path.read_bytes())


@_content("names", "text")
def word_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    begin, end = _any(rng, [match.span() for match in re.finditer(rb"\S+", content)])
    return content[:begin] + _any(rng, _NAMES).encode() + content[end:]


@_content("names", "json")
def json_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    return _edited_json(content, rng, lambda _: _any(rng, _NAMES), only=str)


@_content("names", "json")
def json_key_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    inside = _any(rng, [each for each in _containers(tree) if each and isinstance(each, dict)])
    inside[_any(rng, _NAMES)] = inside.pop(_any(rng, list(inside)))
    return json.dumps(tree).encode()


@_content("names", "yaml")
def yaml_text_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    tree[_any(rng, list(tree))] = _any(rng, _NAMES)
    return yaml.safe_dump(tree).encode()


@_content("names", "npz")
def member_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    members = _members(content)
    members[f"{_any(rng, _NAMES)}.npy"] = members.pop(_any(rng, list(members)))
    return _packed(members, zipfile.ZIP_DEFLATED)


# ---- lines of JSON, journals, archives of releases, weights


def _one_line(content: bytes, rng: Rng, change: Callable[[bytes, Rng], bytes]) -> bytes:
    """A file of lines in which one is changed as a JSON file."""
    lines = content.splitlines()
    at = int(rng.integers(len(lines)))
    lines[at] = change(lines[at], rng)
    return b"\n".join(lines) + b"\n"


@_content("types", "jsonl")
def line_with_another_value(content: bytes, rng: Rng) -> bytes:
    return _one_line(content, rng, json_value_replaced)


@_content("types", "jsonl")
def line_with_other_keys(content: bytes, rng: Rng) -> bytes:
    return _one_line(content, rng, _any(rng, (json_key_lost_or_added, json_key_twice, another_top)))


@_content("names", "jsonl")
def line_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    return _one_line(content, rng, _any(rng, (json_text_with_an_odd_name, json_key_with_an_odd_name)))


def outside(path: Path) -> Path:
    """The folder beside the case that nobody may touch, from a file of the case."""
    return next(each / "outside" for each in path.absolute().parents if (each / "outside").is_dir())


@_place("types", "journal")
def journal_names_what_is_outside(path: Path, rng: Rng) -> None:
    """Lines with paths out of the folder, into its own files, or through links that lie there."""
    there = outside(path)
    root = path.parents[2]
    link = root / _any(rng, ("answers", "zz"))
    link.symlink_to(_any(rng, (there, there / "folder")))
    odd = (
        f"{there}/precious.txt",
        "../" * 6 + "outside/precious.txt",
        f"{link.relative_to(root)}/precious.txt",
        f"{link.relative_to(root)}/folder",
        str(link.relative_to(root)),
        ".",
        "",
        "..",
        "questions.manifest.json",
        ".deepaccident.lock",
        "a" * 5000,
        "\udcff",
        "zz/../../outside/precious.txt",
    )
    noted = "".join(f"{_any(rng, odd)}\0" for _ in range(4)).encode("utf-8", "surrogateescape")
    replace(path, noted + (path.read_bytes() if rng.integers(2) else b""))


@_place("links", "journal", "json", "images")
def folder_leads_outside(path: Path, rng: Rng) -> None:
    """A folder above the file, or a lock or part beside it, is a link to what is outside."""
    there = outside(path)
    kind = int(rng.integers(3))
    if kind == 0:
        _gone(path).symlink_to(there / "precious.txt")
    elif kind == 1:
        folder = path.parent
        folder.rename(folder.with_name(f"kept {folder.name}"))
        folder.symlink_to(there)
    else:
        lock = path.parent / ".deepaccident.lock"
        lock.unlink(missing_ok=True)
        lock.symlink_to(there / "precious.txt")


@_content("names", "json")
def endless_text(content: bytes, rng: Rng) -> bytes:
    """A text or a key of 5 MB, or one that would change a terminal."""
    text = _any(rng, ("x" * 5_000_000, "\x1b]0;title\x07\x1b[2J", "\u202egnp.exe", "\r" * 100))
    if rng.integers(2):
        return _edited_json(content, rng, lambda _: text, only=str)
    tree = json.loads(content)
    inside = _any(rng, [each for each in _containers(tree) if each and isinstance(each, dict)])
    inside[text] = inside.pop(_any(rng, list(inside)))
    return json.dumps(tree).encode()


@_content("types", "zip")
def members_of_other_names(content: bytes, rng: Rng) -> bytes:
    """Backslashes, ways out, links, several of one name, folders of other names."""
    members = _members(content)
    name = _any(rng, list(members))
    choice = int(rng.integers(6))
    if choice == 0:
        return _packed({each.replace("/", "\\"): member for each, member in members.items()}, zipfile.ZIP_STORED)
    if choice == 1:
        members[f"../../{name}"] = members[name]
    elif choice == 2:
        members[f"/{name}"] = members.pop(name)
    elif choice == 3:
        members[f"C:\\{name}"] = members[name]
    elif choice == 4:
        members[f"{name}/inside"] = b""
    else:
        members = {f"deep/{each}": member for each, member in members.items()}
    return _packed(members, _any(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


@_content("types", "zip")
def members_twice_linked_or_locked(content: bytes, rng: Rng) -> bytes:
    members = _members(content)
    name = _any(rng, list(members))
    buffer = io.BytesIO(content)
    with zipfile.ZipFile(buffer, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        entry = zipfile.ZipInfo(name if rng.integers(2) else f"{name}.link")
        entry.create_system, entry.external_attr = 3, _any(rng, (0o120777, 0o010644, 0o100644)) << 16
        archive.writestr(entry, _any(rng, (b"/etc/passwd", b"../../../etc/passwd", members[name])))
    changed = bytearray(buffer.getvalue())
    if rng.integers(2):  # said to be encrypted
        at = changed.rfind(b"PK\x01\x02")
        changed[at + 8] |= 1
    return bytes(changed)


@_content("bombs", "zip")
def release_that_unpacks_to_gigabytes(content: bytes, rng: Rng) -> bytes:
    members = _members(content)
    name = _any(rng, list(members))
    squeezed, checksum, size = _squeezed(members[name][: int(rng.integers(1, 2000))])
    rest = {other: member for other, member in members.items() if other != name}
    return _packed(rest, zipfile.ZIP_STORED, (name, squeezed, checksum, size))


@_content("numbers", "jsonl", "images")
def numbers_of_another_size(content: bytes, rng: Rng) -> bytes:
    """In the head: rows, cameras, begins and lengths; in text: a number of 5,000 digits, and others."""
    if not content.startswith(b"DAimages"):
        return number_replaced(content, rng)
    at = 8 + 8 * int(rng.integers(4))
    value = _any(rng, (-1, 0, 1, 2, 1 << 31, 1 << 40, (1 << 63) - 1, -(1 << 63)))
    return content[:at] + struct.pack("<q", value) + content[at + 8 :]


@_content("types", "safetensors")
def header_of_other_things(content: bytes, rng: Rng) -> bytes:
    """The header says other types, shapes, places or notes."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    name = _any(rng, list(header))
    tensor = _any(rng, [each for each in header if each != "__metadata__"])
    choice = int(rng.integers(6))
    if choice == 0:
        header[tensor]["dtype"] = _any(rng, ("F8_E4M3", "C64", "F4", "U16", "x", "BOOL", "F64", 7, None))
    elif choice == 1:
        header[tensor]["shape"] = _any(rng, ([1 << 40], [0, 1 << 62], [-1], [1.5], "2", [1] * 100, [2, 2]))
    elif choice == 2:
        header[tensor]["data_offsets"] = _any(rng, ([0, 1 << 40], [8, 0], [0, 0], ["0", "4"], [0]))
    elif choice == 3:
        header[_any(rng, (*_NAMES, "x" * 5_000_000, "optimizer.x.y", "optimizer.99.exp_avg", ""))] = header.pop(name)
    elif choice == 4:
        header["__metadata__"] = _any(rng, ({"deepaccident": "[]"}, {"deepaccident": "{" * 100_000}, {"a": 1}, [], {}))
    else:
        notes = json.loads(header["__metadata__"]["deepaccident"])
        key = _any(rng, ("step", "best", "preset"))
        notes[key] = _any(rng, (*_VALUES, "x" * 5_000_000, -5, 10**18))
        header["__metadata__"]["deepaccident"] = json.dumps(notes)
    text = json.dumps(header, ensure_ascii=True).encode()
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


@_content("types", "checkpoint", "old checkpoint")
def tensors_that_no_weights_have(content: bytes, rng: Rng) -> bytes:
    from campaign.weights import hostile_tensors, saved

    return saved({"state_dict": hostile_tensors(rng)}, old=not content.startswith(b"PK"))


@_place("bombs", "checkpoint", "old checkpoint")
def checkpoint_asks_for_memory_or_code(path: Path, rng: Rng) -> None:
    from campaign.weights import hostile_pickle

    asked, content = hostile_pickle(path.parent / MARKER, rng), path.read_bytes()
    if not content.startswith(b"PK"):
        replace(path, _any(rng, (asked, content[:63] + asked, content.replace(b"}q", asked[2:] + b"}q", 1))))
        return
    members = {name: asked if name.endswith("data.pkl") else each for name, each in _members(content).items()}
    replace(path, _packed(members, zipfile.ZIP_STORED))


@_content("bombs", "checkpoint")
def compressed_storages(content: bytes, rng: Rng) -> bytes:
    """Some hundred bytes that unpack to 900 MB in the place of numbers."""
    members = _members(content)
    name = _any(rng, [each for each in members if "/data/" in each])
    squeezed, checksum, size = _squeezed(members[name])
    rest = {other: member for other, member in members.items() if other != name}
    return _packed(rest, zipfile.ZIP_STORED, (name, squeezed, checksum, size))


# ---- what several need


def _containers(tree: Any) -> list[Any]:
    """Every list and mapping of a tree."""
    found, waiting = [], [tree]
    while waiting:
        each = waiting.pop()
        if isinstance(each, dict | list):
            found.append(each)
            waiting += each.values() if isinstance(each, dict) else each
    return found


def _edited_json(content: bytes, rng: Rng, edit: Callable[[Any], Any], only: type = object) -> bytes:
    tree = json.loads(content)
    places = [
        (inside, key)
        for inside in _containers(tree)
        for key in (list(inside) if isinstance(inside, dict) else range(len(inside)))
        if isinstance(inside[key], only)
    ]
    inside, key = _any(rng, places)
    inside[key] = edit(inside[key])
    return json.dumps(tree).encode()


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zipped(content: bytes, rng: Rng, change: Callable[[str, bytes], bytes]) -> bytes:
    """The archive with one member changed."""
    members = _members(content)
    name = _any(rng, list(members))
    members[name] = change(name, members[name])
    return _packed(members, zipfile.ZIP_DEFLATED)


def _header(member: bytes, pattern: bytes, text: bytes) -> bytes:
    """A `.npy` file whose header has another text, padded as before where there is room."""
    size = struct.unpack("<H", member[8:10])[0]
    header = re.sub(pattern, lambda _: text, member[10 : 10 + size], count=1)
    header = header.rstrip(b" \n").ljust(size - 1) + b"\n"
    return member[:8] + struct.pack("<H", len(header)) + header + member[10 + size :]


def _packed(members: dict[str, bytes], way: int, squeezed: tuple[str, bytes, int, int] | None = None) -> bytes:
    """An archive; the last member may be given as it is stored: name, deflated bytes, checksum and size."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", way) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
        if squeezed is not None:
            name, stored, checksum, size = squeezed
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


def _squeezed(head: bytes) -> tuple[bytes, int, int]:
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
