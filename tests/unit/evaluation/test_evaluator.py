"""Behaviour of every evaluator: counts by token that can be added, merged, stored and summed in any
order.
"""

import json
import math
import os
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.spawned_evaluation import SumEvaluator

from deepaccident_devkit.errors import MAX_MESSAGE_LENGTH, EvaluationError
from deepaccident_devkit.evaluation.evaluator import ratio, total

VALUES = {"a": 1e16, "b": 1.0, "c": -1e16, "d": 0.1}


def evaluator_of(tokens: str, scale: float = 1.0) -> SumEvaluator:
    evaluator = SumEvaluator(scale)
    for token in tokens:
        evaluator.add(token, {"value": VALUES[token]})
    return evaluator


def test_any_order_and_any_split_give_the_same_bits() -> None:
    sums = {evaluator_of("".join(order)).compute() for order in permutations("abcd")}
    assert sums == {1.1}

    for count in range(5):
        merged = evaluator_of("abcd"[:count]).merge(evaluator_of("abcd"[count:]))
        assert (merged.compute(), merged.tokens, len(merged)) == (1.1, set("abcd"), 4)


def test_a_sample_that_comes_again_counts_once_and_is_reported() -> None:
    """Samplers of distributed training repeat samples, in one process or in two."""
    evaluator = evaluator_of("abcd").merge(evaluator_of("bd"))
    assert (evaluator.compute(), evaluator.repeated) == (1.1, {"b", "d"})

    merged = evaluator_of("ab").merge(evaluator_of("a")).merge(evaluator_of("cb"))
    assert (merged.repeated, len(merged)) == ({"a", "b"}, 3)
    assert evaluator_of("a").merge(evaluator).repeated == {"a", "b", "d"}

    message = ("a: evaluated twice", "give each sample one prediction")
    assert_raises(
        (lambda: evaluator.add("a", {"value": 2.0}), EvaluationError, message),
        (lambda: merged.update("a", 3.0), EvaluationError, message),
    )
    assert evaluator.counts["a"] == {"value": 1e16}


def test_results_of_some_samples() -> None:
    evaluator = evaluator_of("abcd")

    assert (evaluator.compute(["b", "d"]), evaluator.compute([])) == (1.1, 0.0)
    assert_raises(
        (
            lambda: evaluator.compute(["a", *"zyxwvut"]),
            EvaluationError,
            ("7 samples have no prediction, such as t",),
        )
    )
    for tokens in ("ab", 3, ["a", 1], [b"a"], [["a"]]):
        assert_raises(
            (partial(evaluator.compute, tokens), EvaluationError, ("tokens: expected", "found"))
        )

    for token in (3, None, b"a"):
        add = partial(SumEvaluator().add, token, {"value": 1.0})
        assert_raises((add, EvaluationError, ("token", "as text", repr(token))))


def test_a_fresh_evaluator_has_only_the_settings() -> None:
    evaluator = evaluator_of("abc", scale=3.0).merge(evaluator_of("b", scale=3.0))
    fresh = evaluator.fresh()
    assert (len(fresh), fresh.settings) == (0, {"scale": 3.0})

    fresh.merge(evaluator_of("a", scale=3.0)).merge(evaluator_of("a", scale=3.0))
    assert (fresh.tokens, fresh.repeated) == ({"a"}, {"a"})
    assert (evaluator.tokens, evaluator.repeated) == ({"a", "b", "c"}, {"b"})
    assert repr(evaluator) == "SumEvaluator(3 samples)"
    assert repr(fresh) == "SumEvaluator(1 sample)"


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    path = evaluator_of("abc").merge(evaluator_of("b")).save(tmp_path / "state.json")
    resumed = SumEvaluator().resume(path)
    assert (resumed.repeated, resumed.merge(evaluator_of("d")).compute()) == ({"b"}, 1.1)

    resumed = evaluator_of("ab").resume(path)
    assert (resumed.compute(), resumed.repeated) == (1.0, {"a", "b"})

    other = evaluator_of("c")
    for token in "abb":
        other.merge(evaluator_of(token))

    other_path = other.save(tmp_path / "other.json")
    assert other_path.read_bytes() == path.read_bytes()


def test_counts_of_other_settings_makers_or_versions_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OtherEvaluator(SumEvaluator):
        """Same settings, other counts."""

    path = evaluator_of("a").save(tmp_path / "state.json")
    assert_raises(
        (
            lambda: evaluator_of("a").merge(evaluator_of("b", scale=2.0)),
            EvaluationError,
            ("cannot merge", "same settings", "2.0"),
        ),
        (
            lambda: evaluator_of("a").merge(OtherEvaluator()),
            EvaluationError,
            ("cannot merge", "SumEvaluator of", "OtherEvaluator of"),
        ),
        (
            lambda: SumEvaluator(scale=2.0).resume(path),
            EvaluationError,
            ("state.json", "saved with other settings", "1.0"),
        ),
        (
            lambda: OtherEvaluator().resume(path),
            EvaluationError,
            ("saved by SumEvaluator of devkit", "this is OtherEvaluator", "start again"),
        ),
    )

    monkeypatch.setattr("deepaccident_devkit.evaluation.sample_counts.__version__", "99")
    assert_raises(
        (
            lambda: SumEvaluator().resume(path),
            EvaluationError,
            ("was saved by", "this is SumEvaluator of devkit 99"),
        )
    )


LONG_TEXT = "x" * 10**6
STATE: dict[str, Any] = {"made_by": "", "settings": {}, "counts": {}, "repeated": []}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        json.dumps(STATE | {"counts": 3}),
        json.dumps(STATE | {"counts": {"a": 3}}),
        json.dumps(STATE | {"repeated": 3}),
        json.dumps(STATE)[:-9],
        "[" * 10**6,
        json.dumps(STATE | {"made_by": LONG_TEXT}),
        json.dumps(STATE | {"made_by": SumEvaluator().maker, "settings": {LONG_TEXT: 1}}),
    ],
    ids=range(10),
)
def test_a_damaged_or_hostile_state_is_refused_in_few_words(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(text, encoding="utf-8")
    message = r"state\.json: (is not a saved evaluation|was saved) .*start again"

    with pytest.raises(EvaluationError, match=message) as raised:
        SumEvaluator().resume(path)
    assert len(str(raised.value)) <= MAX_MESSAGE_LENGTH


def test_places_that_cannot_be_read_or_written_are_our_errors(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    below = tmp_path / "file" / "state.json"

    assert_raises(
        (
            lambda: evaluator_of("a").save(below),
            EvaluationError,
            ("state.json", "cannot be saved", "choose another file"),
        ),
        (lambda: SumEvaluator().resume(tmp_path / "pipe"), EvaluationError, ("a named pipe",)),
        (
            lambda: SumEvaluator().resume(tmp_path / "nowhere"),
            EvaluationError,
            ("nowhere", "is not a saved evaluation"),
        ),
    )


def test_counts_cannot_be_changed() -> None:
    evaluator = evaluator_of("a")
    with pytest.raises(TypeError):
        evaluator.counts["b"] = {}  # type: ignore[index]

    evaluator.counts["a"]["value"] = 2.0  # type: ignore[index]
    evaluator.add("n", {"value": 1.0, "lists": [[1], {"of": [2]}]})
    evaluator.counts["n"]["lists"][1]["of"].append(3)
    assert evaluator.counts["n"]["lists"] == [[1], {"of": [2]}]
    assert evaluator.compute(["a"]) == 1e16

    assert list(evaluator.counts) == ["a", "n"]
    assert len(evaluator.counts) == 2
    assert "a" in evaluator.counts
    assert list(evaluator.pooled([{"value": 1.0}])) == [{"value": 1.0}]


def test_draws_repeat_whole_parts() -> None:
    evaluator = evaluator_of("abcd")
    parts = [[{"value": 1.0}, {"value": 2.0}], [{"value": 10.0}]]
    repetitions = np.array([[1, 1], [2, 0], [0, 3], [0, 0]])

    assert list(evaluator.resampled(parts, repetitions)) == [13.0, 6.0, 30.0, 0.0]
    assert evaluator.has_intervals


def test_ratios_and_totals() -> None:
    assert (ratio(1, 4), ratio(0, 4)) == (0.25, 0.0)
    assert math.isnan(ratio(0, 0))
    assert total([{"a": 1e16}, {"a": 1.0}, {"a": -1e16}], "a") == 1.0
