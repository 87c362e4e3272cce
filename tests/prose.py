"""The prose of pages and modules: what `test_words.py` reads.

Each function keeps the number of lines, so that a finding has its line, and leaves `_GAP` where it takes something out,
so that words left and right of code are no phrase.
"""

import io
import json
import re
import tokenize
from collections.abc import Iterable, Iterator

from spellchecker import SpellChecker

_GAP = "•"
_FENCE = re.compile(r"^( *)(```|~~~).*?^ *\2 *$|<!--.*?-->", re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(r"(?<=\n\n)(?:(?: {4}.*|)\n)+")
_CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)|\]\([^)\s]*\)|</?[a-z][^>]*>|https?://\S+", re.DOTALL)
_DOCTEST = re.compile(r"^ *>>> .*\n(?:.*\S.*\n)*", re.MULTILINE)
_FIELD = re.compile(r"\{[^{}]*\}|%\(?\w*\)?[sd]")
_ARGUMENT = re.compile(r"^ +\**\w+: ", re.MULTILINE)
_TOKEN = re.compile(r"[^\W\d][\w'’]*(?:\.\w[\w.]*)?|\d[\w.]*")


def _taken_out(pattern: re.Pattern[str], text: str) -> str:
    return pattern.sub(lambda found: _GAP + "\n" * found.group().count("\n"), text)


def markdown(text: str) -> str:
    """A page without code, the targets of links, HTML and comments."""
    for pattern in (_FENCE, _INDENTED, _CODE):
        text = _taken_out(pattern, text)
    return text


def notebook(text: str) -> str:
    """The Markdown of a notebook, each line at its line of the file."""
    raw = text.splitlines()
    lines = [_GAP] * len(raw)
    at = 0
    for cell in json.loads(text)["cells"]:
        for line in cell["source"]:
            quoted = json.dumps(line, ensure_ascii=False)
            at = next(number for number in range(at, len(raw)) if quoted in raw[number]) + 1
            if cell["cell_type"] == "markdown":
                lines[at - 1] = line.rstrip("\n")
    return markdown("\n".join(lines))


def python(source: str, *, literals: bool) -> str:
    """The comments and docstrings of a module; with `literals` also its other strings, but for single words."""
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    lines: list[list[str]] = [[] for _ in range(source.count("\n") + 2)]
    apart = {tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENCODING}
    before = tokenize.NEWLINE
    for number, token in enumerate(tokens):
        words = ""
        if token.type == tokenize.COMMENT:
            words = markdown(token.string.lstrip("#"))
        elif token.type == tokenize.STRING and before == tokenize.NEWLINE and tokens[number + 1].type in apart:
            words = docstring(_inside(token.string))
        elif literals and (token.type == tokenize.STRING or tokenize.tok_name[token.type] == "FSTRING_MIDDLE"):
            inside = _inside(token.string) if token.type == tokenize.STRING else token.string
            words = _taken_out(_FIELD, inside) if " " in inside.strip() else _GAP
        elif token.type not in apart and tokenize.tok_name[token.type] not in ("FSTRING_START", "FSTRING_END"):
            words = _GAP
        if token.type not in apart or token.type == tokenize.NEWLINE:
            before = token.type
        for row, line in enumerate(words.split("\n"), token.start[0] - 1):
            lines[row].append(line)
    return "\n".join(" ".join(line) for line in lines)


def docstring(text: str) -> str:
    """A docstring without examples, code and the names of arguments."""
    text = _taken_out(_ARGUMENT, _taken_out(_DOCTEST, text))
    for pattern in (_FENCE, _CODE):
        text = _taken_out(pattern, text)
    return text


def _inside(literal: str) -> str:
    """What a string literal has between its quotes."""
    return re.sub(r"^[a-zA-Z]*('''|\"\"\"|'|\")(.*)\1$", r"\2", literal, flags=re.DOTALL)


def phrases(text: str, phrase: str) -> Iterator[int]:
    """The lines of a text in which a phrase begins: its words in their order, in small or capital letters."""
    words = r"\s+".join(re.escape(word) for word in phrase.split())
    start = r"\b" if phrase[0].isalnum() else ""
    end = r"\b" if phrase[-1].isalnum() else ""
    for found in re.finditer(start + words + end, text, re.IGNORECASE):
        yield text.count("\n", 0, found.start()) + 1


def words(text: str) -> Iterator[tuple[int, str]]:
    """The line and the small letters of each word that can be misspelt: no names of code, no abbreviations."""
    for number, line in enumerate(text.split("\n"), 1):
        for found in _TOKEN.finditer(line):
            word = re.sub(r"['’]s?$", "", found.group().rstrip("."))
            if word[1:].islower() and not re.search(r"[\d_.]", word):
                yield number, word.lower()


def misspelt(text: str, known: Iterable[str]) -> list[tuple[int, str]]:
    """The line and the word of each that is neither English nor known."""
    found = [*words(text)]
    strange = _ENGLISH.unknown({word for _, word in found}) - {*known}
    return [(line, word) for line, word in found if word in strange]


_ENGLISH = SpellChecker()
