"""Pages and docstrings are spelt right: each word is English, or in tests/data/words/known.txt."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

from spellchecker import SpellChecker

TOP = Path(__file__).parents[1]
PATTERNS = (
    "*.md",
    "benchmarks/*.md",
    "schema/*.md",
    "tutorials/*.*",
    "docs/**/*.md",
    "docs/*.py",
    "deepaccident_devkit/**/*.py",
)
CODE = re.compile(
    r"^( *)(```|~~~).*?^ *\2 *$|<!--.*?-->"  # blocks, comments
    r"|(?<=\n\n)(?:(?: {4}[^\n]*|)\n)+"  # indented blocks
    r"|(`+)(?!`).+?(?<!`)\3(?!`)|\]\([^)\s]*\)|</?[a-z][^>]*>|https?://\S+",  # code, links, HTML
    re.DOTALL | re.MULTILINE,
)
EXAMPLE_OR_NAME = re.compile(r"^ *>>> .*\n(?:.*\S.*\n)*|^ +\**\w+: ", re.MULTILINE)
"""Examples and names of arguments in docstrings."""
TOKEN = re.compile(r"[^\W\d][\w'’]*(?:\.\w[\w.]*)?|\d[\w.]*")


def prose(path: Path) -> str:
    """Return the prose of a page, of a notebook or of a module's docstrings, without code."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells)
    if path.suffix == ".py":
        nodes = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
        constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
        docstrings = [constant for constant in constants if isinstance(constant, str)]
        text = EXAMPLE_OR_NAME.sub("", "\n".join(docstrings))
        text = re.sub(r"^ +", " ", text, flags=re.MULTILINE)
    return CODE.sub(" • ", text)


def checked_words(text: str) -> Iterator[str]:
    """Yield each word that can be misspelt, in small letters.

    Abbreviations, units and names of code are left out.
    """
    for token in TOKEN.findall(text):
        word = re.sub(r"['’]s?$", "", token.rstrip("."))
        if len(word) > 2 and word.isalpha() and word[1:].islower():
            yield word.lower()


def test_all_words_are_spelt_right() -> None:
    known_words = (TOP / "tests" / "data" / "words" / "known.txt").read_text(encoding="utf-8")
    words_by_page = {}
    for pattern in PATTERNS:
        for path in TOP.glob(pattern):
            if path.name != "CHANGELOG.md":
                words_by_page[path.relative_to(TOP).as_posix()] = {*checked_words(prose(path))}

    all_words = set.union(*words_by_page.values())
    misspelt = SpellChecker().unknown(all_words).difference(known_words.split())
    pages = {name: sorted(words & misspelt) for name, words in words_by_page.items()}
    assert {name: words for name, words in pages.items() if words} == {}
