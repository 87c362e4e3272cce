"""Mutations of exports, recipes, questions, caches, addresses of schedulers and archives."""

import io
import json
import math
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from campaign.mutations import (
    ODD_NAMES,
    JsonObject,
    Rng,
    choose,
    choose_container,
    choose_index,
    choose_place,
    content_mutation,
    deflate_with_zeros,
    find_outside_folder,
    list_places,
    nest_deeply,
    path_mutation,
    read_members,
    replace_bytes,
    replace_file,
)

_EXPORT_FILES = ("manifest", "journal", "record")
_LONG_TEXT_BYTES = 5_000_000
_IMAGES_HEADER_BYTES = 24
_DIRECTORY_ENTRY_BYTES = 46
"""Length of an entry of a zip directory without its name, extra field and comment."""
Member = tuple[zipfile.ZipInfo, bytes]
"""Entry in the directory of an archive, and the unpacked bytes."""


# ---- exports: links and paths that lead out


def find_export(path: Path) -> Path:
    """Return the folder of the export that a file belongs to."""
    for folder in path.parents:
        if any(folder.glob("*.manifest.json")):
            return folder
    raise LookupError(path)


@path_mutation("links", *_EXPORT_FILES)
def link_out_of_the_export(path: Path, rng: Rng) -> None:
    """Replace something below the export by a link to a folder or a file outside."""
    paths = [other for other in sorted(find_export(path).rglob("*")) if other != path]
    link = choose(rng, paths)
    outside = find_outside_folder(path)
    link.rename(outside.with_name("aside"))
    targets = (outside, outside / "kept.txt", outside / "folder", outside / "new")
    link.symlink_to(choose(rng, targets))


@path_mutation("links", *_EXPORT_FILES, "images")
def temporary_link_out(path: Path, rng: Rng) -> None:
    """Add a link to the outside, under a temporary name of a dead process."""
    outside = find_outside_folder(path)
    dead_file = next(outside.glob(".*.tmp"))
    export_folders = [folder for folder in path.parents if folder.name == "begun"]
    folder = choose(rng, [path.parent, *export_folders])
    targets = (outside, outside / "kept.txt", outside / "folder")
    (folder / dead_file.name).symlink_to(choose(rng, targets))


def _paths_outside(path: Path) -> tuple[str, ...]:
    """Return paths that lead out of the export of a file, some of them by a new link."""
    export = find_export(path)
    outside = find_outside_folder(path)
    relative = os.path.relpath(outside, export)
    (export / "linked").symlink_to(outside)
    return (
        f"{relative}/kept.txt",
        f"{relative}/folder",
        f"{relative}/folder/inner.txt",
        f"{relative}/.",
        f"{relative}/",
        f"{outside}/kept.txt",
        f"{outside}/folder",
        f"{outside}/",
        "linked/kept.txt",
        "linked/folder",
        "linked/folder/inner.txt",
        f"a/../{relative}/kept.txt",
        f"./{relative}",
        "..",
        "../..",
        "linked",
        f"//{outside}/kept.txt",
        f"{relative}//folder",
    )


def _join_journal(paths: list[str]) -> bytes:
    return "".join(f"{path}\0" for path in paths).encode("utf-8", "surrogatepass")


@path_mutation("links", "journal")
def journal_that_leads_out(path: Path, rng: Rng) -> None:
    paths = _paths_outside(path)
    count = rng.integers(1, 6)
    lines = [choose(rng, paths) for _ in range(count)]
    begin = path.read_bytes() if rng.integers(2) else b""
    replace_file(path, begin + _join_journal(lines))


@content_mutation("names", "journal")
def journal_of_odd_names(content: bytes, rng: Rng) -> bytes:
    options = (
        *ODD_NAMES,
        "",
        ".",
        "/",
        "//",
        "~",
        "\\..\\x",
        "x" * 300,
        "\ud800",
        "C:\\x",
        ".deepaccident-parts",
        "*",
    )
    count = rng.integers(1, 9)
    names = [choose(rng, options) for _ in range(count)]
    return content + _join_journal(names)


@content_mutation("bombs", "journal")
def journal_of_many_or_long_paths(content: bytes, rng: Rng) -> bytes:
    name = b"x" * _LONG_TEXT_BYTES
    deep_path = b"a/" * 100_000
    no_paths = b"\0" * _LONG_TEXT_BYTES
    options = (name, b"x/y\0" * 20_000, no_paths, deep_path, deep_path + b"\0", name + b"\0")
    return content + choose(rng, options)


@content_mutation("numbers", "journal")
def journal_without_ends(content: bytes, rng: Rng) -> bytes:
    options = (
        content.replace(b"\0", b"\n"),
        content.rstrip(b"\0"),
        content.replace(b"\0", b"\0\0"),
        b"\0" + content,
    )
    return choose(rng, options)


@content_mutation("types", "journal")
def journal_of_another_unit(content: bytes, rng: Rng) -> bytes:
    """Write the paths in another order, twice or in another encoding, or write no paths."""
    paths = content.split(b"\0")[:-1]
    rng.shuffle(paths)  # type: ignore[arg-type]
    shuffled = b"".join(path + b"\0" for path in paths)
    other_encoding = content.decode().encode("utf-16")
    options = (shuffled, content * 2, other_encoding, b"\xff\xfe\0" + content, b"[]", b"{}")
    return choose(rng, options)


# ---- recipes of studies

_ODD_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    3.5,
    1e9,
    1e300,
    math.inf,
    math.nan,
    10**18,
    10**30,
    "",
    "x",
    "\0",
    [],
    [1],
    [[1]],
    {},
)
"""Values that replace others."""
_MANY_ENTRIES = 3_000


def _dump_recipe(tree: Any) -> bytes:
    return yaml.safe_dump(tree, sort_keys=False).encode("utf-8", "surrogatepass")


@content_mutation("types", "recipe")
def recipe_value_of_another_type(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    places = list_places(tree)
    for _ in range(rng.integers(1, 4)):
        container, key = choose(rng, places)
        container[key] = choose(rng, _ODD_VALUES)
    return _dump_recipe(tree)


@content_mutation("types", "recipe")
def recipe_key_added_or_left_out(content: bytes, rng: Rng) -> bytes:
    """Remove a key, or add one that recipes know to a place where it does not belong."""
    tree = yaml.safe_load(content)
    keys = {str(key) for _, key in list_places(tree)}
    keys |= {"mix", "also_split", "file", "spec", "validation", "over", "name"}
    container = choose_container(rng, tree, dict)
    if rng.integers(2):
        value = choose(rng, (*_ODD_VALUES, "test", "train", {"release": "test"}))
        container[choose(rng, sorted(keys))] = value
    else:
        del container[choose(rng, list(container))]
    return _dump_recipe(tree)


@content_mutation("numbers", "recipe")
def recipe_number_beyond_bounds(content: bytes, rng: Rng) -> bytes:
    tree = yaml.safe_load(content)
    container, key = choose_place(rng, tree, int | float)
    numbers = (0, -1, 1e9, -1e9, 1e300, 10**12, 10**40, 0.1 + 1e-9, math.inf, -math.inf, math.nan)
    container[key] = choose(rng, numbers)
    return _dump_recipe(tree)


@content_mutation("bombs", "recipe")
def recipe_multiplied(content: bytes, rng: Rng) -> bytes:
    """Give several keys of a row lists of many values each."""
    tree = yaml.safe_load(content)
    count = choose(rng, (10, 100, 1000))
    row = {"name": "{latency} {agents}", "baseline": "standing", "agents": ["all"] * count}
    for key in ("latency", "pose_noise", "packet_loss", "horizon"):
        row[key] = [float(value) for value in range(count)]
    tree["rows"] = choose(rng, ([row], [*tree["rows"], row], [row] * 20))
    return _dump_recipe(tree)


@content_mutation("bombs", "recipe")
def recipe_of_many(content: bytes, rng: Rng) -> bytes:
    """Add thousands of rows, weights, releases, groups, pairs or seeds, or a very long text."""
    tree = yaml.safe_load(content)
    row = tree["rows"][-1]
    name = choose(rng, ("a", "\u202e", "n" * 20))
    names = [f"{name}{number}" for number in range(_MANY_ENTRIES)]
    releases = {release: {"scenarios": 2} for release in names}
    options = (
        ("rows", [{**row, "name": row_name} for row_name in names]),
        ("weights", {weights: {"file": "tiny"} for weights in names}),
        ("releases", {**tree["releases"], **releases}),
        ("groups", {group: ["town=Town03"] for group in names}),
        ("compare", [[row["name"], row["name"]]] * _MANY_ENTRIES),
        ("seeds", list(range(_MANY_ENTRIES))),
        ("by", ["impact_step"] * _MANY_ENTRIES),
        ("title", name * 50_000),
        ("test", {**tree["test"], "where": [f"town={name * 30_000}"]}),
        ("rows", [{**row, "name": name * 4_000}] * 10),
    )
    key, value = choose(rng, options)
    return _dump_recipe({**tree, key: value})


@content_mutation("names", "recipe")
def recipe_name_that_is_not_there(content: bytes, rng: Rng) -> bytes:
    """Replace a text by its capital letters, by that of something else, or by an odd name."""
    tree = yaml.safe_load(content)
    container, key = choose_place(rng, tree, str)
    other_container, other_key = choose_place(rng, tree, str)
    text = container[key]
    other_text = other_container[other_key]
    container[key] = choose(rng, (text.upper(), other_text, f"{text} ", *ODD_NAMES))
    return _dump_recipe(tree)


# ---- JSON: settings, notes, addresses


@content_mutation("bombs", "manifest", "record")
def long_setting(content: bytes, rng: Rng) -> bytes:
    """Write a value or a key of 5 MB, perhaps of control characters."""
    tree = json.loads(content)
    container = choose_container(rng, tree, dict)
    text = choose(rng, ("x", "\x1b[2J", "\u202e", "\x9b1m", "<b>")) * (_LONG_TEXT_BYTES // 4)
    key = choose(rng, list(container))
    if rng.integers(2):
        container[key] = choose(rng, (text, [text], {text: text}))
    else:
        container[text] = container.pop(key)
    return json.dumps(tree, ensure_ascii=bool(rng.integers(2))).encode()


@content_mutation("names", "manifest", "record")
def scenario_with_another_name(content: bytes, rng: Rng) -> bytes:
    """Replace a scenario's token by another one, which may lead elsewhere."""
    texts = content.split(b'"')
    token = next((text for text in texts if b"scenario0" in text), b"scenarios")
    names = (
        b"../../outside/kept",
        b"/etc/passwd",
        b"..",
        b"",
        b"\\u001b[31mred",
        b"\\u202ex",
        b"type1/x",
        b"x" * 5000,
    )
    return content.replace(token, choose(rng, names))


@content_mutation("bombs", "address")
def long_address(_content: bytes, rng: Rng) -> bytes:
    """Return an address of 50 MB, or a list of many addresses."""
    text = choose(rng, ("9", "x", "[", "%", "\x1b[2J", "\u202e"))
    count = 50_000_000 // len(text)
    long = f"tcp://127.0.0.1:{text * count}"
    address = choose(rng, (long, long, [long[:100]] * 100_000, "://" * 100_000))
    tree = {"type": "Scheduler", "address": address}
    return json.dumps(tree, ensure_ascii=bool(rng.integers(2))).encode()


@content_mutation("types", "address")
def address_of_another_kind(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    addresses = (
        1,
        None,
        True,
        [],
        {},
        ["tcp://127.0.0.1:1"],
        "",
        "x",
        "127.0.0.1:1",
        "tcp://",
        "tcp://127.0.0.1",
        "inproc://1/2/3",
        "file:///etc/passwd",
        "tls://127.0.0.1:1",
        "ucx://127.0.0.1:1",
        "ws://127.0.0.1:1",
        "tcp://127.0.0.1:99999",
        "tcp://127.0.0.1:-1",
        "tcp://[::1]:1",
        "tcp://a b:1",
        "x://y\n\x1b[31m",
    )
    tree["address"] = choose(rng, addresses)
    return json.dumps(tree).encode()


# ---- lines of JSON


@content_mutation("types", "lines")
def line_of_other_values(content: bytes, rng: Rng) -> bytes:
    values = (
        None,
        True,
        -1,
        2**63,
        10**30,
        1.5,
        "",
        "text",
        "../..",
        "\0",
        [],
        {},
        [[]],
        {"a": 1},
        [None],
        list(range(5000)),
    )

    def edit(line: JsonObject) -> None:
        key = choose(rng, list(line))
        line[key] = choose(rng, values)

    return _edit_line(content, rng, edit)


@content_mutation("types", "lines")
def line_without_a_key(content: bytes, rng: Rng) -> bytes:
    def edit(line: JsonObject) -> None:
        del line[choose(rng, list(line))]

    return _edit_line(content, rng, edit)


@content_mutation("types", "lines")
def line_that_is_no_object(content: bytes, rng: Rng) -> bytes:
    lines = content.splitlines(keepends=True)
    line = choose(rng, (b"[]", b"null", b"1", b'"x"', b"{", b"{}{}", b"NaN", b"[" * 50))
    lines[choose_index(rng, lines)] = line + b"\n"
    return b"".join(lines)


@content_mutation("bombs", "lines")
def line_of_deep_nesting(content: bytes, rng: Rng) -> bytes:
    nested = nest_deeply(rng)
    return content + choose(rng, (nested, b'{"id": ' + nested + b"}")) + b"\n"


@content_mutation("bombs", "lines")
def line_of_long_texts(content: bytes, rng: Rng) -> bytes:
    text = choose(rng, ("x", "\x1b[2J", "\u202e", "<b>")) * (_LONG_TEXT_BYTES // 4)

    def edit(line: JsonObject) -> None:
        key = choose(rng, list(line))
        value = choose(rng, (text, [text], {text: 1}, line[key]))
        line[choose(rng, (key, text))] = value

    return _edit_line(content, rng, edit)


@content_mutation("names", "lines")
def line_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    names = (*ODD_NAMES, "a/b/c/d", "a/b/ego_vehicle/000", "a/b/ego_vehicle/٠٠١")

    def edit(line: JsonObject) -> None:
        keys = [key for key, value in line.items() if isinstance(value, str)]
        name = choose(rng, names)
        line[choose(rng, keys)] = name

    return _edit_line(content, rng, edit)


def _edit_line(content: bytes, rng: Rng, edit: Callable[[JsonObject], object]) -> bytes:
    """Return lines of JSON in which one line is edited."""
    lines = content.splitlines()
    position = choose_index(rng, lines)
    tree = json.loads(lines[position])
    edit(tree)
    lines[position] = json.dumps(tree).encode("utf-8", "surrogatepass")
    return b"\n".join(lines) + b"\n"


# ---- files of cached images


@content_mutation("numbers", "images")
def images_of_another_count(content: bytes, rng: Rng) -> bytes:
    """Write other numbers of rows and cameras into the header."""
    counts = (0, 1, 2, 3, 6, -1, 1 << 20, 1 << 31, 1 << 40, (1 << 63) - 1, -(1 << 63))
    rows = choose(rng, counts)
    cameras = choose(rng, counts)
    header = struct.pack("<qq", rows, cameras)
    return replace_bytes(content, 8, _IMAGES_HEADER_BYTES, header)


@content_mutation("types", "images")
def images_elsewhere(content: bytes, rng: Rng) -> bytes:
    """Write another begin or length of an image into the table."""
    size = len(content)
    numbers = (0, 1, -1, size, size - 1, size + 1, 1 << 40, (1 << 63) - 1, -(1 << 63), 24)
    (first_begin,) = struct.unpack_from("<q", content, _IMAGES_HEADER_BYTES)
    number_count = (first_begin - _IMAGES_HEADER_BYTES) // 8
    begin = _IMAGES_HEADER_BYTES + 8 * int(rng.integers(max(number_count, 1)))
    number = struct.pack("<q", choose(rng, numbers))
    return replace_bytes(content, begin, begin + 8, number)


@content_mutation("types", "images")
def images_of_another_form(content: bytes, rng: Rng) -> bytes:
    begin = choose(rng, (b"DAimagex", b"", b"PK\3\4", b"\x93NUMPY\1\0", content[:8]))
    return begin + choose(rng, (content, content[8:]))


@content_mutation("bombs", "images")
def images_without_end(content: bytes, rng: Rng) -> bytes:
    """Announce a table of millions of rows, with or without its bytes."""
    rows = choose(rng, (1_000_000, 5_000_000, 1 << 33))
    table = bytes(16 * rows if rows == 1_000_000 else 1000)
    header = struct.pack("<qq", rows, 1)
    return replace_bytes(content, 8, _IMAGES_HEADER_BYTES, header + table)


@path_mutation("links", "images")
def images_of_another_scenario_in_a_link(path: Path, rng: Rng) -> None:
    path.unlink()
    name = choose(rng, ("kept.txt", "folder", "none"))
    path.symlink_to(find_outside_folder(path) / name)


@path_mutation("names", "images")
def images_beside_odd_names(path: Path, rng: Rng) -> None:
    for name in ODD_NAMES[:6]:
        neighbour = path.with_name(f"{name.replace('/', '_')[:200]}.images")
        neighbour.write_bytes(path.read_bytes()[: rng.integers(99)])


# ---- archives of releases


def edit_members(path: Path, edit: Callable[[list[Member]], object]) -> None:
    """Pack an archive again with its members edited."""
    with zipfile.ZipFile(path) as archive:
        members = [(entry, archive.read(entry)) for entry in archive.infolist()]
    edit(members)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for entry, member in members:
            archive.writestr(entry, member, entry.compress_type)
    replace_file(path, buffer.getvalue())


@path_mutation("names", "zip", "pt")
def member_elsewhere(path: Path, rng: Rng) -> None:
    """Give a member a name with backslashes, one that leads out of the archive, or an odd one."""

    def edit(members: list[Member]) -> None:
        entry, _ = choose(rng, members)
        name = entry.filename
        last = name.rpartition("/")[2]
        names = (
            name.replace("/", "\\"),
            f"../../outside/{last}",
            f"/{name}",
            f"C:\\{last}",
            f"a/../{name}",
            f"./{name}",
            f"{name}/",
            name.upper(),
            name.replace("/", "//"),
            *ODD_NAMES,
        )
        entry.filename = choose(rng, names)

    edit_members(path, edit)


@path_mutation("names", "zip")
def all_members_elsewhere(path: Path, rng: Rng) -> None:
    rename_options = (
        lambda name: name.replace("/", "\\"),
        lambda name: f"../{name}",
        lambda name: f"/{name}",
        lambda name: f"\x1b[31m/{name}",
    )
    rename = choose(rng, rename_options)

    def edit(members: list[Member]) -> None:
        for entry, _ in members:
            entry.filename = rename(entry.filename)

    edit_members(path, edit)


@path_mutation("links", "zip", "pt")
def member_is_a_link(path: Path, rng: Rng) -> None:
    def edit(members: list[Member]) -> None:
        position = choose_index(rng, members)
        entry, _ = members[position]
        entry.external_attr = choose(rng, (0o120777, 0o060666, 0o010666, 0o040755)) << 16
        target = choose(rng, (b"/etc/passwd", b"../../outside/kept.txt", b"/dev/zero"))
        members[position] = (entry, target)

    edit_members(path, edit)


@path_mutation("types", "zip", "pt")
def member_twice(path: Path, rng: Rng) -> None:
    def edit(members: list[Member]) -> None:
        entry, member = choose(rng, members)
        name = entry.filename
        names = [name, name]
        if path.suffix == ".zip":  # PyTorch reads no file with both
            names += [f"./{name}", f"x/{name}"]
        new_entry = zipfile.ZipInfo(choose(rng, names))
        position = choose_index(rng, members)
        members.insert(position, (new_entry, choose(rng, (member, b"", member[:-9]))))

    edit_members(path, edit)


@path_mutation("types", "zip")
def member_of_another_method(path: Path, rng: Rng) -> None:
    methods = (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    method = choose(rng, methods)

    def edit(members: list[Member]) -> None:
        entry, _ = choose(rng, members)
        entry.compress_type = method

    edit_members(path, edit)


@content_mutation("types", "zip", "pt")
def directory_entry_that_lies(content: bytes, rng: Rng) -> bytes:
    """Change the flags, method, checksum, sizes or offset in an entry of the directory.

    Members may then be encrypted, overlap, lie beyond the end, or need zip64.
    """
    fields = (
        (8, "<H"),
        (10, "<H"),
        (16, "<I"),
        (20, "<I"),
        (24, "<I"),
        (28, "<H"),
        (30, "<H"),
        (42, "<I"),
    )
    offset, number_format = choose(rng, fields)
    entries = _find_directory_entries(content)
    begin = choose(rng, entries)
    other_begin = choose(rng, entries)
    (other_number,) = struct.unpack_from(number_format, content, other_begin + offset)
    if number_format == "<H":
        numbers = (1, 0, 8, 99, 0xFFFF, 2049)
    else:
        numbers = (0, 1, other_number, 0xFFFFFFFF, 0xFFFFFFFE, 0x7FFFFFFF, len(content))
    changed = bytearray(content)
    struct.pack_into(number_format, changed, begin + offset, choose(rng, numbers))
    return bytes(changed)


@content_mutation("numbers", "zip", "pt")
def end_that_lies(content: bytes, rng: Rng) -> bytes:
    """Write other numbers into the archive's end, or add a zip64 end with wrong numbers."""
    end = content.rfind(b"PK\5\6")
    numbers = (0, 1, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1 << 40, end, len(content))
    if rng.integers(2):
        fields = ((4, "<H"), (8, "<H"), (10, "<H"), (12, "<I"), (16, "<I"), (20, "<H"))
        offset, number_format = choose(rng, fields)
        number = choose(rng, numbers) & (0xFFFF if number_format == "<H" else 0xFFFFFFFF)
        changed = bytearray(content)
        struct.pack_into(number_format, changed, end + offset, number)
        return bytes(changed)
    wrong_numbers = [choose(rng, numbers) for _ in range(4)]
    zip64_end = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, *wrong_numbers)
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, choose(rng, (end, 0, 1 << 40)), 1)
    tail = content[end:]
    if rng.integers(2):
        tail = replace_bytes(tail, 8, 20, b"\xff" * 12)
    return content[:end] + zip64_end + locator + tail


@path_mutation("bombs", "zip", "pt")
def member_that_unpacks_to_much(path: Path, rng: Rng) -> None:
    """Replace a member by 900 MB of zeros; the directory may state another size."""
    members = read_members(path.read_bytes())
    name = choose(rng, list(members))
    deflated, checksum, size = deflate_with_zeros(b"")
    stated_size = choose(rng, (size, len(members[name]), 1000))
    members[name] = deflated
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for member_name, member in members.items():
            archive.writestr(member_name, member)
        entry = archive.getinfo(name)
        entry.compress_type = zipfile.ZIP_DEFLATED
        entry.CRC = checksum
        entry.file_size = stated_size
    replace_file(path, buffer.getvalue())


@path_mutation("bombs", "zip")
def many_members(path: Path, rng: Rng) -> None:
    """Add 50,000 empty members, in a release or not, or 100 with names of 60,000 characters."""
    count, length = choose(rng, ((50_000, 1), (100, 60_000)))
    with zipfile.ZipFile(path) as archive:
        first_folder = archive.namelist()[0].rpartition("/")[0]
    folder = choose(rng, (f"{first_folder}/", "", f"{first_folder}/x/"))
    buffer = io.BytesIO(path.read_bytes())
    with zipfile.ZipFile(buffer, "a") as archive:
        for number in range(count):
            archive.writestr(f"{folder}{'x' * length}{number:03d}.txt", b"")
    replace_file(path, buffer.getvalue())


def _find_directory_entries(content: bytes) -> list[int]:
    """Return the positions at which the entries of an archive's directory begin."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        position = archive.start_dir
        count = len(archive.infolist())
    positions = []
    for _ in range(count):
        positions.append(position)
        lengths = struct.unpack_from("<HHH", content, position + 28)
        position += _DIRECTORY_ENTRY_BYTES + sum(lengths)
    return positions
