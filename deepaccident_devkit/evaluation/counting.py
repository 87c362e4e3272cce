"""`evaluate_samples`: updates an evaluator with many samples, on several processes, and can be interrupted."""

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
# Samples that a worker evaluates at once, and a killed run can lose.
_BATCH: Final = 8


def evaluate_samples(
    evaluator: EvaluatorT,
    samples: Mapping[str, Task],
    load: Callable[[Task], Sequence[Any]],
    *,
    checkpoint: str | os.PathLike[str] | None = None,
    places: Places | None = None,
    **how: Unpack[Engine],
) -> EvaluatorT:
    """Update an evaluator with many samples; the result is the same, to the bit, for any number of workers.

    If a sample cannot be evaluated, the others are counted before the error is raised.

    Args:
        evaluator: what counts; samples that it has already are passed over.
        samples: token → whatever `load` needs, such as a file's name; small, since it goes to the workers.
        load: gives what `evaluator.update` takes after the token: prediction, label and so on. With several workers a
            function of a module that they can import, or `functools.partial` of one (a dataset may be bound to it).
        checkpoint: a folder in which counts are kept, eight samples at a time: what was counted there with the same
            settings is not evaluated again, and several processes that are given it share the samples. It is for one
            set of predictions and labels; remove it when these change. None for none.
        places: what workers on other hosts must see.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says; if others cannot import `load`, this
            process works alone, unless a number of workers is asked for.

    Returns:
        The evaluator itself.

    Raises:
        EvaluationError: samples cannot be evaluated (the message begins with the token of the only one, or lists all),
            the checkpoint cannot be written, or workers cannot import `load`.
        WorkerError: a worker was killed.
        ChoiceError: `workers` is less than 1.
    """
    path = None if checkpoint is None else path_of(checkpoint)
    store = None if path is None else Store(path, path, "evaluates samples", EvaluationError)
    counted = evaluator.tokens
    left = [(token, task) for token, task in samples.items() if token not in counted]
    batches = [
        _Batch(evaluator.fresh(), tuple(left[first : first + _BATCH]), load, store)
        for first in range(0, len(left), _BATCH)
    ]
    workers = how.get("workers")
    if how.get("executor") is None and workers != 1 and batches:
        workers = _workers_that_can(batches[0], workers)
    run = {**how, "workers": workers, "label": f"samples, {_BATCH} at once", "places": places}
    failed: dict[str, EvaluationError] = {}
    for part, faults in _done(batches, store, run):
        evaluator.merge(part)
        for token, fault in faults.items():
            fault.__cause__ = None if failed else fault.__cause__  # it holds what was being loaded
            failed[token] = fault
    if failed:
        raise _fault_of_all([failed[token] for token in samples if token in failed], len(left))
    return evaluator


@dataclass(frozen=True, slots=True)
class _Batch(Generic[Task]):
    evaluator: Evaluator[Any]
    samples: tuple[tuple[str, Task], ...]
    load: Callable[[Task], Sequence[Any]]
    store: Store | None

    @property
    def name(self) -> str:
        return digest_of([token for token, _ in self.samples])

    @property
    def key(self) -> str:
        return f"{self.evaluator.maker} {self.evaluator.settings}"


# An evaluator with the counts of a batch, and why some of its samples have none.
_Counted: TypeAlias = tuple[Any, dict[str, EvaluationError]]


def _done(
    batches: Sequence[_Batch[Any]], store: Store | None, how: dict[str, Any]
) -> Sequence[_Counted]:
    """What each batch gives."""
    if store is None:
        return run_batch(_evaluated, batches, **how)
    with store.shared():
        return list(store.run(_evaluated, {batch.name: batch for batch in batches}, **how).values())


def _evaluated(batch: _Batch[Any]) -> _Counted:
    evaluator, store = batch.evaluator.fresh(), batch.store
    content = None if store is None else store.kept(batch.name, batch.key, "results")
    if content is not None:
        for token, counts in parsed_json(content, constants=True).items():
            evaluator.add(token, counts)
        return evaluator, {}
    faults: dict[str, EvaluationError] = {}
    for token, task in batch.samples:
        try:
            evaluator.update(token, *batch.load(task))
        except Exception as error:  # noqa: BLE001, PERF203 - whatever a caller's own function raises
            text = str(error).removeprefix(f"{token}: ")
            faults[token] = EvaluationError(
                f"{token}: cannot be evaluated: {type(error).__name__}: {text}"
            )
            faults[token].__cause__ = error
    if store is not None and not faults:
        store.keep(batch.name, batch.key, json.dumps(dict(evaluator.counts)).encode())
    return evaluator, faults


def _fault_of_all(failed: Sequence[EvaluationError], samples: int) -> EvaluationError:
    """The error of the only one that has failed, or of a list of all."""
    if len(failed) == 1:
        return failed[0]
    lines = [
        f"{len(failed)} of {samples} samples cannot be evaluated:",
        *(f"  {each}" for each in failed),
    ]
    fault = EvaluationError("\n".join(lines))
    fault.__cause__ = next((each.__cause__ for each in failed if each.__cause__ is not None), None)
    return fault


def _workers_that_can(batch: _Batch[Any], workers: int | None) -> int | None:
    """The number asked for if other processes can do a batch's work, which they import by name; if not, raises."""
    from multiprocessing.reduction import ForkingPickler

    try:
        sent = bytes(ForkingPickler.dumps((batch.evaluator, batch.load, batch.samples[0][1])))
        reason = (
            "it is, or needs, something of the script or notebook that runs"
            if b"__main__" in sent
            else None
        )
    except Exception as error:  # noqa: BLE001 - whatever an object's own way of being sent raises
        reason = str(error)
    if reason is None:
        return workers
    if workers is None:
        return 1
    raise EvaluationError(
        f"load: {workers} workers cannot import it ({reason}); put it into a module of its own, or choose workers=1"
    )
