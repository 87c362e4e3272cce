"""What all evaluators share: counts by token that can be added, merged, stored and summed in any order."""

import json
import math
import os
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from evaluating import Sums
from refusals import assert_refused

from deepaccident_devkit.errors import MOST_SAID, EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, ratio

VALUES = {"a": 1e16, "b": 1.0, "c": -1e16, "d": 0.1}


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
    assert evaluator.compute(["b", "d"]) == 1.1
    assert evaluator.compute([]) == 0.0
    with pytest.raises(EvaluationError, match="7 samples have no prediction, such as t"):
        evaluator.compute(["a", *"zyxwvut"])


@pytest.mark.parametrize("tokens", ["ab", 3, ["a", 1], [b"a"], [["a"]]])
def test_what_are_no_tokens(tokens: Any) -> None:
    with pytest.raises(EvaluationError, match=r"tokens: expected (several of them|texts), found"):
        filled("ab").compute(tokens)


@pytest.mark.parametrize("token", [3, None, b"a"])
def test_what_is_no_token(token: Any) -> None:
    with pytest.raises(EvaluationError, match="token: expected the sample's token, a text, found"):
        Sums().add(token, {"value": 1.0})


def test_a_fresh_one_has_the_settings_alone() -> None:
    one = filled("abc").merge(filled("b"))
    fresh = one.fresh()
    fresh.merge(filled("a")).merge(filled("a"))
    assert (fresh.settings, fresh.tokens, fresh.repeated) == (one.settings, {"a"}, {"a"})
    assert (one.tokens, one.repeated) == ({"a", "b", "c"}, {"b"})


def test_a_broken_off_run_goes_on(tmp_path: Path) -> None:
    path = filled("abc").merge(filled("b")).save(tmp_path / "state.json")
    resumed = Sums().resume(path)
    assert resumed.repeated == {"b"}
    assert resumed.merge(filled("d")).compute() == 1.1
    again = filled("ab").resume(path)
    assert again.compute() == 1.0
    assert again.repeated == {"a", "b"}


def test_any_order_of_samples_and_parts_is_saved_as_the_same_bytes(tmp_path: Path) -> None:
    one = filled("abc").save(tmp_path / "one.json")
    other = filled("c").merge(filled("a")).merge(filled("b")).save(tmp_path / "other.json")
    assert one.read_bytes() == other.read_bytes()


def test_a_run_of_other_settings_does_not_go_on(tmp_path: Path) -> None:
    path = filled("a").save(tmp_path / "state.json")
    with pytest.raises(EvaluationError, match="was saved with other settings"):
        Sums(scale=2.0).resume(path)


def test_a_run_of_another_evaluator_or_version_does_not_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Others(Sums):
        """Same settings, other counts."""

    path = filled("a").save(tmp_path / "state.json")
    with pytest.raises(EvaluationError, match=r"was saved by Sums of devkit .*, this is Others of .*; begin again"):
        Others().resume(path)
    monkeypatch.setattr("deepaccident_devkit.evaluation.evaluator.__version__", "99")
    with pytest.raises(EvaluationError, match=r"was saved by .*, this is Sums of devkit 99"):
        Sums().resume(path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        json.dumps({"made_by": "", "settings": {}, "counts": 3, "repeated": []}),
        json.dumps({"made_by": "", "settings": {}, "counts": {"a": 3}, "repeated": []}),
    ],
)
def test_a_damaged_state_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(EvaluationError, match=r"state\.json: no saved evaluation .*begin again"):
        Sums().resume(path)
    path.write_bytes(filled("abcd").save(path).read_bytes()[:-9])
    assert_refused(
        (lambda: Sums().resume(path), EvaluationError, "no saved evaluation"),
        (lambda: Sums().resume(tmp_path / "nowhere"), EvaluationError, "nowhere"),
    )


def test_a_hostile_state_is_refused_in_few_words(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    long = "x" * 10**6
    for state in (
        "[" * 10**6,
        json.dumps({"made_by": long, "settings": {}, "counts": {}, "repeated": []}),
        json.dumps({"made_by": filled("a").maker, "settings": {long: 1}, "counts": {}, "repeated": []}),
    ):
        path.write_text(state)
        with pytest.raises(EvaluationError, match="begin again") as raised:
            Sums().resume(path)
        assert len(str(raised.value)) <= MOST_SAID
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(EvaluationError, match="a named pipe"):
        Sums().resume(path)


def test_a_place_that_cannot_be_written_is_our_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(EvaluationError, match=r"cannot be saved .*choose another file"):
        filled("a").save(tmp_path / "file" / "state.json")


def test_samples_that_a_distributed_sampler_repeats() -> None:
    """Each process gets as many samples: some twice, in one process or in two."""
    first, second = filled("ab").merge(filled("a")), filled("cb")
    assert first.repeated == {"a"}
    merged = first.merge(second)
    assert (merged.repeated, len(merged)) == ({"a", "b"}, 3)
    with pytest.raises(EvaluationError, match="a: evaluated twice, with different results"):
        merged.update("a", 3.0)


def test_a_fresh_one_is_of_the_same_settings() -> None:
    evaluator = filled("ab", scale=3.0)
    fresh: Evaluator[float] = evaluator.fresh()
    assert (len(fresh), len(evaluator), fresh.settings) == (0, 2, evaluator.settings)


def test_counts_cannot_be_changed() -> None:
    evaluator = filled("a")
    with pytest.raises(TypeError):
        evaluator.counts["b"] = {}  # type: ignore[index]
    evaluator.counts["a"]["value"] = 2.0  # type: ignore[index]
    assert evaluator.compute() == 1e16
    assert list(evaluator.pooled([{"value": 1.0}])) == [{"value": 1.0}]


def test_a_ratio_of_nothing_is_nan() -> None:
    assert ratio(1, 4) == 0.25
    assert math.isnan(ratio(0, 0))
