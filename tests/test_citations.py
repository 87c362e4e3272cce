"""Pages that the text cites ship with it: whoever reads of `docs/protocols.md` in a docstring can
open it.
"""

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from posixpath import normpath

import pytest

TOP = Path(__file__).parents[1]
EXCEPTIONS = {
    "questions/README.md": "the page that `export questions` writes beside its questions",
    "../conventions.md": "as the reference links it, whose pages are made in docs/api",
}
"""Names that are cited and not there, each with the reason."""
_NOT_TEXT = re.compile(r"https?://\S+|\$\w+/")
"""Addresses of other sites; variables that stand for a folder."""
_PAGE = re.compile(r"[\w./*<>{}~-]*[\w*>}]\.md\b")
_SECTION = re.compile(r"\b(docs/\w+\.md),[\s#]+([A-Z][\w'-]*)")
"""A page and the first word of what follows, which is the section's name if it is a capital one."""


def repository_files() -> list[str]:
    """Without git, since a copy of the checkout has none."""
    found = [path for path in TOP.iterdir() if path.is_file()]
    for folder in (
        "deepaccident_devkit",
        "docs",
        "schema",
        "tests",
        "tutorials",
        "benchmarks",
        ".ci",
    ):
        found += [
            path
            for path in (TOP / folder).rglob("*")
            if path.is_file() and not {"__pycache__", "node_modules"} & {*path.parts}
        ]
    return [
        path.relative_to(TOP).as_posix() for path in found if path.parent != TOP / "docs" / "api"
    ]


def texts(files: list[str]) -> Iterator[tuple[str, str]]:
    """The text files that mention any page, with their text."""
    for name in files:
        path = TOP / name
        content = path.read_bytes() if path.is_file() else b""
        if b".md" in content and b"\0" not in content:
            yield name, _NOT_TEXT.sub("", content.decode("utf-8").replace("\\n", "\n"))


def cited_pages(text: str) -> set[str]:
    """All that looks like a page's name but patterns of names."""
    return {page for page in _PAGE.findall(text) if not set(page) & set("*<>{}~")}


def ships(page: str, citing: str, files: set[str]) -> bool:
    """Whether a page is there: seen from the citing file, from the top, from docs/, or as the end
    of one path alone.
    """
    folders = (str(PurePosixPath(citing).parent), ".", "docs")
    if any(normpath(f"{folder}/{page}") in files for folder in folders):
        return True
    return sum(f"/{name}".endswith(f"/{page}") for name in files) == 1


@pytest.fixture(scope="module")
def files() -> list[str]:
    return repository_files()


@pytest.fixture(scope="module")
def citing(files: list[str]) -> dict[str, str]:
    return dict(texts(files))


def test_every_page_that_is_cited_ships(files: list[str], citing: dict[str, str]) -> None:
    there = {*files}
    missing = {
        f"{name}: {page}"
        for name, text in citing.items()
        for page in cited_pages(text) - EXCEPTIONS.keys()
        if not ships(page, name, there)
    }
    assert sorted(missing) == []


def test_every_section_that_is_cited_is_a_heading(citing: dict[str, str]) -> None:
    headings = {
        name: {
            word
            for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)
            for word in line.split()[:1]
        }
        for name, text in citing.items()
        if name.endswith(".md")
    }
    cited = {
        (name, page, word)
        for name, text in citing.items()
        for page, word in _SECTION.findall(text)
        if page not in EXCEPTIONS
    }
    assert len(cited) > 20
    assert sorted(each for each in cited if each[2] not in headings[each[1]]) == []


def test_the_exceptions_are_needed(files: list[str], citing: dict[str, str]) -> None:
    there = {*files}
    cited = {(page, name) for name, text in citing.items() for page in cited_pages(text)}
    needed = {page for page, name in cited if not ships(page, name, there)}
    assert EXCEPTIONS.keys() - needed == set()
