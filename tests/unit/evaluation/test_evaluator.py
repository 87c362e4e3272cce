"""What all evaluators share: counts by token that can be added, merged, stored and summed in any
order.
"""

import json
import math
import os
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import Sums
from refusals import assert_refused

from deepaccident_devkit.errors import MOST_SAID, EvaluationError
from deepaccident_devkit.evaluation.evaluator import ratio, total

VALUES = {"a": 1e16, "b": 1.0, "c": -1e16, "d": 0.1}


def filled(tokens: str, scale: float = 1.0) -> Sums:
    evaluator = Sums(scale)
    for token in tokens:
        evaluator.add(token, {"value": VALUES[token]})
    return evaluator


def test_any_order_and_any_split_give_the_same_bits() -> None:
    assert {filled("".join(order)).compute() for order in permutations("abcd")} == {1.1}
    for count in range(5):
        merged = filled("abcd"[:count]).merge(filled("abcd"[count:]))
        assert (merged.compute(), merged.tokens, len(merged)) == (1.1, set("abcd"), 4)


def test_a_sample_that_comes_again_counts_once_and_is_reported() -> None:
    """As samplers of distributed training repeat them: in one process or in two."""
    evaluator = filled("abcd").merge(filled("bd"))
    assert (evaluator.compute(), evaluator.repeated) == (1.1, {"b", "d"})
    merged = filled("ab").merge(filled("a")).merge(filled("cb"))
    assert (merged.repeated, len(merged)) == ({"a", "b"}, 3)
    assert filled("a").merge(evaluator).repeated == {"a", "b", "d"}
    twice = ("a: evaluated twice", "give each sample one prediction")
    assert_refused(
        (lambda: evaluator.add("a", {"value": 2.0}), EvaluationError, twice),
        (lambda: merged.update("a", 3.0), EvaluationError, twice),
    )
    assert evaluator.counts["a"] == {"value": 1e16}


def test_some_samples_alone() -> None:
    evaluator = filled("abcd")
    assert (evaluator.compute(["b", "d"]), evaluator.compute([])) == (1.1, 0.0)
    assert_refused(
        (
            lambda: evaluator.compute(["a", *"zyxwvut"]),
            EvaluationError,
            ("7 samples have no prediction, such as t",),
        ),
        *(
            (
                lambda given=given: evaluator.compute(given),
                EvaluationError,
                ("tokens: expected", "found"),
            )
            for given in ("ab", 3, ["a", 1], [b"a"], [["a"]])
        ),
        *(
            (
                lambda token=token: Sums().add(token, {"value": 1.0}),
                EvaluationError,
                ("token", "a text", repr(token)),
            )
            for token in (3, None, b"a")
        ),
    )


def test_a_fresh_one_has_the_settings_alone() -> None:
    one = filled("abc", scale=3.0).merge(filled("b", scale=3.0))
    fresh = one.fresh()
    assert (len(fresh), fresh.settings) == (0, {"scale": 3.0})
    fresh.merge(filled("a", scale=3.0)).merge(filled("a", scale=3.0))
    assert (fresh.tokens, fresh.repeated, one.tokens, one.repeated) == (
        {"a"},
        {"a"},
        {"a", "b", "c"},
        {"b"},
    )
    assert [repr(each) for each in (one, fresh)] == ["Sums(3 samples)", "Sums(1 sample)"]


def test_a_broken_off_run_goes_on(tmp_path: Path) -> None:
    path = filled("abc").merge(filled("b")).save(tmp_path / "state.json")
    resumed = Sums().resume(path)
    assert (resumed.repeated, resumed.merge(filled("d")).compute()) == ({"b"}, 1.1)
    again = filled("ab").resume(path)
    assert (again.compute(), again.repeated) == (1.0, {"a", "b"})
    other = (
        filled("c")
        .merge(filled("a"))
        .merge(filled("b"))
        .merge(filled("b"))
        .save(tmp_path / "other.json")
    )
    assert other.read_bytes() == path.read_bytes()


def test_runs_and_evaluators_of_other_settings_makers_or_versions_do_not_go_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Others(Sums):
        """Same settings, other counts."""

    path = filled("a").save(tmp_path / "state.json")
    assert_refused(
        (
            lambda: filled("a").merge(filled("b", scale=2.0)),
            EvaluationError,
            ("cannot merge", "same settings", "2.0"),
        ),
        (
            lambda: filled("a").merge(Others()),
            EvaluationError,
            ("cannot merge", "Sums of", "Others of"),
        ),
        (
            lambda: Sums(scale=2.0).resume(path),
            EvaluationError,
            ("state.json", "saved with other settings", "1.0"),
        ),
        (
            lambda: Others().resume(path),
            EvaluationError,
            ("saved by Sums of devkit", "this is Others", "begin again"),
        ),
    )
    monkeypatch.setattr("deepaccident_devkit.evaluation.sample_counts.__version__", "99")
    assert_refused(
        (
            lambda: Sums().resume(path),
            EvaluationError,
            ("was saved by", "this is Sums of devkit 99"),
        )
    )


LONG = "x" * 10**6
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
        json.dumps(STATE | {"made_by": LONG}),
        json.dumps(STATE | {"made_by": Sums().maker, "settings": {LONG: 1}}),
    ],
    ids=range(10),
)
def test_a_damaged_or_hostile_state_is_refused_in_few_words(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(
        EvaluationError, match=r"state\.json: (no saved evaluation|was saved) .*begin again"
    ) as raised:
        Sums().resume(path)
    assert len(str(raised.value)) <= MOST_SAID


def test_places_that_cannot_be_read_or_written_are_our_errors(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    below = tmp_path / "file" / "state.json"
    assert_refused(
        (
            lambda: filled("a").save(below),
            EvaluationError,
            ("state.json", "cannot be saved", "choose another file"),
        ),
        (lambda: Sums().resume(tmp_path / "pipe"), EvaluationError, ("a named pipe",)),
        (
            lambda: Sums().resume(tmp_path / "nowhere"),
            EvaluationError,
            ("nowhere", "no saved evaluation"),
        ),
    )


def test_counts_cannot_be_changed() -> None:
    evaluator = filled("a")
    with pytest.raises(TypeError):
        evaluator.counts["b"] = {}  # type: ignore[index]
    evaluator.counts["a"]["value"] = 2.0  # type: ignore[index]
    evaluator.add("n", {"value": 1.0, "lists": [[1], {"of": [2]}]})
    evaluator.counts["n"]["lists"][1]["of"].append(3)
    assert evaluator.counts["n"]["lists"] == [[1], {"of": [2]}]
    assert evaluator.compute(["a"]) == 1e16
    assert (list(evaluator.counts), len(evaluator.counts), "a" in evaluator.counts) == (
        ["a", "n"],
        2,
        True,
    )
    assert list(evaluator.pooled([{"value": 1.0}])) == [{"value": 1.0}]


def test_draws_take_whole_parts_so_often() -> None:
    evaluator, parts = filled("abcd"), [[{"value": 1.0}, {"value": 2.0}], [{"value": 10.0}]]
    times = np.array([[1, 1], [2, 0], [0, 3], [0, 0]])
    assert list(evaluator.resampled(parts, times)) == [13.0, 6.0, 30.0, 0.0]
    assert evaluator.has_intervals


def test_ratios_and_totals() -> None:
    assert (ratio(1, 4), ratio(0, 4), total([{"a": 1e16}, {"a": 1.0}, {"a": -1e16}], "a")) == (
        0.25,
        0.0,
        1.0,
    )
    assert math.isnan(ratio(0, 0))
