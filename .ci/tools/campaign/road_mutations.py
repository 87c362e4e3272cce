"""What strangers do to nuScenes' tables: rows that lead nowhere or in a circle, twice the same
token, odd numbers.
"""

import json
from typing import Any

from campaign.mutations import Rng, any_of, by_content

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


def _rows(content: bytes) -> list[dict[str, Any]]:
    """The rows of a table; of a list of splits none."""
    rows = json.loads(content)
    return rows if isinstance(rows, list) else []


def _dumped(content: bytes, rows: list[dict[str, Any]]) -> bytes:
    return json.dumps(rows).encode() if rows else content + b" "


@by_content("types", "tables")
def row_that_leads_elsewhere(content: bytes, rng: Rng) -> bytes:
    """A token is that of another row, of its own row, of none, or empty."""
    rows = _rows(content)
    places = [
        (row, name) for row in rows for name in row if name in _TOKENS or name.endswith("_token")
    ]
    if places:
        row, name = any_of(rng, places)
        row[name] = any_of(
            rng, (row["token"], any_of(rng, rows)["token"], any_of(rng, rows)[name], "nowhere", "")
        )
    return _dumped(content, rows)


@by_content("types", "tables")
def rows_in_a_circle(content: bytes, rng: Rng) -> bytes:
    """The chain of a row's followers leads back."""
    rows = [row for row in _rows(content) if "next" in row]
    if not rows:
        return content + b" "
    first, last = any_of(rng, rows), any_of(rng, rows)
    last["next"], first["prev"] = first["token"], last["token"]
    return json.dumps(rows).encode()


@by_content("names", "tables")
def token_or_name_twice(content: bytes, rng: Rng) -> bytes:
    rows = _rows(content)
    if rows:
        one, other = any_of(rng, rows), any_of(rng, rows)
        name = any_of(rng, [each for each in ("token", "name") if each in one])
        other[name] = one[name]
    return _dumped(content, [*rows, dict(any_of(rng, rows))] if rows and rng.integers(2) else rows)


@by_content("numbers", "tables")
def numbers_of_a_row(content: bytes, rng: Rng) -> bytes:
    """A vector or a number of one row, or of all rows, is zero, huge, tiny, negative or none."""
    rows = _rows(content)
    names = sorted(
        {
            name
            for row in rows
            for name, value in row.items()
            if isinstance(value, list | int | float)
        }
    )
    if names:
        name, value = any_of(rng, names), any_of(rng, _NUMBERS)
        for row in rows if rng.integers(2) else [any_of(rng, rows)]:
            row[name] = [value for _ in row[name]] if isinstance(row[name], list) else value
    return _dumped(content, rows)


@by_content("types", "tables")
def row_lost(content: bytes, rng: Rng) -> bytes:
    rows = _rows(content)
    if rows:
        rows.pop(int(rng.integers(len(rows))))
    return json.dumps(rows).encode() if rows else b"[]"
