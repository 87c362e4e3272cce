"""`evaluate_samples`: updates an evaluator with many samples, in parallel, and can be resumed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, EvaluatorT
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.parallel import Places, Store, run_batch
from deepaccident_devkit.support.text import path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

Task = TypeVar("Task")
# Number of samples that a worker evaluates at once, and that a killed run can lose.
_BATCH_SIZE: Final = 8


def evaluate_samples(
    evaluator: EvaluatorT,
    samples: Mapping[str, Task],
    load: Callable[[Task], Sequence[Any]],
    *,
    checkpoint: str | os.PathLike[str] | None = None,
    places: Places | None = None,
    **engine: Unpack[Engine],
) -> EvaluatorT:
    """Update an evaluator with many samples; the result has the same bits for any workers.

    If a sample cannot be evaluated, the others are counted before the error is raised.

    Args:
        evaluator: Evaluator that counts; samples that it already has are skipped.
        samples: Token → what `load` needs, such as a file's name; small, since it is sent to the
            workers.
        load: Function that returns the arguments of `evaluator.update` after the token:
            prediction, label and so on. With several workers it is a function of a module that they
            can import, or `functools.partial` of one (a dataset may be bound to it).
        checkpoint: Folder in which counts are stored, eight samples at a time: samples that were
            counted there with the same settings are not evaluated again, and several processes with
            the same folder share the samples. It is for one set of predictions and labels; remove
            it when these change. None for no checkpoint.
        places: Paths that workers on other hosts must see.
        **engine: `workers`, `executor` and `progress`, as in `parallel.Engine`; if others cannot
            import `load`, this process works without workers, unless a number of them is passed.

    Returns:
        The evaluator itself.

    Raises:
        EvaluationError: samples cannot be evaluated (the message begins with the token of the only
            one, or lists all), the checkpoint cannot be written, or workers cannot import `load`.
        WorkerError: a worker was killed.
        ChoiceError: `workers` is less than 1.
    """
    path = None if checkpoint is None else path_of(checkpoint)
    store = None if path is None else Store(path, path, "evaluates samples", EvaluationError)
    counted = evaluator.tokens
    uncounted = [(token, task) for token, task in samples.items() if token not in counted]
    batches = []
    for start in range(0, len(uncounted), _BATCH_SIZE):
        batch_samples = tuple(uncounted[start : start + _BATCH_SIZE])
        batches.append(_Batch(evaluator.fresh(), batch_samples, load, store))
    workers = engine.get("workers")
    if engine.get("executor") is None and workers != 1 and batches:
        workers = _workers_that_can(batches[0], workers)
    label = f"samples, {_BATCH_SIZE} at once"
    run_engine = {**engine, "workers": workers, "label": label, "places": places}
    errors: dict[str, EvaluationError] = {}
    for part, batch_errors in _run(batches, store, run_engine):
        evaluator.merge(part)
        for token, error in batch_errors.items():
            # only the first cause is needed: each holds what was being loaded
            error.__cause__ = None if errors else error.__cause__
            errors[token] = error
    if errors:
        ordered_errors = [errors[token] for token in samples if token in errors]
        raise _joint_error(ordered_errors, len(uncounted))
    return evaluator


@dataclass(frozen=True, slots=True)
class _Batch(Generic[Task]):
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
        """Evaluator and settings that the counts of a checkpoint must come from."""
        return f"{self.evaluator.maker} {self.evaluator.settings}"


# An evaluator with the counts of a batch, and the errors of samples without counts, by token.
_Counted: TypeAlias = tuple[Any, dict[str, EvaluationError]]


def _run(
    batches: Sequence[_Batch[Any]], store: Store | None, engine: dict[str, Any]
) -> Sequence[_Counted]:
    """Return the counts and errors of each batch."""
    if store is None:
        return run_batch(_evaluated, batches, **engine)
    batches_by_name = {batch.name: batch for batch in batches}
    with store.shared():
        return list(store.run(_evaluated, batches_by_name, **engine).values())


def _evaluated(batch: _Batch[Any]) -> _Counted:
    """Return the counts and errors of a batch, from the checkpoint if it has them."""
    evaluator = batch.evaluator.fresh()
    store = batch.store
    content = None if store is None else store.kept(batch.name, batch.key, "results")
    if content is not None:
        for token, counts in parsed_json(content, constants=True).items():
            evaluator.add(token, counts)
        return evaluator, {}
    errors: dict[str, EvaluationError] = {}
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
        store.keep(batch.name, batch.key, json.dumps(dict(evaluator.counts)).encode())
    return evaluator, errors


def _joint_error(errors: Sequence[EvaluationError], sample_count: int) -> EvaluationError:
    """Return the only error, or one that lists all."""
    if len(errors) == 1:
        return errors[0]
    lines = [f"{len(errors)} of {sample_count} samples cannot be evaluated:"]
    lines += [f"  {error}" for error in errors]
    joint = EvaluationError("\n".join(lines))
    causes = (error.__cause__ for error in errors if error.__cause__ is not None)
    joint.__cause__ = next(causes, None)
    return joint


def _workers_that_can(batch: _Batch[Any], workers: int | None) -> int | None:
    """Return a number of workers if other processes can import a batch's work by name.

    Otherwise returns 1 where no number was passed, and raises EvaluationError where one was.
    """
    from multiprocessing.reduction import ForkingPickler

    reason = None
    try:
        payload = bytes(ForkingPickler.dumps((batch.evaluator, batch.load, batch.samples[0][1])))
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
