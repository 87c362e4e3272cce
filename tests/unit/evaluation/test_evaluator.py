"""What all evaluators share: counts by token that can be added, merged, stored and summed in any order."""

import json
import math
from collections.abc import Collection
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total

VALUES = {"a": 1e16, "b": 1.0, "c": -1e16, "d": 0.1}


class Sums(Evaluator[float]):
    """The sum of a number."""

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale

    @property
    def settings(self) -> dict[str, Any]:
        return {"scale": self.scale}

    def result_of(self, counts: Collection[Counts]) -> float:
        return self.scale * total(counts, "value")


def filled(tokens: str, scale: float = 1.0) -> Sums:
    evaluator = Sums(scale)
    for token in tokens:
        evaluator.add(token, {"value": VALUES[token]})
    return evaluator


def test_any_order_gives_the_same_bits() -> None:
    assert {filled("".join(order)).compute() for order in permutations("abcd")} == {1.1}


def test_any_split_gives_the_same_bits() -> None:
    for count in range(5):
        merged = filled("abcd"[:count]).merge(filled("abcd"[count:]))
        assert merged.compute() == 1.1
        assert merged.tokens == set("abcd")
        assert len(merged) == 4


def test_a_sample_that_comes_again_counts_once_and_is_reported() -> None:
    evaluator = filled("abcd").merge(filled("bd"))
    assert evaluator.compute() == 1.1
    assert evaluator.repeated == {"b", "d"}
    assert filled("a").merge(evaluator).repeated == {"a", "b", "d"}


def test_a_sample_with_two_results_is_an_error() -> None:
    evaluator = filled("ab")
    with pytest.raises(EvaluationError, match="a: evaluated twice, with different results"):
        evaluator.add("a", {"value": 2.0})
    assert evaluator.counts["a"] == {"value": 1e16}


def test_evaluators_of_other_settings_do_not_merge() -> None:
    with pytest.raises(EvaluationError, match=r"cannot merge.*evaluate both with the same settings"):
        filled("a").merge(filled("b", scale=2.0))


def test_some_samples_alone() -> None:
    evaluator = filled("abcd")
    assert evaluator.compute("bd") == 1.1
    assert evaluator.compute([]) == 0.0
    with pytest.raises(EvaluationError, match="1 samples have no prediction, such as x"):
        evaluator.compute("ax")


def test_a_broken_off_run_goes_on(tmp_path: Path) -> None:
    path = filled("abc").merge(filled("b")).save(tmp_path / "state.json")
    resumed = Sums().resume(path)
    assert resumed.repeated == {"b"}
    assert resumed.merge(filled("d")).compute() == 1.1
    again = filled("ab").resume(path)
    assert again.compute() == 1.0
    assert again.repeated == {"a", "b"}


def test_a_run_of_other_settings_does_not_go_on(tmp_path: Path) -> None:
    path = filled("a").save(tmp_path / "state.json")
    with pytest.raises(EvaluationError, match="was saved with other settings"):
        Sums(scale=2.0).resume(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", json.dumps({"settings": {}, "counts": 3, "repeated": []})])
def test_a_damaged_state_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(EvaluationError, match=r"state\.json: no saved evaluation .*begin anew"):
        Sums().resume(path)
    with pytest.raises(EvaluationError, match="nowhere"):
        Sums().resume(tmp_path / "nowhere")


def test_counts_are_a_view() -> None:
    evaluator = filled("a")
    with pytest.raises(TypeError):
        evaluator.counts["b"] = {}  # type: ignore[index]
    assert list(evaluator.pooled([{"value": 1.0}])) == [{"value": 1.0}]


def test_a_ratio_of_nothing_is_nan() -> None:
    assert ratio(1, 4) == 0.25
    assert math.isnan(ratio(0, 0))
