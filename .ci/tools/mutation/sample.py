"""Which mutants are drawn."""

import ast
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random

from mutation.mutants import Mutant, changes

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "deepaccident_devkit"
AREAS = ("geometry", "motion", "evaluation", "v2x", "selection/splits.py")


def drawn(count: int, seed: int) -> list[Mutant]:
    """So many mutants of all areas, of each file in proportion to its lines of code, as far as it
    has as many.

    They come in an order of which every beginning is such a sample too: fewer are the first of
        more.
    """
    ranked = []
    for area in AREAS:
        for path in (
            [PACKAGE / area] if area.endswith(".py") else sorted((PACKAGE / area).rglob("*.py"))
        ):
            mutants, lines = mutants_of(path), lines_of_code(path.read_text(encoding="utf-8"))
            Random(f"{seed} {path.relative_to(PACKAGE)}").shuffle(mutants)  # noqa: S311
            ranked += [
                ((rank + 0.5) / lines, mutant.key, mutant) for rank, mutant in enumerate(mutants)
            ]
    return [mutant for _, _, mutant in sorted(ranked, key=lambda each: each[:2])[:count]]


def mutants_of(path: Path) -> list[Mutant]:
    """All of one file, in the order of its text."""
    source = path.read_text(encoding="utf-8")
    tree, mark = ast.parse(source), fingerprint(source)
    spans = [*_functions(tree)]
    name = path.relative_to(PACKAGE).as_posix()
    found = []
    for number, (node, _, words) in enumerate(changes(tree)):
        line = node.lineno if hasattr(node, "lineno") else node.target.lineno
        span = next(((start, end) for start, body, end in spans if body <= line <= end), None)
        found.append(Mutant(name, number, line, span, _in_its_line(node, words, source), mark))
    return found


def _in_its_line(node: ast.AST, words: str, source: str) -> str:
    """The line of a change that has a place within one, with the change in brackets."""
    if getattr(node, "end_lineno", 0) != getattr(node, "lineno", None):
        return words
    line = source.splitlines()[node.lineno - 1].encode()  # columns are of bytes
    return f"{line[: node.col_offset].decode().lstrip()}[{words}]{line[node.end_col_offset :].decode()}"  # noqa: E501


def fingerprint(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def lines_of_code(source: str) -> int:
    """Lines with a statement or a part of one: no blanks, comments or docstrings."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not text:
            body = getattr(node, "body", None)
            lines.update(range(node.lineno, body[0].lineno if body else node.end_lineno + 1))
    return max(len(lines), 1)


def _functions(tree: ast.Module) -> Iterator[tuple[int, int, int]]:
    """Of the outermost functions, those of classes among them: the first line, that of the body,
    the last one.
    """
    waiting: Sequence[ast.stmt] = tree.body
    while waiting:
        classes = [node for node in waiting if isinstance(node, ast.ClassDef)]
        for node in waiting:
            if isinstance(node, ast.FunctionDef):
                yield (
                    min(each.lineno for each in (node, *node.decorator_list)),
                    node.body[0].lineno,
                    node.end_lineno,
                )
        waiting = [inner for outer in classes for inner in outer.body]
