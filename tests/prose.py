"""The prose of pages and modules: what `test_words.py` reads.

Each function keeps the number of lines, so that a finding has its line, and leaves `_GAP` where it takes something out,
so that words left and right of code are no phrase.
"""

import json
import re
from collections.abc import Iterable, Iterator

from spellchecker import SpellChecker

_GAP = "•"
_FENCE = re.compile(r"^( *)(```|~~~).*?^ *\2 *$|<!--.*?-->", re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(r"(?<=\n\n)(?:(?: {4}.*|)\n)+")
_CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)|\]\([^)\s]*\)|</?[a-z][^>]*>|https?://\S+", re.DOTALL)
_DOCTEST = re.compile(r"^ *>>> .*\n(?:.*\S.*\n)*", re.MULTILINE)
_FIELD = re.compile(r"\{[^{}]*\}|%\(?\w*\)?[sd]")
_ARGUMENT = re.compile(r"^ +\**\w+: ", re.MULTILINE)
_ANY = re.compile(r".+", re.DOTALL)
_TEXT = re.compile(
    r"""\#(?P<comment>[^\n]*)|(?P<quote>\"{3}|'{3}|\"|')(?P<inside>(?:[^\\]|\\.)*?)(?P=quote)""", re.DOTALL
)
"""A comment, or a string."""
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
    """The comments and docstrings of a module; with `literals` also its other strings, except single words."""
    pieces = []
    end = 0
    for found in _TEXT.finditer(source):
        code = source[end : found.start()]
        pieces.append(_taken_out(_ANY, code) if code.strip() else code)
        inside = found["comment"] or found["inside"]
        if found["comment"]:
            text = _taken_out(_CODE, inside)
        elif found["quote"] == '"""' and not source[source.rfind("\n", 0, found.start()) + 1 : found.start()].strip():
            text = docstring(inside)
        else:
            text = _taken_out(_FIELD, inside) if literals and " " in inside.strip() else _taken_out(_ANY, inside)
        pieces.append(text)
        end = found.end()
    return "".join(pieces)


def docstring(text: str) -> str:
    """A docstring without examples, code and the names of arguments."""
    text = _taken_out(_ARGUMENT, _taken_out(_DOCTEST, text))
    for pattern in (_FENCE, _CODE):
        text = _taken_out(pattern, text)
    return text


def phrases(text: str, wanted: Iterable[str]) -> Iterator[tuple[int, str]]:
    """The line at which a phrase begins, and the phrase: its words in their order, in small or capital letters."""
    small = text.lower()
    for phrase in wanted:
        first, *more = phrase.lower().split()
        if first in small:
            pattern = r"\s+".join(re.escape(word) for word in (first, *more))
            start, end = (r"\b" if phrase[at].isalnum() else "" for at in (0, -1))
            for found in re.finditer(start + pattern + end, small):
                yield text.count("\n", 0, found.start()) + 1, phrase


def words(text: str) -> Iterator[tuple[int, str]]:
    """The line and the small letters of each word that can be misspelt: no code, abbreviations or units."""
    for number, line in enumerate(text.split("\n"), 1):
        for found in _TOKEN.finditer(line):
            word = re.sub(r"['’]s?$", "", found.group().rstrip("."))
            if len(word) > 2 and word.isalpha() and word[1:].islower():
                yield number, word.lower()


def misspelt(text: str, known: Iterable[str]) -> list[tuple[int, str]]:
    """The line and the word of each that is neither English nor known."""
    found = [*words(text)]
    strange = _ENGLISH.unknown({word for _, word in found}) - {*known}
    return [(line, word) for line, word in found if word in strange]


_ENGLISH = SpellChecker()
