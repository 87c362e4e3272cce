"""What strangers do to what exports leave, to truth files, caches, addresses and archives."""

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
    Rng,
    any_of,
    by_content,
    by_path,
    containers,
    outside_of,
    replace,
    squeezed,
)

_EXPORTED = ("manifest", "journal", "record")
_LONG = 5_000_000


# ---- exports: links and paths that lead out


def export_of(path: Path) -> Path:
    """The folder of the export that a file belongs to."""
    return next(folder for folder in path.parents if any(folder.glob("*.manifest.json")))


@by_path("links", *_EXPORTED)
def link_out_of_the_export(path: Path, rng: Rng) -> None:
    """Something below the export is a link to a folder or a file outside."""
    places = [each for each in sorted(export_of(path).rglob("*")) if each != path]
    place, outside = any_of(rng, places), outside_of(path)
    aside = outside.with_name("aside")
    place.rename(aside)
    place.symlink_to(
        any_of(rng, (outside, outside / "kept.txt", outside / "folder", outside / "new"))
    )


@by_path("links", *_EXPORTED, "images")
def temporary_link_out(path: Path, rng: Rng) -> None:
    """A temporary name of a dead process leads outside."""
    outside = outside_of(path)
    left = next(outside.glob(".*.tmp"))
    place = any_of(rng, [path.parent, *(each for each in path.parents if each.name == "begun")])
    (place / left.name).symlink_to(any_of(rng, (outside, outside / "kept.txt", outside / "folder")))


def _ways_out(path: Path) -> tuple[str, ...]:
    root, outside = export_of(path), outside_of(path)
    away = os.path.relpath(outside, root)
    link = root / "linked"
    link.symlink_to(outside)
    return (
        *(f"{away}/{name}" for name in ("kept.txt", "folder", "folder/inner.txt", ".", "")),
        *(f"{outside}/{name}" for name in ("kept.txt", "folder", "")),
        *(f"linked/{name}" for name in ("kept.txt", "folder", "folder/inner.txt")),
        *(
            f"a/../{away}/kept.txt",
            f"./{away}",
            "..",
            "../..",
            "linked",
            f"//{outside}/kept.txt",
            f"{away}//folder",
        ),
    )


@by_path("links", "journal")
def journal_that_leads_out(path: Path, rng: Rng) -> None:
    ways = _ways_out(path)
    lines = [any_of(rng, ways) for _ in range(int(rng.integers(1, 6)))]
    before = path.read_bytes() if rng.integers(2) else b""
    replace(path, before + "".join(f"{line}\0" for line in lines).encode())


@by_content("names", "journal")
def journal_of_odd_names(content: bytes, rng: Rng) -> bytes:
    odd = (
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
    names = [any_of(rng, (*ODD_NAMES, *odd)) for _ in range(int(rng.integers(1, 9)))]
    return content + "".join(f"{name}\0" for name in names).encode("utf-8", "surrogatepass")


@by_content("bombs", "journal")
def journal_of_many_or_long_paths(content: bytes, rng: Rng) -> bytes:
    deep = b"a/" * 100_000
    return content + any_of(
        rng,
        (b"x" * _LONG, b"x/y\0" * 20_000, b"\0" * _LONG, deep, deep + b"\0", b"x" * _LONG + b"\0"),
    )


@by_content("numbers", "journal")
def journal_without_ends(content: bytes, rng: Rng) -> bytes:
    return any_of(
        rng,
        (
            content.replace(b"\0", b"\n"),
            content.rstrip(b"\0"),
            content.replace(b"\0", b"\0\0"),
            b"\0" + content,
        ),
    )


@by_content("types", "journal")
def journal_of_another_unit(content: bytes, rng: Rng) -> bytes:
    """It is no text, or says the same in another order, or twice."""
    paths = content.split(b"\0")[:-1]
    rng.shuffle(paths)  # type: ignore[arg-type]
    turned = b"".join(each + b"\0" for each in paths)
    return any_of(
        rng,
        (
            turned,
            content + content,
            content.decode().encode("utf-16"),
            b"\xff\xfe\0" + content,
            b"[]",
            b"{}",
        ),
    )


# ---- recipes of studies

_ODD = (
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
"""In the place of a value."""
_MANY = 3_000


def _recipe(content: bytes) -> Any:
    """The tree of a recipe, and all places of values in it: what they are inside of, and their
    key.
    """
    tree = yaml.safe_load(content)
    places = [
        (inside, key)
        for inside in containers(tree)
        for key in (list(inside) if isinstance(inside, dict) else range(len(inside)))
    ]
    return tree, places


def _yaml(tree: Any) -> bytes:
    return yaml.safe_dump(tree, sort_keys=False).encode("utf-8", "surrogatepass")


@by_content("types", "recipe")
def recipe_value_of_another_type(content: bytes, rng: Rng) -> bytes:
    tree, places = _recipe(content)
    for _ in range(int(rng.integers(1, 4))):
        inside, key = any_of(rng, places)
        inside[key] = any_of(rng, _ODD)
    return _yaml(tree)


@by_content("types", "recipe")
def recipe_key_added_or_left_out(content: bytes, rng: Rng) -> bytes:
    """Keys that recipes know, where they do not belong."""
    tree, places = _recipe(content)
    known = sorted(
        {str(key) for _, key in places}
        | {"mix", "also_split", "file", "spec", "validation", "over", "name"}
    )
    inside = any_of(rng, [each for each in containers(tree) if each and isinstance(each, dict)])
    if rng.integers(2):
        inside[any_of(rng, known)] = any_of(rng, (*_ODD, "test", "train", {"release": "test"}))
    else:
        del inside[any_of(rng, list(inside))]
    return _yaml(tree)


@by_content("numbers", "recipe")
def recipe_number_beyond_bounds(content: bytes, rng: Rng) -> bytes:
    tree, places = _recipe(content)
    numbers = [(inside, key) for inside, key in places if isinstance(inside[key], int | float)]
    inside, key = any_of(rng, numbers)
    inside[key] = any_of(
        rng, (0, -1, 1e9, -1e9, 1e300, 10**12, 10**40, 0.1 + 1e-9, math.inf, -math.inf, math.nan)
    )
    return _yaml(tree)


@by_content("bombs", "recipe")
def recipe_multiplied(content: bytes, rng: Rng) -> bytes:
    """Lists in several keys of a row, each with many values."""
    tree, _ = _recipe(content)
    count = any_of(rng, (10, 100, 1000))
    lists = {
        key: [float(each) for each in range(count)]
        for key in ("latency", "pose_noise", "packet_loss", "horizon")
    }
    row = {"name": "{latency} {agents}", "baseline": "standing", "agents": ["all"] * count, **lists}
    tree["rows"] = any_of(rng, ([row], [*tree["rows"], row], [row] * 20))
    return _yaml(tree)


@by_content("bombs", "recipe")
def recipe_of_many(content: bytes, rng: Rng) -> bytes:
    """Thousands of rows, weights, releases, groups, pairs or seeds, or one that is very long."""
    tree, _ = _recipe(content)
    row, name = tree["rows"][-1], any_of(rng, ("a", "\u202e", "n" * 20))
    part, value = any_of(
        rng,
        (
            ("rows", [{**row, "name": f"{name}{each}"} for each in range(_MANY)]),
            ("weights", {f"{name}{each}": {"file": "tiny"} for each in range(_MANY)}),
            (
                "releases",
                {
                    **tree["releases"],
                    **{f"{name}{each}": {"scenarios": 2} for each in range(_MANY)},
                },
            ),
            ("groups", {f"{name}{each}": ["town=Town03"] for each in range(_MANY)}),
            ("compare", [[row["name"], row["name"]]] * _MANY),
            ("seeds", list(range(_MANY))),
            ("by", ["impact_step"] * _MANY),
            ("title", name * 50_000),
            ("test", {**tree["test"], "where": [f"town={name * 30_000}"]}),
            ("rows", [{**row, "name": name * 4_000}] * 10),
        ),
    )
    return _yaml({**tree, part: value})


@by_content("names", "recipe")
def recipe_name_that_is_not_there(content: bytes, rng: Rng) -> bytes:
    """A text becomes another one: in capital letters, that of something else, or an odd one."""
    tree, places = _recipe(content)
    texts = [(inside, key) for inside, key in places if isinstance(inside[key], str)]
    inside, key = any_of(rng, texts)
    other, name = any_of(rng, texts)
    inside[key] = any_of(rng, (inside[key].upper(), other[name], f"{inside[key]} ", *ODD_NAMES))
    return _yaml(tree)


# ---- JSON: settings, notes, addresses


@by_content("bombs", "manifest", "record")
def long_setting(content: bytes, rng: Rng) -> bytes:
    """A value or a key of 5 MB, with what moves a terminal's cursor and turns letters."""
    tree = json.loads(content)
    inside = any_of(rng, [each for each in containers(tree) if isinstance(each, dict) and each])
    text = any_of(rng, ("x", "\x1b[2J", "\u202e", "\x9b1m", "<b>")) * (_LONG // 4)
    name = any_of(rng, list(inside))
    if rng.integers(2):
        inside[name] = any_of(rng, (text, [text], {text: text}))
    else:
        inside[text] = inside.pop(name)
    return json.dumps(tree, ensure_ascii=bool(rng.integers(2))).encode()


@by_content("names", "manifest", "record")
def scenario_with_another_name(content: bytes, rng: Rng) -> bytes:
    """A scenario's token is another one, or leads elsewhere."""
    token = next((each for each in content.split(b'"') if b"scenario0" in each), b"scenarios")
    odd = (
        b"../../outside/kept",
        b"/etc/passwd",
        b"..",
        b"",
        b"\\u001b[31mred",
        b"\\u202ex",
        b"type1/x",
        b"x" * 5000,
    )
    return content.replace(token, any_of(rng, odd))


@by_content("bombs", "address")
def long_address(_content: bytes, rng: Rng) -> bytes:
    """An address of 50 MB, or a list of many."""
    text = any_of(rng, ("9", "x", "[", "%", "\x1b[2J", "\u202e"))
    long = f"tcp://127.0.0.1:{text * (50_000_000 // len(text))}"
    address = any_of(rng, (long, long, [long[:100]] * 100_000, "://" * 100_000))
    return json.dumps(
        {"type": "Scheduler", "address": address}, ensure_ascii=bool(rng.integers(2))
    ).encode()


@by_content("types", "address")
def address_of_another_kind(content: bytes, rng: Rng) -> bytes:
    tree = json.loads(content)
    odd = (
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
    )
    more = (
        "file:///etc/passwd",
        "tls://127.0.0.1:1",
        "ucx://127.0.0.1:1",
        "ws://127.0.0.1:1",
        "tcp://127.0.0.1:99999",
    )
    tree["address"] = any_of(
        rng, (*odd, *more, "tcp://127.0.0.1:-1", "tcp://[::1]:1", "tcp://a b:1", "x://y\n\x1b[31m")
    )
    return json.dumps(tree).encode()


# ---- lines of JSON


@by_content("types", "lines")
def line_of_other_values(content: bytes, rng: Rng) -> bytes:
    odd = (
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
    return _one_line(
        content, rng, lambda line: line.__setitem__(any_of(rng, list(line)), any_of(rng, odd))
    )


@by_content("types", "lines")
def line_without_a_key(content: bytes, rng: Rng) -> bytes:
    return _one_line(content, rng, lambda line: line.pop(any_of(rng, list(line))))


@by_content("types", "lines")
def line_that_is_no_object(content: bytes, rng: Rng) -> bytes:
    lines = content.splitlines(keepends=True)
    lines[int(rng.integers(len(lines)))] = (
        any_of(rng, (b"[]", b"null", b"1", b'"x"', b"{", b"{}{}", b"NaN", b"[" * 50)) + b"\n"
    )
    return b"".join(lines)


@by_content("bombs", "lines")
def line_of_deep_nesting(content: bytes, rng: Rng) -> bytes:
    depth = any_of(rng, (900, 5000, 200_000))
    nest = any_of(
        rng, (b"[" * depth + b"]" * depth, b'{"a":' * depth + b"1" + b"}" * depth, b"[" * depth)
    )
    return content + any_of(rng, (nest, b'{"id": ' + nest + b"}")) + b"\n"


@by_content("bombs", "lines")
def line_of_long_texts(content: bytes, rng: Rng) -> bytes:
    text = any_of(rng, ("x", "\x1b[2J", "\u202e", "<b>")) * (_LONG // 4)

    def edit(line: dict[str, Any]) -> None:
        name = any_of(rng, list(line))
        line[any_of(rng, (name, text))] = any_of(rng, (text, [text], {text: 1}, line[name]))

    return _one_line(content, rng, edit)


@by_content("names", "lines")
def line_with_an_odd_name(content: bytes, rng: Rng) -> bytes:
    def edit(line: dict[str, Any]) -> None:
        texts = [name for name, value in line.items() if isinstance(value, str)]
        line[any_of(rng, texts)] = any_of(
            rng, (*ODD_NAMES, "a/b/c/d", "a/b/ego_vehicle/000", "a/b/ego_vehicle/٠٠١")
        )

    return _one_line(content, rng, edit)


def _one_line(content: bytes, rng: Rng, edit: Callable[[dict[str, Any]], object]) -> bytes:
    lines = content.splitlines()
    number = int(rng.integers(len(lines)))
    tree = json.loads(lines[number])
    edit(tree)
    lines[number] = json.dumps(tree).encode("utf-8", "surrogatepass")
    return b"\n".join(lines) + b"\n"


# ---- files of cached images


@by_content("numbers", "images")
def images_of_another_count(content: bytes, rng: Rng) -> bytes:
    """The head has other numbers of rows and cameras."""
    odd = (0, 1, 2, 3, 6, -1, 1 << 20, 1 << 31, 1 << 40, (1 << 63) - 1, -(1 << 63))
    return content[:8] + struct.pack("<qq", any_of(rng, odd), any_of(rng, odd)) + content[24:]


@by_content("types", "images")
def images_elsewhere(content: bytes, rng: Rng) -> bytes:
    """The table says another beginning or length of an image."""
    size = len(content)
    odd = (0, 1, -1, size, size - 1, size + 1, 1 << 40, (1 << 63) - 1, -(1 << 63), 24)
    place = 24 + 8 * int(rng.integers(max((struct.unpack("<q", content[24:32])[0] - 24) // 8, 1)))
    return content[:place] + struct.pack("<q", any_of(rng, odd)) + content[place + 8 :]


@by_content("types", "images")
def images_of_another_form(content: bytes, rng: Rng) -> bytes:
    return any_of(rng, (b"DAimagex", b"", b"PK\3\4", b"\x93NUMPY\1\0", content[:8])) + any_of(
        rng, (content, content[8:])
    )


@by_content("bombs", "images")
def images_without_end(content: bytes, rng: Rng) -> bytes:
    """A table of millions of rows, whose bytes may be there."""
    rows = any_of(rng, (1_000_000, 5_000_000, 1 << 33))
    there = bytes(16 * rows) if rows == 1_000_000 else bytes(1000)
    return content[:8] + struct.pack("<qq", rows, 1) + there + content[24:]


@by_path("links", "images")
def images_of_another_scenario_in_a_link(path: Path, rng: Rng) -> None:
    path.unlink()
    path.symlink_to(outside_of(path) / any_of(rng, ("kept.txt", "folder", "none")))


@by_path("names", "images")
def images_beside_odd_names(path: Path, rng: Rng) -> None:
    for name in ODD_NAMES[:6]:
        (path.parent / f"{name.replace('/', '_')[:200]}.images").write_bytes(
            path.read_bytes()[: int(rng.integers(99))]
        )


# ---- archives of releases


def zipped(path: Path, change: Callable[[list[tuple[zipfile.ZipInfo, bytes]]], object]) -> None:
    """Pack an archive again with its members changed."""
    with zipfile.ZipFile(path) as archive:
        members = [(entry, archive.read(entry)) for entry in archive.infolist()]
    change(members)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for entry, member in members:
            archive.writestr(entry, member, entry.compress_type)
    replace(path, buffer.getvalue())


@by_path("names", "zip", "pt")
def member_elsewhere(path: Path, rng: Rng) -> None:
    """A member's name has backslashes, leads out of the archive, or is odd."""

    def change(members: list[Any]) -> None:
        entry = members[int(rng.integers(len(members)))][0]
        name = entry.filename
        last = name.rpartition("/")[2]
        ways = (
            name.replace("/", "\\"),
            f"../../outside/{last}",
            f"/{name}",
            f"C:\\{last}",
            f"a/../{name}",
            f"./{name}",
        )
        entry.filename = any_of(
            rng, (*ways, f"{name}/", name.upper(), name.replace("/", "//"), *ODD_NAMES)
        )

    zipped(path, change)


@by_path("names", "zip")
def all_members_elsewhere(path: Path, rng: Rng) -> None:
    way = any_of(
        rng,
        (
            lambda name: name.replace("/", "\\"),
            lambda name: f"../{name}",
            lambda name: f"/{name}",
            lambda name: f"\x1b[31m/{name}",
        ),
    )

    def change(members: list[Any]) -> None:
        for entry, _ in members:
            entry.filename = way(entry.filename)

    zipped(path, change)


@by_path("links", "zip", "pt")
def member_is_a_link(path: Path, rng: Rng) -> None:
    def change(members: list[Any]) -> None:
        number = int(rng.integers(len(members)))
        entry, _ = members[number]
        entry.external_attr = any_of(rng, (0o120777, 0o060666, 0o010666, 0o040755)) << 16
        members[number] = (
            entry,
            any_of(rng, (b"/etc/passwd", b"../../outside/kept.txt", b"/dev/zero")),
        )

    zipped(path, change)


@by_path("types", "zip", "pt")
def member_twice(path: Path, rng: Rng) -> None:
    def change(members: list[Any]) -> None:
        entry, member = members[int(rng.integers(len(members)))]
        name = entry.filename
        odd = (
            (f"./{name}", f"x/{name}") if path.suffix == ".zip" else ()
        )  # PyTorch reads no file with both
        again = zipfile.ZipInfo(any_of(rng, (name, name, *odd)))
        members.insert(
            int(rng.integers(len(members))), (again, any_of(rng, (member, b"", member[:-9])))
        )

    zipped(path, change)


@by_path("types", "zip")
def member_of_another_method(path: Path, rng: Rng) -> None:
    method = any_of(
        rng, (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    )

    def change(members: list[Any]) -> None:
        members[int(rng.integers(len(members)))][0].compress_type = method

    zipped(path, change)


@by_content("types", "zip", "pt")
def directory_entry_that_lies(content: bytes, rng: Rng) -> bytes:
    """Flags (encrypted), method, checksum, sizes, or the place of a member are others: overlapping,
    beyond, zip64.
    """
    offset, form = any_of(
        rng,
        (
            (8, "<H"),
            (10, "<H"),
            (16, "<I"),
            (20, "<I"),
            (24, "<I"),
            (28, "<H"),
            (30, "<H"),
            (42, "<I"),
        ),
    )
    places = _entries(content)
    place = any_of(rng, places)
    other = struct.unpack_from(form, content, any_of(rng, places) + offset)[0]
    odd = (
        (1, 0, 8, 99, 0xFFFF, 2049)
        if form == "<H"
        else (0, 1, other, 0xFFFFFFFF, 0xFFFFFFFE, 0x7FFFFFFF, len(content))
    )
    changed = bytearray(content)
    struct.pack_into(form, changed, place + offset, any_of(rng, odd))
    return bytes(changed)


@by_content("numbers", "zip", "pt")
def end_that_lies(content: bytes, rng: Rng) -> bytes:
    """The archive's end has other numbers, or a zip64 end that lies."""
    end = content.rfind(b"PK\5\6")
    numbers = (0, 1, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF, 1 << 40, end, len(content))
    if rng.integers(2):
        changed = bytearray(content)
        offset, form = any_of(
            rng, ((4, "<H"), (8, "<H"), (10, "<H"), (12, "<I"), (16, "<I"), (20, "<H"))
        )
        struct.pack_into(
            form,
            changed,
            end + offset,
            any_of(rng, numbers) & (0xFFFF if form == "<H" else 0xFFFFFFFF),
        )
        return bytes(changed)
    lies = [any_of(rng, numbers) for _ in range(4)]
    large = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, *lies)
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, any_of(rng, (end, 0, 1 << 40)), 1)
    tail = content[end:]
    ended = tail[:8] + b"\xff\xff\xff\xff" + b"\xff" * 8 + tail[20:] if rng.integers(2) else tail
    return content[:end] + large + locator + ended


@by_path("bombs", "zip", "pt")
def member_that_unpacks_to_much(path: Path, rng: Rng) -> None:
    """900 MB of zeros in the place of a member; the directory may say the size of before."""
    with zipfile.ZipFile(path) as archive:
        members = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    name = any_of(rng, list(members))
    packed, checksum, size = squeezed(b"")
    lie = any_of(rng, (size, len(members[name]), 1000))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for each, member in members.items():
            archive.writestr(each, packed if each == name else member)
        entry = archive.getinfo(name)
        entry.compress_type, entry.CRC, entry.file_size = zipfile.ZIP_DEFLATED, checksum, lie
    replace(path, buffer.getvalue())


@by_path("bombs", "zip")
def many_members(path: Path, rng: Rng) -> None:
    """50,000 empty ones, of a release or not; or names of 60,000 characters."""
    count, length = any_of(rng, ((50_000, 1), (100, 60_000)))
    with zipfile.ZipFile(path) as archive:
        first = archive.namelist()[0].rpartition("/")[0]
    way = any_of(rng, (f"{first}/", "", f"{first}/x/"))
    buffer = io.BytesIO(path.read_bytes())
    with zipfile.ZipFile(buffer, "a") as archive:
        for number in range(count):
            archive.writestr(f"{way}{'x' * length}{number:03d}.txt", b"")
    replace(path, buffer.getvalue())


def _entries(content: bytes) -> list[int]:
    """Where the entries of an archive's directory begin."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        place, count = archive.start_dir, len(archive.infolist())
    places = []
    for _ in range(count):
        places.append(place)
        place += 46 + sum(struct.unpack_from("<HHH", content, place + 28))
    return places
