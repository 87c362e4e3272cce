"""Evaluating many samples: on several processes, and going on where a broken-off run stopped."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.files import path_of
from deepaccident_devkit.parallel import Places, run_unordered

if TYPE_CHECKING:
    from concurrent.futures import Executor

Task = TypeVar("Task")
EvaluatorT = TypeVar("EvaluatorT", bound=Evaluator[Any])
_BATCH: Final = 8
"""Samples that a worker evaluates before it reports."""
_SAVE_SECONDS: Final = 30.0
"""Seconds from one save to the next, which a killed run can lose."""


def evaluate_samples(
    evaluator: EvaluatorT,
    samples: Mapping[str, Task],
    load: Callable[[Task], Sequence[Any]],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = False,
    places: Places | None = None,
) -> EvaluatorT:
    """Update an evaluator with many samples; the result is the same, to the bit, for any number of workers.

    If a sample cannot be evaluated, the others are counted and saved before the error is raised.

    Args:
        evaluator: what counts; samples that it has already are passed over.
        samples: token → whatever `load` needs, such as a file's name; small, since it goes to the workers.
        load: gives what `evaluator.update` takes after the token: prediction, label and so on. With several workers a
            function of a module that they can import, or `functools.partial` of one (a dataset may be bound to it).
        workers: processes; None takes what the work is worth, and this one alone if others cannot import `load`.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        checkpoint: a file that the counts are saved to every half minute and at the end, also of a run that breaks
            off; if it is there, its samples are not evaluated again. None for none.
        progress: whether to show a bar.
        places: what workers on other hosts must see.

    Returns:
        The evaluator itself.

    Raises:
        EvaluationError: samples cannot be evaluated (the message begins with the token of the only one, or lists all),
            the checkpoint is of other settings or samples or cannot be read or written, or workers cannot import
            `load`.
        WorkerError: a worker was killed.
        ChoiceError: `workers` is less than 1.
    """
    saved = None if checkpoint is None else path_of(checkpoint)
    if saved is not None:
        if saved.exists():
            _resume(evaluator, saved, samples)
        evaluator.save(saved)  # shows at once, and not after an hour, whether it can be written
    counted = evaluator.tokens
    left = [(token, task) for token, task in samples.items() if token not in counted]
    batches = [
        _Batch(evaluator.fresh(), tuple(left[first : first + _BATCH]), load) for first in range(0, len(left), _BATCH)
    ]
    if executor is None and workers != 1 and batches:
        workers = _workers_that_can(batches[0], workers)
    done = run_unordered(
        _evaluated,
        batches,
        workers=workers,
        executor=executor,
        label="samples",
        progress=progress,
        sizes=[len(batch.samples) for batch in batches],
        places=places,
    )
    failed: dict[str, EvaluationError] = {}
    with _saved_now_and_then(evaluator, saved) as save, closing(done):
        for _, (part, faults) in done:
            evaluator.merge(part)
            for token, fault in faults.items():
                fault.__cause__ = None if failed else fault.__cause__  # it holds what was being loaded
                failed[token] = fault
            save()
    _check_failed([failed[token] for token in samples if token in failed], len(left))
    return evaluator


@dataclass(frozen=True, slots=True)
class _Batch(Generic[Task]):
    evaluator: Evaluator[Any]
    samples: tuple[tuple[str, Task], ...]
    load: Callable[[Task], Sequence[Any]]


def _evaluated(batch: _Batch[Any]) -> tuple[Any, dict[str, EvaluationError]]:
    """The counts of a batch, and why some of its samples have none."""
    evaluator = batch.evaluator.fresh()
    faults = {token: _fault(evaluator, token, batch.load, task) for token, task in batch.samples}
    return evaluator, {token: fault for token, fault in faults.items() if fault is not None}


def _fault(
    evaluator: Evaluator[Any], token: str, load: Callable[[Any], Sequence[Any]], task: Any
) -> EvaluationError | None:
    """Count a sample; the error if it cannot be, with its cause."""
    try:
        evaluator.update(token, *load(task))
    except Exception as error:  # noqa: BLE001 - whatever a caller's own function raises
        text = str(error).removeprefix(f"{token}: ")
        fault = EvaluationError(f"{token}: cannot be evaluated: {type(error).__name__}: {text}")
        fault.__cause__ = error
        return fault
    return None


def _check_failed(failed: Sequence[EvaluationError], samples: int) -> None:
    """Raise EvaluationError if samples have failed: that of the only one, or a list of all."""
    if len(failed) == 1:
        raise failed[0]
    if failed:
        cause = next((each.__cause__ for each in failed if each.__cause__ is not None), None)
        lines = [f"{len(failed)} of {samples} samples cannot be evaluated:", *(f"  {each}" for each in failed)]
        raise EvaluationError("\n".join(lines)) from cause


def take_stored(evaluator: Evaluator[Any], stored: Evaluator[Any]) -> None:
    """Take stored counts, some of which it may have already; that alone does not make a sample a repeated one.

    Raises:
        EvaluationError: it has other counts of a sample.
    """
    repeated = evaluator.repeated | stored.repeated
    evaluator.merge(stored)
    evaluator.repeated = repeated


def _resume(evaluator: Evaluator[Any], path: Path, samples: Mapping[str, Any]) -> None:
    """Take what a checkpoint has of the samples."""
    stored = evaluator.fresh().resume(path)
    others = sorted(stored.tokens - samples.keys() - evaluator.tokens)
    if others:
        raise EvaluationError(
            f"{path}: has {len(others)} samples that are not among these, such as {others[0]}; give each evaluation a "
            "checkpoint of its own"
        )
    take_stored(evaluator, stored)


def _workers_that_can(batch: _Batch[Any], workers: int | None) -> int | None:
    """The number asked for if other processes can do a batch's work, which they import by name; if not, raises."""
    from multiprocessing.reduction import ForkingPickler

    try:
        sent = bytes(ForkingPickler.dumps((batch.evaluator, batch.load, batch.samples[0][1])))
        reason = "it is, or needs, something of the script or notebook that runs" if b"__main__" in sent else None
    except Exception as error:  # noqa: BLE001 - whatever an object's own way of being sent raises
        reason = str(error)
    if reason is None:
        return workers
    if workers is None:
        return 1
    raise EvaluationError(
        f"load: {workers} workers cannot import it ({reason}); put it into a module of its own, or choose workers=1"
    )


@contextmanager
def _saved_now_and_then(evaluator: Evaluator[Any], path: Path | None) -> Iterator[Callable[[], None]]:
    """Give a function that saves if the last time is long ago; save at the end, also after an error."""
    if path is None:
        yield lambda: None
        return
    last = time.monotonic()

    def save() -> None:
        nonlocal last
        if time.monotonic() - last >= _SAVE_SECONDS:
            evaluator.save(path)
            last = time.monotonic()

    try:
        yield save
    finally:
        evaluator.save(path)
