"""Pages and docstrings are spelt right: each word is English, or in tests/data/words/known.txt."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

from spellchecker import SpellChecker

TOP = Path(__file__).parents[1]
READ = (
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
"""In docstrings: examples, and names of arguments."""
TOKEN = re.compile(r"[^\W\d][\w'’]*(?:\.\w[\w.]*)?|\d[\w.]*")


def prose(path: Path) -> str:
    """A page, the Markdown of a notebook, or the docstrings of a module, without code."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join(
            "".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"
        )
    if path.suffix == ".py":
        nodes = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
        texts = [
            node.value
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        return CODE.sub(
            " • ",
            re.sub(r"^ +", " ", EXAMPLE_OR_NAME.sub("", "\n".join(texts)), flags=re.MULTILINE),
        )
    return CODE.sub(" • ", text)


def words(text: str) -> Iterator[str]:
    """The small letters of each word that can be misspelt: no abbreviations, units or names of
    code.
    """
    for token in TOKEN.findall(text):
        word = re.sub(r"['’]s?$", "", token.rstrip("."))
        if len(word) > 2 and word.isalpha() and word[1:].islower():
            yield word.lower()


def test_all_words_are_spelt_right() -> None:
    known = (TOP / "tests" / "data" / "words" / "known.txt").read_text(encoding="utf-8").split()
    paths = [path for pattern in READ for path in TOP.glob(pattern) if path.name != "CHANGELOG.md"]
    used = {path.relative_to(TOP).as_posix(): {*words(prose(path))} for path in paths}
    strange = SpellChecker().unknown(set.union(*used.values())) - {*known}
    assert {name: sorted(of & strange) for name, of in used.items() if of & strange} == {}
