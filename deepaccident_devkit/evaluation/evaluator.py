"""`Evaluator`: the base of all evaluators, which keep small counts by sample and sum them when asked.

So results do not depend on the order of samples or on how many workers counted them, memory grows with the counts
alone, and any selection of the samples can be summed (see `breakdown`). `evaluate_samples` updates one with many
samples, on several processes, and goes on where a broken-off run stopped.
"""

from __future__ import annotations

import copy
import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.parallel import Places, Store, run_batch
from deepaccident_devkit.release.fingerprints import digest_of
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import path_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

Counts = Mapping[str, Any]
"""What one sample adds: names → whole numbers, floats, None, or nested lists of them; as JSON holds it."""
Result = TypeVar("Result")
EvaluatorT = TypeVar("EvaluatorT", bound="Evaluator[Any]")


class Evaluator(ABC, Generic[Result]):
    """Counts by sample token; see the subclasses for what is counted.

    Attributes:
        repeated: tokens that came more than once with equal counts (samplers of distributed training do that); each
            counts once.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self._counts: dict[str, Counts] = {}
        self.repeated: set[str] = set()

    def __repr__(self) -> str:
        """Its kind, and how many samples it has counted."""
        return f"{type(self).__name__}({len(self._counts):,} sample{'s' * (len(self._counts) != 1)})"

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All choices that affect the numbers, as JSON can hold them: evaluators of other settings cannot be merged."""

    @abstractmethod
    def result_of(self, counts: Collection[Counts]) -> Result:
        """The metrics of some samples' counts, in any order."""

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Fewer counts with the same result, for many results of these samples.

        A subclass whose counts are sums adds them up; others keep them apart, as here.
        """
        return list(counts)

    @property
    def has_intervals(self) -> bool:
        """Whether its numbers can be computed many times; if not, they have no intervals and no tests."""
        return True

    def resampled(self, parts: Sequence[Sequence[Counts]], times: IntArray) -> Iterator[Result]:
        """The result of each of D draws, as of samples some of which come several times, and others not at all.

        Args:
            parts: the counts of P groups of samples, each of which is drawn as a whole.
            times: (D, P) how often each is taken.
        """
        pooled = [self.pooled(part) for part in parts]
        for draw in times.tolist():
            taken = zip(pooled, draw, strict=True)
            yield self.result_of([each for part, often in taken for _ in range(often) for each in part])

    def drawn_numbers(
        self,
        parts: Sequence[Sequence[Counts]],  # noqa: ARG002 - subclasses use them
        times: IntArray,  # noqa: ARG002
        names: Sequence[str],  # noqa: ARG002
    ) -> FloatArray | None:
        """(D, M) the numbers of these M paths in each draw of `resampled`, NaN for none, without its results.

        None where a subclass has no faster way to them.
        """
        return None

    @abstractmethod
    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample: its token, then prediction, truth and other arguments of the evaluator."""

    def fresh(self: EvaluatorT) -> EvaluatorT:
        """An evaluator of the same settings without samples."""
        other = copy.copy(self)
        other._counts, other.repeated = {}, set()  # noqa: SLF001 - its own kind
        return other

    def add(self, token: str, counts: Counts) -> None:
        """Take a sample's counts.

        Raises:
            EvaluationError: the token is no text, or the sample came before, with other counts.
        """
        if not isinstance(token, str):
            raise EvaluationError(f"token: expected the sample's token, a text, found {token!r}")
        if token not in self._counts:
            self._counts[token] = counts
        elif self._counts[token] == counts:
            self.repeated.add(token)
        else:
            raise EvaluationError(f"{token}: evaluated twice, with different results; give each sample one prediction")

    def merge(self: EvaluatorT, other: EvaluatorT) -> EvaluatorT:
        """Take all samples of another evaluator; returns this one.

        Raises:
            EvaluationError: it has other settings, or other counts of the same sample.
        """
        if type(other) is not type(self) or other.settings != self.settings:
            raise EvaluationError(
                f"cannot merge: {type(self).__name__} of {self.settings} with {type(other).__name__} of "
                f"{getattr(other, 'settings', None)}; evaluate both with the same settings"
            )
        for token, counts in other._counts.items():  # noqa: SLF001 - its own kind
            self.add(token, counts)
        self.repeated |= other.repeated
        return self

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Each sample's counts by token, copied, so that callers cannot change the sums."""
        return _Copies(self._counts)

    def clustered(self, clusters: Mapping[str, str]) -> list[list[Counts]]:
        """The counts of some samples by cluster, for `resampled`; not copies, which would take most of the time.

        Args:
            clusters: token → name of its cluster; the clusters come in the order in which their names do.
        """
        counts: dict[str, list[Counts]] = {}
        for token, name in clusters.items():
            counts.setdefault(name, []).append(self._counts[token])
        return list(counts.values())

    @property
    def tokens(self) -> set[str]:
        """The samples counted."""
        return set(self._counts)

    def __len__(self) -> int:
        """Number of samples counted."""
        return len(self._counts)

    def compute(self, tokens: Iterable[str] | None = None) -> Result:
        """The metrics of all samples, or of some.

        Args:
            tokens: which samples; None for all.

        Raises:
            EvaluationError: one of them was not counted, or is no token.
        """
        if tokens is None:
            return self.result_of(list(self._counts.values()))
        if isinstance(tokens, str) or not isinstance(tokens, Iterable):
            raise EvaluationError(f"tokens: expected several of them, found {tokens!r}; give [token] for one")
        given: list[object] = list(tokens)
        others = [each for each in given if not isinstance(each, str)]
        if others:
            raise EvaluationError(f"tokens: expected texts, found {others[0]!r} among them")
        chosen = {str(each) for each in given}
        missing = sorted(chosen - self._counts.keys())
        if missing:
            raise EvaluationError(f"{len(missing)} samples have no prediction, such as {missing[0]}")
        return self.result_of([self._counts[token] for token in chosen])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all counts to a JSON file, from which a broken-off run goes on; returns its path.

        At any moment the file is either the old or the whole new one.

        Raises:
            EvaluationError: it cannot be written.
        """
        target = path_of(path)
        state = {
            "made_by": self.maker,
            "settings": self.settings,
            "repeated": sorted(self.repeated),
            "counts": {token: self._counts[token] for token in sorted(self._counts)},
        }
        try:
            write_bytes(target, json.dumps(state).encode())
        except OSError as error:
            remedy = "make room there, or choose another file"
            raise EvaluationError(f"{target}: the evaluation cannot be saved ({error}); {remedy}") from error
        return target

    def resume(self: EvaluatorT, path: str | os.PathLike[str]) -> EvaluatorT:
        """Take the counts that `save` wrote; returns this one.

        Raises:
            EvaluationError: there is no such file, it cannot be read, or it is of other settings, another evaluator or
                another version of the devkit.
        """
        source = path_of(path)
        try:
            state = parsed_json(read_bytes(source, "results"), constants=True)
            maker, settings, repeated = state["made_by"], state["settings"], set(state["repeated"])
            counts = {token: dict(each) for token, each in state["counts"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise EvaluationError(f"{source}: no saved evaluation ({fault_text(error)}); begin again") from error
        if maker != self.maker:
            raise EvaluationError(f"{source}: was saved by {maker}, this is {self.maker}; begin again")
        if settings != self.settings:
            raise EvaluationError(f"{source}: was saved with other settings ({settings}); begin again, or use those")
        try:
            for token, each in counts.items():
                self.add(token, each)
        except EvaluationError as error:
            raise EvaluationError(f"{source}: {error}") from error
        self.repeated |= repeated
        return self

    @property
    def maker(self) -> str:
        """The class and version that made the counts: another version may count differently."""
        return f"{type(self).__name__} of devkit {__version__}"


class _Copies(Mapping[str, Counts]):
    """Counts by token, of which only copies are handed out."""

    def __init__(self, counts: Mapping[str, Counts]) -> None:
        self._counts = counts

    def __getitem__(self, token: str) -> Counts:
        copied: Counts = _copied(self._counts[token])
        return copied

    def __contains__(self, token: object) -> bool:
        return token in self._counts

    def __iter__(self) -> Iterator[str]:
        return iter(self._counts)

    def __len__(self) -> int:
        return len(self._counts)


def _copied(value: Any) -> Any:
    """A copy of JSON values; much faster than `copy.deepcopy`."""
    if isinstance(value, Mapping):
        return {name: _copied(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_copied(each) for each in value]
    return value


def ratio(part: float, whole: float) -> float:
    """`part / whole`; NaN if there is nothing to count."""
    return part / whole if whole else math.nan


def total(counts: Iterable[Counts], name: str) -> float:
    """The exact sum of a number over samples, the same in any order."""
    return math.fsum(each[name] for each in counts)


Task = TypeVar("Task")
_BATCH: Final = 8
"""Samples that a worker evaluates at once, and a killed run can lose."""


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


_Counted: TypeAlias = tuple[Any, dict[str, EvaluationError]]
"""An evaluator with the counts of a batch, and why some of its samples have none."""


def _done(batches: Sequence[_Batch[Any]], store: Store | None, how: dict[str, Any]) -> Sequence[_Counted]:
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
            faults[token] = EvaluationError(f"{token}: cannot be evaluated: {type(error).__name__}: {text}")
            faults[token].__cause__ = error
    if store is not None and not faults:
        store.keep(batch.name, batch.key, json.dumps(dict(evaluator.counts)).encode())
    return evaluator, faults


def _fault_of_all(failed: Sequence[EvaluationError], samples: int) -> EvaluationError:
    """The error of the only one that has failed, or of a list of all."""
    if len(failed) == 1:
        return failed[0]
    lines = [f"{len(failed)} of {samples} samples cannot be evaluated:", *(f"  {each}" for each in failed)]
    fault = EvaluationError("\n".join(lines))
    fault.__cause__ = next((each.__cause__ for each in failed if each.__cause__ is not None), None)
    return fault


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
