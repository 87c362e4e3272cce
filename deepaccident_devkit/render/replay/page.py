"""The page: a skeleton, its look, its script and its data in one file that asks for nothing else."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any, Final

_SCRIPTS: Final = ("ground.js", "panels.js", "replay.js")
"""In the order in which they build on each other."""


def replay_page(title: str, data: Mapping[str, Any]) -> str:
    """A whole page in HTML.

    Its policy lets a browser run this script and use this style alone, and load nothing. All text of the data is shown
    as text by the script, never as HTML.

    Args:
        title: of the window.
        data: what the scripts play, as JSON holds it.
    """
    style, script = _part("replay.css"), "".join(map(_part, _SCRIPTS))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_hash(style)}'; script-src '{_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": html.escape(policy, quote=False),
        "title": html.escape(title),
        "style": style,
        "script": script,
        "data": _json(data),
    }
    page = _part("replay.html")
    for name, part in parts.items():  # the data come last, so that nothing in them is taken for a mark
        page = page.replace(f"<!--{name}-->", part)
    return page


def _json(data: Mapping[str, Any]) -> str:
    """JSON that cannot end the element in which it stands."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _part(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """A source of a content security policy that is this text alone."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
