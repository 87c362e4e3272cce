"""The mutation campaign's own parts: what is a mutant, how it is planted, which are drawn."""

import ast
import importlib.util
import sys
from collections import Counter
from pathlib import Path

import pytest
from mutation.mutants import changes, mutated
from mutation.planting import plant

SOURCE = '''
"""A text of 3 words, which is left alone."""
from dataclasses import dataclass
from functools import lru_cache

LIMIT = 2

@dataclass(frozen=True, kw_only=True)
class Rules:
    limit: int = 5

RULES = Rules(limit=4)

@lru_cache(maxsize=8)
def near(x: int = 3) -> bool:
    if x > 9:
        raise ValueError(f"{x} > 9")
    return x < LIMIT

def limits():
    return LIMIT, RULES.limit, Rules().limit, near.__wrapped__.__defaults__
'''


def test_mutants_of_a_source() -> None:
    words = Counter(words for _, _, words in changes(ast.parse(SOURCE)))
    assert words == Counter(
        {
            **{f"{number} → {number + way}": 1 for number in (2, 5, 4, 3, 9) for way in (1, -1)},
            **{f"x > 9 → x {sign} 9": 1 for sign in (">=", "<=")},
            **{f"x < LIMIT → x {sign} LIMIT": 1 for sign in ("<=", ">=")},
            "raise ValueError(f'{x} > 9') → pass": 1,
            "return x < LIMIT → return None": 1,
            "return (LIMIT, RULES.limit, Rules().limit, near.__wrapped__. → return None": 1,
        }
    )
    lines = [ast.unparse(mutated(SOURCE, number)) for number in range(words.total())]
    assert len({*lines, ast.unparse(ast.parse(SOURCE))}) == words.total() + 1


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [
        ("x < LIMIT", "x <= LIMIT", (True, 2, 4, 5, (3,))),
        ("LIMIT = 2", "LIMIT = 7", (True, 7, 4, 5, (3,))),
        ("limit=4", "limit=8", (False, 2, 8, 5, (3,))),
        ("int = 5", "int = 6", (False, 2, 4, 6, (3,))),
        ("int = 3", "int = 1", (False, 2, 4, 5, (1,))),
    ],
)
def test_a_mutant_is_planted_wherever_it_is_held(
    tmp_path: Path, monkeypatch, before, after, found
) -> None:
    path = tmp_path / "planted_here.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("planted_here", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "planted_here", module)
    spec.loader.exec_module(module)
    near, limits = module.near, module.limits
    for source, planted, held in (
        (SOURCE, False, (False, 2, 4, 5, (3,))),
        (SOURCE.replace(before, after), True, found),
    ):
        assert (plant(module, ast.parse(source)), near.__wrapped__(2), *limits()) == (
            planted,
            *held,
        )
