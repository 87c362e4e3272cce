"""The mutation campaign's own parts: what a mutant is, and how it is planted."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest
from mutation.mutants import changes, mutated
from mutation.planting import plant

SOURCE = '''
"""A text of 3 words, which is not changed."""
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
    descriptions = [words for _, _, words in changes(ast.parse(SOURCE))]
    numbers = (2, 5, 4, 3, 9)
    assert sorted(descriptions) == sorted(
        [
            *(f"{number} → {number + 1}" for number in numbers),
            *(f"{number} → {number - 1}" for number in numbers),
            "x > 9 → x >= 9",
            "x > 9 → x <= 9",
            "x < LIMIT → x <= LIMIT",
            "x < LIMIT → x >= LIMIT",
            "raise ValueError(f'{x} > 9') → pass",
            "return x < LIMIT → return None",
            "return (LIMIT, RULES.limit, Rules().limit, near.__wrapped__. → return None",
        ]
    )

    num_mutants = len(descriptions)
    mutants = [ast.unparse(mutated(SOURCE, number)) for number in range(num_mutants)]
    assert len({*mutants, ast.unparse(ast.parse(SOURCE))}) == num_mutants + 1


@pytest.mark.parametrize(
    ("old", "new", "values"),
    [
        ("x < LIMIT", "x <= LIMIT", (True, 2, 4, 5, (3,))),
        ("LIMIT = 2", "LIMIT = 7", (True, 7, 4, 5, (3,))),
        ("limit=4", "limit=8", (False, 2, 8, 5, (3,))),
        ("int = 5", "int = 6", (False, 2, 4, 6, (3,))),
        ("int = 3", "int = 1", (False, 2, 4, 5, (1,))),
    ],
)
def test_a_mutant_is_planted_in_every_object_that_holds_the_value(
    tmp_path: Path, monkeypatch, old, new, values
) -> None:
    path = tmp_path / "planted_here.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("planted_here", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "planted_here", module)
    spec.loader.exec_module(module)
    near, limits = module.near, module.limits
    mutant = ast.parse(SOURCE.replace(old, new))

    assert plant(module, ast.parse(SOURCE)) is False
    assert (near.__wrapped__(2), *limits()) == (False, 2, 4, 5, (3,))
    assert plant(module, mutant) is True
    assert (near.__wrapped__(2), *limits()) == values
