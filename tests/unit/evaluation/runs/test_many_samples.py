"""Whole runs: on workers and executors, broken off and gone on with, and what can go wrong."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from evaluating import BROKEN, Sums, number
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import evaluate_samples

VALUES = {f"{index:02d}": float(10 ** (index % 17)) + index / 10 for index in range(40)}


@pytest.mark.parametrize("load", [lambda task: (task,), partial(lambda task: (task,))])
def test_a_function_that_workers_cannot_import(load: Callable[[float], tuple[float]]) -> None:
    assert_refused(
        (
            lambda: evaluate_samples(Sums(), VALUES, load, workers=2),
            EvaluationError,
            r"load: 2 workers cannot import it .*a module of its own, or .*=1",
        ),
    )
    assert evaluate_samples(Sums(), VALUES, load).compute() == sum_of_all()


def test_what_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    broken = {**VALUES, "x": BROKEN}

    def evaluate(*arguments: Any, **how: Any) -> None:
        evaluate_samples(Sums(), *arguments, **how)

    assert_refused(
        (partial(evaluate, VALUES, number, workers=0), ChoiceError, "at least 1"),
        *[
            (
                partial(evaluate, broken, number, workers=workers),
                EvaluationError,
                r"^x: .*Error: predictions/7\.npz$",
            )
            for workers in (1, 2)
        ],
        (
            lambda: evaluate({"00": 1.0}, lambda task: [task] * 3, workers=1),
            EvaluationError,
            "^00: .*: TypeError: ",
        ),
        (
            partial(evaluate, broken, number, workers=1, checkpoint=tmp_path / "file" / "counts"),
            EvaluationError,
            "file/counts: cannot be written",
        ),
    )


@pytest.mark.parametrize("threads", [0, 3])
def test_several_are_all_listed_in_order_and_the_others_are_counted(threads: int) -> None:
    evaluator, broken = Sums(), {"30": BROKEN, "02": BROKEN, "x": BROKEN}
    executor = ThreadPoolExecutor(threads) if threads else None
    with (
        executor or nullcontext(),
        pytest.raises(EvaluationError, match=r"^3 of 41 samples cannot") as caught,
    ):
        evaluate_samples(evaluator, VALUES | broken, number, workers=1, executor=executor)
    lines = str(caught.value).splitlines()[1:]
    fault = "cannot be evaluated: FileNotFoundError: predictions/7.npz"
    assert lines == [f"  {token}: {fault}" for token in ("02", "30", "x")]
    assert isinstance(caught.value.__cause__, FileNotFoundError)
    assert evaluator.tokens == VALUES.keys() - broken.keys()


def test_of_other_settings_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "counts"
    evaluate_samples(Sums(scale=2.0), {**VALUES, "00": 1000.0}, number, workers=1, checkpoint=path)
    evaluator = evaluate_samples(Sums(), VALUES, number, workers=1, checkpoint=path)
    assert evaluator.compute() == sum_of_all()
    assert not evaluate_samples(evaluator, VALUES, number, workers=1, checkpoint=path).repeated
    for kept in path.glob("kept/*"):
        kept.write_bytes(kept.read_bytes()[1:])
    assert (
        evaluate_samples(Sums(), VALUES, number, workers=1, checkpoint=path).compute()
        == sum_of_all()
    )


def sum_of_all() -> float:
    evaluator = Sums()
    for token, value in VALUES.items():
        evaluator.update(token, value)
    return evaluator.compute()
