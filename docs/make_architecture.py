"""Render docs/images/layers.svg from the layers of pyproject.toml: `python
docs/make_architecture.py`.
"""

import ast
import re
import sys
from html import escape
from pathlib import Path
from textwrap import wrap

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

TOP = Path(__file__).parents[1]
PICTURE = TOP / "docs" / "images" / "layers.svg"
WIDTH, MARGIN, GAP = 1080, 16, 8
TOP_OF_TEXT, LINE, LETTER = 18, 16, 5.9
"""Pixels."""
_COLORS = {"data": "#dbe9f6", "work": "#e5f2df", "use": "#fbeed5", "plugins": "#efe3f3"}
_KINDS = {
    "plugins": "plug-ins: may be left out",
    "use": "what people call",
    "work": "what is computed and rendered",
    "data": "the release and its tables",
}


def main() -> None:
    """Write the picture."""
    PICTURE.write_text(picture(), encoding="utf-8")


def layers() -> list[list[str]]:
    """The contract's layers, from top to bottom, each with its modules."""
    content = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))
    contract = next(
        contract
        for contract in content["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers"
    )
    return [[name.strip(" ()") for name in re.split("[|:]", layer)] for layer in contract["layers"]]


def purpose(module: str) -> str:
    """The first sentence of a module's docstring."""
    package = TOP / "deepaccident_devkit" / module
    path = package / "__init__.py" if package.is_dir() else package.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(docstring.split("\n\n")[0].replace("`", "").split())


def picture() -> str:
    """The layers as SVG: a row a layer, siblings side by side, imports go downwards."""
    rows, parts, top = layers(), [], MARGIN
    for number, modules in enumerate(rows):
        width = (WIDTH - 2 * MARGIN - GAP * (len(modules) - 1)) / len(modules)
        texts = [
            wrap(purpose(module), int((width - 16) / LETTER), max_lines=3, placeholder=" …")
            for module in modules
        ]
        height = TOP_OF_TEXT + 10 + LINE * max(map(len, texts))
        for place, (module, lines) in enumerate(zip(modules, texts, strict=True)):
            left = MARGIN + place * (width + GAP)
            parts.append(_rectangle(left, top, width, height, _kind(rows, number)))
            parts.append(
                _text(
                    left + 8, top + TOP_OF_TEXT, escape(module), 'font-size="14" font-weight="bold"'
                )
            )
            for line, words in enumerate(lines, start=1):
                parts.append(
                    _text(
                        left + 8, top + TOP_OF_TEXT + LINE * line, escape(words), 'font-size="11.5"'
                    )
                )
        top += height + GAP
    height = top + 12 + MARGIN
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" font-family="Arial, sans-serif">',
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>',
    ]
    return "\n".join([*head, *parts, *_key(top + 12), "</svg>", ""])


def _kind(rows: list[list[str]], number: int) -> str:
    """Plug-ins stand on all; below the data set lies what reads it, and above the facade what is
    called by people.
    """
    above = [name for row in rows[: number + 1] for name in row]
    if "plugins" in rows[number]:
        return "plugins"
    return "data" if "dataset" in above else "work" if "export" in above else "use"


def _key(top: int) -> list[str]:
    parts, left = [], MARGIN
    for kind, words in _KINDS.items():
        parts += [
            _rectangle(left, top - 10, 12, 12, kind),
            _text(left + 18, top, words, 'font-size="12"'),
        ]
        left += 200
    rule = "imports go downwards, never up"
    return [*parts, _text(left, top, rule, 'font-size="12"')]


def _rectangle(left: float, top: int, width: float, height: int, kind: str) -> str:
    place = f'x="{left:.1f}" y="{top}" width="{width:.1f}" height="{height}"'
    return f'<rect {place} rx="4" fill="{_COLORS[kind]}" stroke="#5b6770"/>'


def _text(left: float, top: int, words: str, style: str) -> str:
    return f'<text x="{left:.1f}" y="{top}" {style}>{words}</text>'


if __name__ == "__main__":
    main()
