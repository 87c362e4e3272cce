"""Evaluations of many samples: on workers and executors, interrupted and resumed, and what can go
wrong.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.spawned_evaluation import BROKEN_NUMBER, SumEvaluator, load_number

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import evaluate_samples

VALUES = {f"{index:02d}": float(10 ** (index % 17)) + index / 10 for index in range(40)}


@pytest.mark.parametrize("load", [lambda task: (task,), partial(lambda task: (task,))])
def test_a_loader_that_workers_cannot_import(load: Callable[[float], tuple[float]]) -> None:
    assert_raises(
        (
            lambda: evaluate_samples(SumEvaluator(), VALUES, load, workers=2),
            EvaluationError,
            r"load: 2 workers cannot import it .*a module of its own, or .*=1",
        ),
    )
    assert evaluate_samples(SumEvaluator(), VALUES, load).compute() == sum_of_all()


def test_errors_name_the_sample_or_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    broken = {**VALUES, "x": BROKEN_NUMBER}
    checkpoint = tmp_path / "file" / "counts"

    def evaluate(*arguments: Any, **options: Any) -> None:
        evaluate_samples(SumEvaluator(), *arguments, **options)

    broken_sample = r"^x: .*Error: predictions/7\.npz$"
    assert_raises(
        (partial(evaluate, VALUES, load_number, workers=0), ChoiceError, "at least 1"),
        (partial(evaluate, broken, load_number, workers=1), EvaluationError, broken_sample),
        (partial(evaluate, broken, load_number, workers=2), EvaluationError, broken_sample),
        (
            partial(evaluate, {"00": 1.0}, lambda task: [task] * 3, workers=1),
            EvaluationError,
            "^00: .*: TypeError: ",
        ),
        (
            partial(evaluate, broken, load_number, workers=1, checkpoint=checkpoint),
            EvaluationError,
            "file/counts: cannot be written",
        ),
    )


@pytest.mark.parametrize("threads", [0, 3])
def test_errors_are_listed_in_order_and_other_samples_are_counted(threads: int) -> None:
    evaluator = SumEvaluator()
    broken = {"30": BROKEN_NUMBER, "02": BROKEN_NUMBER, "x": BROKEN_NUMBER}
    executor = ThreadPoolExecutor(threads) if threads else None
    with (
        executor or nullcontext(),
        pytest.raises(EvaluationError, match=r"^3 of 41 samples cannot") as caught,
    ):
        evaluate_samples(evaluator, VALUES | broken, load_number, workers=1, executor=executor)

    reason = "cannot be evaluated: FileNotFoundError: predictions/7.npz"
    assert str(caught.value).splitlines()[1:] == [
        f"  02: {reason}",
        f"  30: {reason}",
        f"  x: {reason}",
    ]
    assert isinstance(caught.value.__cause__, FileNotFoundError)
    assert evaluator.tokens == VALUES.keys() - broken.keys()


def test_checkpoints_of_other_settings_or_damaged_ones_are_not_used(tmp_path: Path) -> None:
    path = tmp_path / "counts"
    evaluate = partial(evaluate_samples, load=load_number, workers=1, checkpoint=path)
    evaluate(SumEvaluator(scale=2.0), {**VALUES, "00": 1000.0})
    evaluator = evaluate(SumEvaluator(), VALUES)
    assert evaluator.compute() == sum_of_all()
    assert not evaluate(evaluator, VALUES).repeated

    for file in path.glob("kept/*"):
        file.write_bytes(file.read_bytes()[1:])

    assert evaluate(SumEvaluator(), VALUES).compute() == sum_of_all()


def sum_of_all() -> float:
    evaluator = SumEvaluator()
    for token, value in VALUES.items():
        evaluator.update(token, value)
    return evaluator.compute()
