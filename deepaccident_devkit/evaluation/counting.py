"""`evaluate_samples` updates an evaluator with many samples in parallel, and can be resumed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, EvaluatorT
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.parallel import Places, Store, run_batch
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.support.values import NamedValues

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

Task = TypeVar("Task")
# A worker evaluates this many samples at once; a killed run loses at most as many per worker.
_BATCH_SIZE = 8


def evaluate_samples(
    evaluator: EvaluatorT,
    samples: Mapping[str, Task],
    load: Callable[[Task], Sequence[Any]],
    *,
    checkpoint: PathType | None = None,
    places: Places | None = None,
    **engine: Unpack[Engine],
) -> EvaluatorT:
    """Update an evaluator with many samples; results do not depend on the number of workers.

    If a sample cannot be evaluated, all other samples are counted before the error is raised.

    Args:
        evaluator: Evaluator to update; samples that it has already counted are skipped.
        samples: Token → argument of `load`, such as a file name. The argument should be small,
            since it is sent to the workers.
        load: Function that returns the arguments of `evaluator.update` after the token:
            prediction, label and so on. With several workers, it must be a function in a module
            that they can import, or a `functools.partial` of one (to which a dataset may be bound).
        checkpoint: Folder in which counts are stored, eight samples at a time. Samples that were
            counted there with the same settings are not evaluated again, and several processes with
            the same folder share the samples. A folder is only valid for one set of predictions and
            labels; remove it when these change. None for no checkpoint.
        places: Paths that workers on other hosts must be able to see.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`. If other processes
            cannot import `load`, this process does all the work, unless a number of workers is
            passed.

    Returns:
        The same evaluator.

    Raises:
        EvaluationError: If samples cannot be evaluated (the message begins with the token if there
            is only one, and otherwise lists all of them), the checkpoint cannot be written, or
            workers cannot import `load`.
        WorkerError: If a worker was killed.
        ChoiceError: If `workers` is less than 1.
    """
    store = None
    if checkpoint is not None:
        path = path_of(checkpoint)
        store = Store(path, path, "is evaluating samples", EvaluationError)
    counted_tokens = evaluator.tokens
    uncounted = [(token, task) for token, task in samples.items() if token not in counted_tokens]
    batches = []
    for start in range(0, len(uncounted), _BATCH_SIZE):
        batch_samples = tuple(uncounted[start : start + _BATCH_SIZE])
        batches.append(_Batch(evaluator.fresh(), batch_samples, load, store))
    workers = engine.get("workers")
    if engine.get("executor") is None and workers != 1 and batches:
        workers = _check_workers(batches[0], workers)
    label = f"Evaluating, {_BATCH_SIZE} samples per step"
    run_engine = {**engine, "workers": workers, "label": label, "places": places}
    errors: dict[str, EvaluationError] = {}
    for batch_evaluator, batch_errors in _count_batches(batches, store, run_engine):
        evaluator.merge(batch_evaluator)
        for token, error in batch_errors.items():
            if errors:  # one cause is enough; each keeps a loaded sample in memory
                error.__cause__ = None
            errors[token] = error
    if errors:
        ordered_errors = [errors[token] for token in samples if token in errors]
        raise _merge_errors(ordered_errors, len(uncounted))
    return evaluator


@dataclass(frozen=True, slots=True)
class _Batch(Generic[Task]):
    """Samples that a worker counts at once, with the evaluator, the loader and the checkpoint."""

    evaluator: Evaluator[Any]
    samples: tuple[tuple[str, Task], ...]
    load: Callable[[Task], Sequence[Any]]
    store: Store | None

    @property
    def name(self) -> str:
        """Name of the batch in a checkpoint, from the tokens of its samples."""
        return digest_of([token for token, _ in self.samples])

    @property
    def key(self) -> str:
        """Evaluator class and settings with which the counts in a checkpoint were computed."""
        return f"{self.evaluator.maker} {self.evaluator.settings}"


# An evaluator with the counts of a batch, and the errors of samples without counts, by token.
_Counted: TypeAlias = tuple[Any, dict[str, EvaluationError]]


def _count_batches(
    batches: Sequence[_Batch[Any]], store: Store | None, engine: NamedValues
) -> Sequence[_Counted]:
    """Count each batch; return its counts and errors."""
    if store is None:
        return run_batch(_count_batch, batches, **engine)
    batches_by_name = {batch.name: batch for batch in batches}
    with store.shared():
        counted_batches = store.run(_count_batch, batches_by_name, **engine)
    return list(counted_batches.values())


def _count_batch(batch: _Batch[Any]) -> _Counted:
    """Count a batch, or read its counts and errors from the checkpoint if they are there."""
    evaluator = batch.evaluator.fresh()
    store = batch.store
    content = None
    if store is not None:
        content = store.read_result(batch.name, batch.key, "results")
    if content is not None:
        for token, counts in parsed_json(content, constants=True).items():
            evaluator.add(token, counts)
        return evaluator, {}
    errors = {}
    for token, task in batch.samples:
        try:
            evaluator.update(token, *batch.load(task))
        except Exception as error:  # noqa: BLE001, PERF203 - whatever a caller's own function raises
            text = str(error).removeprefix(f"{token}: ")
            errors[token] = EvaluationError(
                f"{token}: cannot be evaluated: {type(error).__name__}: {text}"
            )
            errors[token].__cause__ = error
    if store is not None and not errors:
        store.write_result(batch.name, batch.key, json.dumps(dict(evaluator.counts)).encode())
    return evaluator, errors


def _merge_errors(errors: Sequence[EvaluationError], sample_count: int) -> EvaluationError:
    """Return the error if there is only one; otherwise build one that lists all of them."""
    if len(errors) == 1:
        return errors[0]
    lines = [f"{len(errors)} of {sample_count} samples cannot be evaluated:"]
    lines += [f"  {error}" for error in errors]
    joint = EvaluationError("\n".join(lines))
    causes = (error.__cause__ for error in errors if error.__cause__ is not None)
    joint.__cause__ = next(causes, None)
    return joint


def _check_workers(batch: _Batch[Any], workers: int | None) -> int | None:
    """Return the number of workers to use.

    If other processes cannot import what a batch needs, return 1 if no number was requested, and
    raise EvaluationError if one was.
    """
    from multiprocessing.reduction import ForkingPickler

    reason = None
    try:
        _, first_task = batch.samples[0]
        pickled_work = ForkingPickler.dumps((batch.evaluator, batch.load, first_task))
        payload = bytes(pickled_work)
    except Exception as error:  # noqa: BLE001 - whatever an object's own way of being sent raises
        reason = str(error)
    else:
        if b"__main__" in payload:
            reason = "it is, or needs, something of the script or notebook that runs"
    if reason is None:
        return workers
    if workers is None:
        return 1
    raise EvaluationError(
        f"load: {workers} workers cannot import it ({reason}); put it into a module of its own, or "
        "choose workers=1"
    )
