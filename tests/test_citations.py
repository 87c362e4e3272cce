"""Every page that a text cites ships with it: a reader of a docstring can open it."""

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
"""Name of a page that is cited although it does not exist → reason."""
_ADDRESS = re.compile(r"https?://\S+|\$\w+/")
"""Addresses of other sites; variables that stand for a folder."""
_PAGE_NAME = re.compile(r"[\w./*<>{}~-]*[\w*>}]\.md\b")
_SECTION_CITATION = re.compile(r"\b(docs/\w+\.md),[\s#]+([A-Z][\w'-]*)")
"""A page followed by the first word of a section's name, which begins with a capital letter."""


def repository_files() -> list[str]:
    """List the files without git, since a copy of the checkout may not have it."""
    paths = [*TOP.iterdir()]
    for folder in (
        "deepaccident_devkit",
        "docs",
        "schema",
        "tests",
        "tutorials",
        "benchmarks",
        ".ci",
    ):
        for path in (TOP / folder).rglob("*"):
            if {"__pycache__", "node_modules"}.isdisjoint(path.parts):
                paths.append(path)
    return [
        path.relative_to(TOP).as_posix()
        for path in paths
        if path.is_file() and path.parent != TOP / "docs" / "api"
    ]


def citing_texts(files: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the name and text of each text file that mentions a page."""
    for name in files:
        path = TOP / name
        content = path.read_bytes() if path.is_file() else b""
        if b".md" in content and b"\0" not in content:
            yield name, _ADDRESS.sub("", content.decode("utf-8").replace("\\n", "\n"))


def cited_pages(text: str) -> set[str]:
    """Return everything that looks like a page's name, except patterns of names."""
    names = _PAGE_NAME.findall(text)
    return {name for name in names if set(name).isdisjoint("*<>{}~")}


def ships(page: str, citing_file: str, files: set[str]) -> bool:
    """Return whether a page exists.

    Its name is relative to the citing file, to the top or to docs/, or is the end of exactly one
    path.
    """
    folders = (str(PurePosixPath(citing_file).parent), ".", "docs")
    if any(normpath(f"{folder}/{page}") in files for folder in folders):
        return True
    return sum(f"/{name}".endswith(f"/{page}") for name in files) == 1


@pytest.fixture(scope="module")
def files() -> list[str]:
    return repository_files()


@pytest.fixture(scope="module")
def texts(files: list[str]) -> dict[str, str]:
    return dict(citing_texts(files))


@pytest.fixture(scope="module")
def missing_pages(files: list[str], texts: dict[str, str]) -> set[tuple[str, str]]:
    """Citing file and page, for each page that does not exist."""
    existing_files = set(files)
    return {
        (name, page)
        for name, text in texts.items()
        for page in cited_pages(text)
        if not ships(page, name, existing_files)
    }


def test_every_page_that_is_cited_ships(missing_pages: set[tuple[str, str]]) -> None:
    assert sorted(missing for missing in missing_pages if missing[1] not in EXCEPTIONS) == []


def test_every_section_that_is_cited_is_a_heading(texts: dict[str, str]) -> None:
    citations = {
        (name, page, word)
        for name, text in texts.items()
        for page, word in _SECTION_CITATION.findall(text)
        if page not in EXCEPTIONS
    }
    wrong_citations = [
        (name, page, word)
        for name, page, word in citations
        if not re.search(rf"^#+ +{re.escape(word)}(\s|$)", texts[page], re.MULTILINE)
    ]

    assert len(citations) > 20
    assert sorted(wrong_citations) == []


def test_the_exceptions_are_needed(missing_pages: set[tuple[str, str]]) -> None:
    assert EXCEPTIONS.keys() - {page for _, page in missing_pages} == set()
