"""Mutations of nuScenes' tables: broken or circular tokens, duplicates and odd numbers."""

import json

from campaign.mutations import JsonObject, Rng, choose, content_mutation

_TOKENS = (
    "next",
    "prev",
    "first_sample_token",
    "sample_token",
    "scene_token",
    "instance_token",
    "ego_pose_token",
)
_NUMBERS = (0, -1, 1e308, -1e308, 1e-300, float("nan"), float("inf"), 2**53 + 1)


def _read_rows(content: bytes) -> list[JsonObject]:
    """Return the rows of a table; a list of splits has none."""
    rows = json.loads(content)
    if isinstance(rows, list):
        return rows
    return []


def _write_rows(content: bytes, rows: list[JsonObject]) -> bytes:
    """Return a table of rows; the old content and a space if there are none."""
    if rows:
        return json.dumps(rows).encode()
    return content + b" "


@content_mutation("types", "tables")
def row_that_leads_elsewhere(content: bytes, rng: Rng) -> bytes:
    """Replace a token by that of another row or of its own row, an unknown or an empty one."""
    rows = _read_rows(content)
    places = []
    for row in rows:
        names = [name for name in row if name in _TOKENS or name.endswith("_token")]
        places += [(row, name) for name in names]
    if places:
        row, name = choose(rng, places)
        other_token = choose(rng, rows)["token"]
        same_column = choose(rng, rows)[name]
        row[name] = choose(rng, (row["token"], other_token, same_column, "nowhere", ""))
    return _write_rows(content, rows)


@content_mutation("types", "tables")
def rows_in_a_circle(content: bytes, rng: Rng) -> bytes:
    """Let a row's chain of followers lead back to it."""
    rows = [row for row in _read_rows(content) if "next" in row]
    if not rows:
        return content + b" "
    first = choose(rng, rows)
    last = choose(rng, rows)
    last["next"] = first["token"]
    first["prev"] = last["token"]
    return json.dumps(rows).encode()


@content_mutation("names", "tables")
def token_or_name_twice(content: bytes, rng: Rng) -> bytes:
    """Give a row the token or the name of another one; perhaps repeat a row."""
    rows = _read_rows(content)
    if rows:
        source = choose(rng, rows)
        target = choose(rng, rows)
        name = choose(rng, [name for name in ("token", "name") if name in source])
        target[name] = source[name]
        if rng.integers(2):
            rows = [*rows, choose(rng, rows)]
    return _write_rows(content, rows)


@content_mutation("numbers", "tables")
def numbers_of_a_row(content: bytes, rng: Rng) -> bytes:
    """Set a vector or a number of one row or all rows to a value such as zero, infinity or NaN."""
    rows = _read_rows(content)
    names: set[str] = set()
    for row in rows:
        names |= {name for name, value in row.items() if isinstance(value, list | int | float)}
    if names:
        name = choose(rng, sorted(names))
        number = choose(rng, _NUMBERS)
        for row in rows if rng.integers(2) else [choose(rng, rows)]:
            row[name] = [number for _ in row[name]] if isinstance(row[name], list) else number
    return _write_rows(content, rows)


@content_mutation("types", "tables")
def row_lost(content: bytes, rng: Rng) -> bytes:
    """Remove a row."""
    rows = _read_rows(content)
    if rows:
        rows.pop(rng.integers(len(rows)))
    return json.dumps(rows).encode()
