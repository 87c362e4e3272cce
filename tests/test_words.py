"""The house's words: what CONTRIBUTING.md bans does not occur, and all prose is spelt right."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from prose import markdown, misspelt, notebook, phrases, python, words

TOP = Path(__file__).parents[1]
KNOWN = TOP / "tests" / "data" / "words" / "known.txt"
MODULES = [*(TOP / "deepaccident_devkit").rglob("*.py"), *(TOP / "docs").glob("*.py")]
PAGES = [
    *(TOP / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "SECURITY.md")),
    *(path for folder in ("docs", "schema", "benchmarks", "tutorials") for path in (TOP / folder).rglob("*.md")),
]
NOTEBOOKS = [*(TOP / "tutorials").glob("*.ipynb")]


def banned() -> dict[str, tuple[str, str]]:
    """The phrases of the second column of the table in CONTRIBUTING.md → what to write, and why."""
    section = (TOP / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("\n## Words\n")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if "|" in line]
    return {phrase: (write, why) for write, column, why in rows for phrase in re.findall(r"`([^`]+)`", column)}


def texts(*, literals: bool) -> dict[str, str]:
    """The prose of each file, by its path below the top; with `literals` also the strings of modules."""
    readers: list[tuple[list[Path], Callable[[str], str]]] = [
        (PAGES, markdown),
        (NOTEBOOKS, notebook),
        (MODULES, lambda text: python(text, literals=literals)),
    ]
    return {
        path.relative_to(TOP).as_posix(): read(path.read_text(encoding="utf-8"))
        for paths, read in readers
        for path in paths
    }


@pytest.fixture(scope="module")
def prose() -> dict[str, str]:
    return texts(literals=False)


@pytest.fixture(scope="module")
def known() -> list[str]:
    return KNOWN.read_text(encoding="utf-8").splitlines()


def test_no_banned_phrase_is_used(prose: dict[str, str]) -> None:
    table = banned()
    spelling = {phrase for phrase, (_, why) in table.items() if "British" in why}
    assert table.keys() > spelling > set()
    found = [
        f"{name}:{line}: {phrase!r}: write {table[phrase][0]}, because: {table[phrase][1]}"
        for read, wanted in (
            (prose, spelling),
            (texts(literals=True), table.keys() - spelling),
        )  # "center" is matplotlib's
        for name, text in read.items()
        for line, phrase in phrases(text, wanted)
    ]
    assert found == []


def test_all_words_are_spelt_right(prose: dict[str, str], known: list[str]) -> None:
    found = [
        f"{name}:{line}: {word}"
        for name, text in prose.items()
        if name != "CHANGELOG.md"
        for line, word in misspelt(text, known)
    ]
    assert found == []


def test_the_known_words_are_sorted_and_used(prose: dict[str, str], known: list[str]) -> None:
    assert known == sorted({*known})
    used = {word for text in prose.values() for _, word in words(text)}
    assert sorted({*known} - used) == []


def test_a_misspelling_is_found() -> None:
    text = "# A heading\n\nTwo vehicles colide at the `juncton`, and\n[a link](#junctoin) has 2.5e-3 IoU.\n"
    assert misspelt(markdown(text), []) == [(3, "colide")]
    assert misspelt(markdown(text), ["colide"]) == []
    assert misspelt(markdown("```\ncolide\n```\n<!-- colide -->\n\n    colide\n\nA colide.\n"), []) == [(8, "colide")]
    assert misspelt("the ego's vehicles' snake_case CamelCase np.arange", []) == []


def test_docstrings_comments_and_messages_are_read() -> None:
    source = (
        '"""A modul."""\n\nVALUE = "colide"\n"""Its `colide` wrod."""\n\n\ndef f(colide):\n'
        '    """Does.\n\n    Args:\n        colide: an argumnet.\n\n    >>> colide\n    """\n'
        '    raise ValueError(f"{colide}: a mesage")  # a coment\n'
    )
    compile(source, "", "exec")
    assert misspelt(python(source, literals=False), ["args"]) == [
        (1, "modul"), (4, "wrod"), (11, "argumnet"), (15, "coment"),
    ]  # fmt: skip
    assert (15, "mesage") in misspelt(python(source, literals=True), [])


def test_a_phrase_is_found_over_lines_and_not_over_code() -> None:
    assert [*phrases("one\nof What\n  there, soft what there", ["of what there"])] == [(2, "of what there")]
    source = 'call("a draw", is_none="on a")  # or\nmore = ("an alarm that "\n    "is none", none)\n'
    assert [*phrases(python(source, literals=True), ["draw on", "that is none", "none none"])] == [(2, "that is none")]


def test_a_notebooks_lines_are_those_of_the_file() -> None:
    cells = '{"cell_type": "code", "source": [\n"colide"]},\n{"cell_type": "markdown", "source": [\n"colide"]}'
    text = f'{{"cells": [\n{cells}]}}'
    assert misspelt(notebook(text), []) == [(5, "colide")]


def test_the_readme_is_short() -> None:
    assert len((TOP / "README.md").read_text(encoding="utf-8").split()) < 700
