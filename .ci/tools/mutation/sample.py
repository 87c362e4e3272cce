"""The drawing of mutants by a seed, from each file in proportion to its lines of code."""

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
    """Draw at most `count` mutants of all areas, from each file in proportion to its lines of code.

    Any beginning of the list is a sample of the same kind: a smaller count draws the first mutants
    of a larger one.
    """
    ranked_mutants = []
    for path in _source_files():
        mutants = mutants_of(path)
        lines = lines_of_code(path.read_text(encoding="utf-8"))
        Random(f"{seed} {path.relative_to(PACKAGE)}").shuffle(mutants)  # noqa: S311
        for rank, mutant in enumerate(mutants):
            ranked_mutants.append(((rank + 0.5) / lines, mutant.key, mutant))
    ranked_mutants.sort(key=lambda ranked: ranked[:2])
    return [mutant for _, _, mutant in ranked_mutants[:count]]


def _source_files() -> Iterator[Path]:
    """Yield the files of all areas."""
    for area in AREAS:
        if area.endswith(".py"):
            yield PACKAGE / area
        else:
            yield from sorted((PACKAGE / area).rglob("*.py"))


def mutants_of(path: Path) -> list[Mutant]:
    """Return all mutants of a file, in the order of its text."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    source_hash = fingerprint(source)
    functions = list(_functions(tree))
    name = path.relative_to(PACKAGE).as_posix()
    mutants = []
    for number, (node, _, words) in enumerate(changes(tree)):
        line = node.lineno if hasattr(node, "lineno") else node.target.lineno
        enclosing = [(start, end) for start, body, end in functions if body <= line <= end]
        span = enclosing[0] if enclosing else None
        change = _change_within_line(node, words, source)
        mutants.append(Mutant(name, number, line, span, change, source_hash))
    return mutants


def _change_within_line(node: ast.AST, words: str, source: str) -> str:
    """Return a change in brackets within its line; only the change if it spans several lines."""
    if getattr(node, "end_lineno", 0) != getattr(node, "lineno", None):
        return words
    line = source.splitlines()[node.lineno - 1].encode()  # columns count bytes
    before = line[: node.col_offset].decode().lstrip()
    after = line[node.end_col_offset :].decode()
    return f"{before}[{words}]{after}"


def fingerprint(text: str) -> str:
    """Return a short hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def lines_of_code(source: str) -> int:
    """Count the lines that hold a statement or a part of one: no blanks, comments or docstrings."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not is_text:
            body = getattr(node, "body", None)
            end = body[0].lineno if body else node.end_lineno + 1
            lines.update(range(node.lineno, end))
    return max(len(lines), 1)


def _functions(tree: ast.Module) -> Iterator[tuple[int, int, int]]:
    """Yield the first line, the body's first line and the last line of each outermost function."""
    statements: Sequence[ast.stmt] = tree.body
    while statements:
        for node in statements:
            if isinstance(node, ast.FunctionDef):
                first_line = min(part.lineno for part in (node, *node.decorator_list))
                yield first_line, node.body[0].lineno, node.end_lineno
        classes = [node for node in statements if isinstance(node, ast.ClassDef)]
        statements = [member for node in classes for member in node.body]
