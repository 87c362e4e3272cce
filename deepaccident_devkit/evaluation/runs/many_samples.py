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
from deepaccident_devkit.parallel import run_unordered

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
) -> EvaluatorT:
    """Update an evaluator with many samples; the result is the same, to the bit, for any number of workers.

    Args:
        evaluator: what counts; samples that it has already are passed over.
        samples: token → whatever `load` needs, such as a file's name; small, since it goes to the workers.
        load: gives what `evaluator.update` takes after the token: prediction, label and so on. With several workers a
            function of a module that they can import, or `functools.partial` of one (a dataset may be bound to it).
        workers: processes; None takes what the work is worth, and this one alone if others cannot import `load`.
        executor: to run on instead, any of `concurrent.futures`.
        checkpoint: a file that the counts are saved to every half minute and at the end, also of a run that breaks
            off; if it is there, its samples are not evaluated again. None for none.
        progress: whether to show a bar.

    Returns:
        The evaluator itself.

    Raises:
        EvaluationError: a sample cannot be evaluated (the message begins with its token), the checkpoint is of other
            settings or samples or cannot be read or written, or workers cannot import `load`.
        WorkerError: a worker was killed.
        ChoiceError: `workers` is less than 1.
    """
    saved = None if checkpoint is None else Path(checkpoint).expanduser()
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
    )
    with _saved_now_and_then(evaluator, saved) as save, closing(done):
        for _, part in done:
            evaluator.merge(part)
            save()
    return evaluator


@dataclass(frozen=True, slots=True)
class _Batch(Generic[Task]):
    evaluator: Evaluator[Any]
    samples: tuple[tuple[str, Task], ...]
    load: Callable[[Task], Sequence[Any]]


def _evaluated(batch: _Batch[Any]) -> Any:
    evaluator = batch.evaluator.fresh()
    for token, task in batch.samples:
        _evaluate(evaluator, token, batch.load, task)
    return evaluator


def _evaluate(evaluator: Evaluator[Any], token: str, load: Callable[[Any], Sequence[Any]], task: Any) -> None:
    try:
        evaluator.update(token, *load(task))
    except Exception as error:
        text = str(error).removeprefix(f"{token}: ")
        raise EvaluationError(f"{token}: cannot be evaluated: {type(error).__name__}: {text}") from error


def _resume(evaluator: Evaluator[Any], path: Path, samples: Mapping[str, Any]) -> None:
    """Take what a checkpoint has of the samples."""
    stored = evaluator.fresh().resume(path)
    others = sorted(stored.tokens - samples.keys() - evaluator.tokens)
    if others:
        raise EvaluationError(
            f"{path}: has {len(others)} samples that are not among these, such as {others[0]}; give each evaluation a "
            "checkpoint of its own"
        )
    evaluator.merge(stored)


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
