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
TEXT_TOP, LINE_HEIGHT, LETTER_WIDTH = 18, 16, 5.9
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
    """Return the contract's layers, from top to bottom, each with its modules."""
    content = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = content["tool"]["importlinter"]["contracts"]
    contract = next(contract for contract in contracts if contract["type"] == "layers")
    return [re.findall(r"\w+", layer) for layer in contract["layers"]]


def purpose(module: str) -> str:
    """Return the first sentence of a module's docstring."""
    package = TOP / "deepaccident_devkit" / module
    path = package / "__init__.py" if package.is_dir() else package.with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstring = ast.get_docstring(tree) or ""
    summary, _, _ = docstring.partition("\n\n")
    return " ".join(summary.replace("`", "").split())


def picture() -> str:
    """Return the layers as SVG: a row for each layer, siblings side by side, imports go downwards."""
    rows = layers()
    elements = []
    top = MARGIN
    for number, modules in enumerate(rows):
        width = (WIDTH - 2 * MARGIN - GAP * (len(modules) - 1)) / len(modules)
        letters = int((width - 16) / LETTER_WIDTH)
        texts = [
            wrap(purpose(module), letters, max_lines=3, placeholder=" …") for module in modules
        ]
        height = TEXT_TOP + 10 + LINE_HEIGHT * max(map(len, texts))
        kind = _kind(rows, number)
        left = MARGIN
        for module, lines in zip(modules, texts, strict=True):
            elements.append(_rectangle(left, top, width, height, kind))
            baseline = top + TEXT_TOP
            elements.append(
                _text(left + 8, baseline, escape(module), 'font-size="14" font-weight="bold"')
            )
            for line in lines:
                baseline += LINE_HEIGHT
                elements.append(_text(left + 8, baseline, escape(line), 'font-size="11.5"'))
            left += width + GAP
        top += height + GAP
    height = top + 12 + MARGIN
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" font-family="Arial, sans-serif">',
        f'<rect width="{WIDTH}" height="{height}" fill="white"/>',
    ]
    return "\n".join([*head, *elements, *_key(top + 12), "</svg>", ""])


def _kind(rows: list[list[str]], number: int) -> str:
    """Return the kind of a layer: plug-ins stand on all others; below `dataset` lies what reads the
    data, and above `export` what people call.
    """
    if "plugins" in rows[number]:
        return "plugins"
    modules_down_to_row = [module for row in rows[: number + 1] for module in row]
    if "dataset" in modules_down_to_row:
        return "data"
    if "export" in modules_down_to_row:
        return "work"
    return "use"


def _key(baseline: int) -> list[str]:
    """Return the key below the layers."""
    elements = []
    left = MARGIN
    for kind, words in _KINDS.items():
        elements.append(_rectangle(left, baseline - 10, 12, 12, kind))
        elements.append(_text(left + 18, baseline, words, 'font-size="12"'))
        left += 200
    elements.append(_text(left, baseline, "imports go downwards, never up", 'font-size="12"'))
    return elements


def _rectangle(left: float, top: int, width: float, height: int, kind: str) -> str:
    position = f'x="{left:.1f}" y="{top}" width="{width:.1f}" height="{height}"'
    return f'<rect {position} rx="4" fill="{_COLORS[kind]}" stroke="#5b6770"/>'


def _text(left: float, baseline: int, words: str, style: str) -> str:
    return f'<text x="{left:.1f}" y="{baseline}" {style}>{words}</text>'


if __name__ == "__main__":
    main()
