"""A Sphinx extension: docstrings are written with Markdown's code, tables and fences; autodoc reads reStructuredText.

Sections (`Args:`, `Returns:`, …) are napoleon's, which comes after this.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_CODE_SPAN = re.compile(r"(?<![`\\])`([^`]+)`(?!`)")
_ARRAY = re.compile(r"~?(numpy\.)?ndarray\[tuple\[[^\]]*\], ~?(numpy\.)?dtype\[~?(numpy\.|typing\.)*(?P<dtype>\w+)\]\]")
_ARRAY_NAMES = {"float64": "FloatArray", "int64": "IntArray", "bool": "BoolArray", "uint8": "ByteArray"}
"""As `deepaccident_devkit.support.arrays` calls them."""
_WITHOUT_TYPE = ("attribute", "data", "property")
"""What napoleon takes `type: text` off, if there is a colon in the first line."""
_SECTIONS = ("Args:", "Attributes:", "Examples:", "Raises:", "Returns:", "Yields:")


def restructured(lines: list[str]) -> list[str]:
    """A docstring's lines as reStructuredText; doctests, and the sections that napoleon takes apart, stay."""
    result: list[str] = []
    block: list[str] = []
    kind = "text"
    for number, line in enumerate(lines):
        following = _kind(line, kind, lines[:number])
        if following != kind:
            result += _RESTRUCTURED[kind](block) if block else []
            kind, block = following, []
        block.append(line)
    return result + _RESTRUCTURED[kind](block)


def _kind(line: str, kind: str, before: list[str]) -> str:
    """What a line belongs to: `fence`, `table`, `doctest`, `example` (indented code) or `text`."""
    words = line.strip()
    if kind == "fence" and before[-1].strip() != "```":
        return "fence"
    if words.startswith("```"):
        return "fence"
    if words.startswith("|") and words.endswith("|"):
        return "table"
    if words.startswith(">>>") or (kind == "doctest" and words):
        return "doctest"
    indented = line.startswith("    ")
    if kind == "example":
        return "example" if indented or not words else "text"
    starts_block = not before or not before[-1].strip()
    return "example" if indented and starts_block and not _in_section(before) else "text"


def _in_section(before: list[str]) -> bool:
    """Whether the last line that is not indented begins a section."""
    outermost = next((line for line in reversed(before) if line and not line.startswith(" ")), "")
    return outermost in _SECTIONS


def _text(lines: list[str]) -> list[str]:
    """Code spans as literals, which may touch a letter (`token`s); bars are bars."""
    pieces = _CODE_SPAN.split("\n".join(lines))
    pieces[::2] = [piece.replace("|", r"\|") for piece in pieces[::2]]
    pieces[1::2] = [rf"\ ``{piece}``\ " for piece in pieces[1::2]]
    return "".join(pieces).replace("\n\\ ``", "\n``").removeprefix("\\ ").split("\n")


def _fence(lines: list[str]) -> list[str]:
    indent = lines[0][: len(lines[0]) - len(lines[0].lstrip())]
    return ["", f"{indent}.. code-block:: python", "", *(f"    {line}" for line in lines[1:-1]), ""]


def _example(lines: list[str]) -> list[str]:
    return ["", ".. code-block:: python", "", *lines, ""]


def _table(lines: list[str]) -> list[str]:
    rows = [re.split(r"(?<!\\)\|", line.strip()[1:-1]) for line in lines]
    result = ["", ".. list-table::", "    :header-rows: 1", ""]
    for row in (row for row in rows if set("".join(row)) - set(" -:")):
        cells = [_text([cell.strip()])[0] for cell in row]
        result += [f"    {'*' if not index else ' '} - {cell}" for index, cell in enumerate(cells)]
    return [*result, ""]


_RESTRUCTURED = {"text": _text, "fence": _fence, "example": _example, "table": _table, "doctest": list}


def _process(_app: Sphinx, what: str, _name: str, _obj: object, _options: Any, lines: list[str]) -> None:
    if what == "method":  # functions that the facade binds: it is `self`
        lines[:] = [line for line in lines if line.strip() != "dataset: the release."]
    lines[:] = restructured(lines)
    if what in _WITHOUT_TYPE:
        lines.insert(0, "")


def _name_arrays(
    _app: Sphinx, _what: str, _name: str, _obj: object, _options: Any, signature: str | None, result: str | None
) -> tuple[str | None, ...]:
    return tuple(text and _ARRAY.sub(_array_name, text) for text in (signature, result))


def _array_name(found: re.Match[str]) -> str:
    return _ARRAY_NAMES.get(found["dtype"], "AnyArray")


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect it, ahead of napoleon."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", _process, priority=400)
    app.connect("autodoc-process-signature", _name_arrays)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
