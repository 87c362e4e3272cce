"""`evaluate_results`: from results and a release to an `EvaluationRun` with its numbers."""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, ResultsError
from deepaccident_devkit.evaluation.breakdowns import (
    WITHIN_RECORDINGS,
    Breakdown,
    Group,
    SampleAttributes,
    attribute_name,
    breakdown,
    sample_attributes,
)
from deepaccident_devkit.evaluation.counting import evaluate_samples
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs.setups import (
    Coverage,
    EvaluationSetup,
    SampleLoader,
    SampleSelection,
    check_recordings,
    checkpoint_path,
    coverage,
    default_selection,
    evaluator_class,
    scenario_of,
)
from deepaccident_devkit.evaluation.task import headlines, plain
from deepaccident_devkit.release.fingerprints import ScenarioHashes, fingerprint, scenario_hashes
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.parallel import run_batch, workers_kept
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine


SUMMARY_FORMAT: Final = "DeepAccident metrics summary"
SUMMARY_VERSION: Final = 1
BREAKDOWNS: Final = (
    "all",
    "time_to_impact",
    "accident_visibility",
    "agent",
    "scenario_type",
    "town",
    "weather_group",
    "time_of_day_group",
    "road_type",
    "trajectory_type",
    "collision_status",
)
"""Default attributes of breakdowns; `all` for intervals of the result itself."""
# Libraries whose arithmetic affects the numbers; a summary holds their versions.
_LIBRARIES: Final = ("numpy", "scipy")


def breakdowns_of(task: str) -> tuple[str, ...]:
    """Return the default attributes of a task's breakdowns.

    Warnings are evaluated on whole recordings and have no attributes within recordings.
    """
    names = BREAKDOWNS
    if evaluator_class(task).needs_whole_recordings:
        return tuple(name for name in names if name not in WITHIN_RECORDINGS)
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class Partial:
    """Numbers of expected samples that were and were not evaluated.

    Attributes:
        missing: Number of samples without a prediction.
        extra: Number of predictions that are left out: of other samples, or of no sample.
        expected: Number of samples that should be evaluated.
        evaluated: Number of samples that were evaluated.
    """

    missing: int
    extra: int
    expected: int
    evaluated: int

    def text(self) -> str:
        """Return the mark that every number bears: `PARTIAL: 120 of 180 samples`."""
        left_out = ""
        if self.extra:
            left_out = f", {counted(self.extra, 'prediction')} left out"
        return f"PARTIAL: {self.evaluated} of {counted(self.expected, 'sample')}{left_out}"

    def as_dict(self) -> dict[str, Any]:
        """Return the values by name, with the text as `mark`."""
        return asdict(self) | {"mark": self.text()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseInfo(ShortRepr):
    """The release that the ground truth comes from.

    Attributes:
        dataroot: Its folder.
        version: `v1` or `v1-mini`.
        scenarios: Hashes of the label, meta and calib files of each evaluated scenario.
    """

    dataroot: str
    version: str
    scenarios: Mapping[str, ScenarioHashes]

    @property
    def fingerprint(self) -> str:
        """A single hash over all these hashes."""
        return fingerprint(self.scenarios)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultsInfo(ShortRepr):
    """The results that were evaluated.

    Attributes:
        path: Path of their file or folder.
        task: Kind of predictions: `motion`, `accident` or `detection`.
        fingerprint: Hash over all predictions.
        meta: Notes of their author.
        form: How predictions of motion are stored, in JSON form; None for other results.
    """

    path: str
    task: str
    fingerprint: str
    meta: Mapping[str, Any]
    form: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationRun:
    """A finished evaluation.

    Attributes:
        setup: Task and rules.
        selection: The samples that were selected.
        evaluator: Evaluator with the counts of each sample.
        result: Result of all samples, as computed by the task's evaluator.
        partial: What is missing; None if nothing is.
        left_out: Number of predictions of other samples that the results have.
        attributes: Token → attributes of the sample, for each evaluated sample.
        times_to_impact: Token → seconds to the recorded impact; None where there is none, or none
            is known.
        breakdowns: Results by attribute; `all` has the intervals of the result itself.
        release: The release that the ground truth comes from.
        results: The results that were evaluated.
        sanity: Report of the sanity check in JSON form; None without a check.
        further: Name → a further result (`further.with_further`), as a single group `all` with
            intervals.
    """

    setup: EvaluationSetup
    selection: SampleSelection
    evaluator: Evaluator[Any]
    result: Any
    partial: Partial | None
    attributes: Mapping[str, SampleAttributes]
    times_to_impact: Mapping[str, float | None]
    breakdowns: tuple[Breakdown[Any], ...]
    release: ReleaseInfo
    results: ResultsInfo
    sanity: Mapping[str, Any] | None = None
    left_out: int = 0
    further: Mapping[str, Breakdown[Any]] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return task, protocol, whether it is partial, and the first headlines."""
        mark = ""
        if self.partial is not None:
            mark = f", {self.partial.text()}"
        protocol = f"protocol {self.setup.protocol}{mark}"
        return f"EvaluationRun({self.setup.task}, {protocol}: {self.result!r})"

    @property
    def prevented(self) -> Breakdown[Any] | None:
        """Accidents that warnings would have prevented; None without (`with_prevented`)."""
        return self.further.get("prevented")

    @property
    def stamp(self) -> dict[str, Any]:
        """Stamp of every file: version of the devkit, task, protocol, and the mark if partial."""
        return {
            "devkit_version": __version__,
            "task": self.setup.task,
            "protocol": self.setup.protocol,
            "partial": None if self.partial is None else self.partial.as_dict(),
        }

    def broken_down(
        self,
        by: Sequence[str] | None = None,
        resampling: Resampling | None = None,
        **engine: Unpack[Engine],
    ) -> EvaluationRun:
        """Return the same run with results by these attributes, which replace its breakdowns.

        Args:
            by: Names of `breakdowns.ATTRIBUTES`; repeated names count once. None for
                `breakdowns_of` the task.
            resampling: How intervals are made; None for the defaults.
            **engine: `workers` (1 by default), `executor` and `progress`, see `parallel.Engine`.

        Raises:
            ChoiceError: no such attribute.
        """
        names = breakdowns_of(self.setup.task) if by is None else map(attribute_name, by)
        work = partial(breakdown, self.evaluator, dict(self.attributes), resampling=resampling)
        engine = {"workers": 1, **engine}
        breakdowns = run_batch(work, list(dict.fromkeys(names)), **engine)
        return replace(self, breakdowns=tuple(breakdowns))

    def summary(self) -> dict[str, Any]:
        """Return all numbers except for single samples, and what they depend on, as JSON."""
        values = {
            "format": SUMMARY_FORMAT,
            "version": SUMMARY_VERSION,
            **self.stamp,
            **_without(self.setup.as_dict(), "task", "protocol"),
            **_without(self.selection.as_dict(), "horizon"),
            "counts": {
                "samples": len(self.evaluator),
                "scenarios": len(set(map(scenario_of, self.evaluator.tokens))),
                "left_out": self.left_out,
            },
            "release": {
                "version": self.release.version,
                "dataroot": self.release.dataroot,
                "fingerprint": self.release.fingerprint,
            },
            "results": self.results,
            "headlines": [{**asdict(line), "text": line.text()} for line in headlines(self.result)],
            "metrics": self.result.as_dict(),
            "breakdowns": {table.by: _breakdown_values(table) for table in self.breakdowns},
            "environment": _environment(),
            "sanity": self.sanity,
            **{name: _further_values(table) for name, table in self.further.items()},
        }
        plain_form: dict[str, Any] = json.loads(json.dumps(plain(values)))
        return plain_form


def _without(values: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in names}


def _environment() -> dict[str, str]:
    """Return the versions of Python and of the libraries."""
    from importlib.metadata import version as installed_version

    versions = {name: installed_version(name) for name in _LIBRARIES}
    return {"python": platform.python_version(), **versions}


def _breakdown_values(table: Breakdown[Any]) -> dict[str, Any]:
    return {
        "resampling": plain(table.resampling),
        "groups": list(map(_group_values, table.groups)),
        "without_infrastructure": list(map(_group_values, table.without_infrastructure)),
    }


def _group_values(group: Group[Any]) -> dict[str, Any]:
    return {
        "value": group.value,
        "samples": group.samples,
        "scenarios": group.scenarios,
        "clusters": group.clusters,
        "headlines": {line.path: line.value for line in headlines(group.result)},
        "metrics": group.result.as_dict(),
        "intervals": plain(group.intervals),
        "notes": list(group.notes),
    }


def _further_values(table: Breakdown[Any]) -> dict[str, Any]:
    (group,) = table.groups
    return {
        **group.result.as_dict(),
        "resampling": plain(table.resampling),
        "intervals": plain(group.intervals),
        "interval_notes": list(group.notes),
    }


@dataclass(frozen=True, eq=False)
class _LazyAttributes(Mapping[str, SampleAttributes]):
    """`sample_attributes`, computed on first use: only evaluations with breakdowns need them."""

    dataset: Dataset
    tokens: Sequence[str]

    @cached_property
    def _attributes(self) -> dict[str, SampleAttributes]:
        return sample_attributes(self.dataset, self.tokens)

    def __getitem__(self, token: str) -> SampleAttributes:
        return self._attributes[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self._attributes)

    def __len__(self) -> int:
        return len(self.tokens)


@workers_kept()
def evaluate_results(
    dataset: Dataset,
    results: Results | str | os.PathLike[str],
    setup: EvaluationSetup,
    selection: SampleSelection | str | os.PathLike[str] = "val",
    *,
    allow_partial: bool = False,
    out: str | os.PathLike[str] | None = None,
    **engine: Unpack[Engine],
) -> EvaluationRun:
    """Evaluate a results file, which is fully checked before any long work.

    Any number of workers gives the same bits.

    Args:
        dataset: The release.
        results: The opened results, or their path.
        setup: Task and rules.
        selection: The samples; the name of a split stands for its `default_selection`.
        allow_partial: Whether to evaluate the samples common to both where the results lack some,
            or have others; if some are missing, all output is marked as partial.
        out: The folder that the run will be saved to (`save_run`). Counts are stored beside it: an
            interrupted run continues with them if nothing that they depend on has changed, and
            several processes with the same folder share the samples. None for no such counts.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Returns:
        The run, without breakdowns: `EvaluationRun.broken_down` adds them.

    Raises:
        ResultsError: the results cannot be read, an entry is wrong, they are of other recordings
            (`check_recordings`), or they do not have the samples of the selection.
        EvaluationError: they are of another kind than the task is evaluated from or look less far
            ahead, scenarios lack the meta that the task needs, or samples cannot be evaluated.
        ChoiceError: no such split.
        NotAvailableError: the release has no such samples.
        IndexStoreError: files of these scenarios have changed since the index was made.
        WorkerError: a worker was killed, or cannot do the work.
    """
    if not isinstance(selection, SampleSelection):
        selection = default_selection(setup, selection)
    opened = results if isinstance(results, Results) else read_results(results)
    loader = SampleLoader(dataset, opened, setup)
    check_recordings(opened, dataset)
    covered = coverage(dataset, opened.tokens, selection, explain=not allow_partial)
    tokens = _covered_tokens(dataset, opened, selection, covered, allow_partial=allow_partial)
    if evaluator_class(setup.task).needs_meta:
        check_metas(dataset, tokens, selection.split)
    engine = {"workers": None, **engine}
    opened.check(**engine)
    scenarios = set(map(scenario_of, tokens))
    hashes = scenario_hashes(
        dataset, scenarios, workers=engine["workers"], executor=engine.get("executor")
    )
    prints = {"results": opened.fingerprint, "release": fingerprint(hashes)}
    checkpoint = None if out is None else checkpoint_path(out, setup, tokens, prints)
    samples = {token: token for token in tokens}
    evaluator = evaluate_samples(
        setup.evaluator(), samples, loader, checkpoint=checkpoint, places=loader.places, **engine
    )
    return EvaluationRun(
        setup=setup,
        selection=selection,
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=partial_of(covered),
        left_out=len(covered.extra) + len(covered.unknown),
        attributes=_LazyAttributes(dataset, tokens),
        times_to_impact={token: dataset.get("sample", token)["time_to_impact"] for token in tokens},
        breakdowns=(),
        release=ReleaseInfo(
            dataroot=str(dataset.dataroot), version=dataset.version, scenarios=hashes
        ),
        results=results_info(opened),
    )


def results_info(results: Results) -> ResultsInfo:
    """Return the metadata of the results that a run stores."""
    return ResultsInfo(
        path=os.fspath(Path(results.path).absolute()),
        task=results.task,
        fingerprint=results.fingerprint,
        meta=results.meta,
        form=None if results.form is None else results.form.as_dict(),
    )


def _covered_tokens(
    dataset: Dataset,
    results: Results,
    selection: SampleSelection,
    covered: Coverage,
    *,
    allow_partial: bool,
) -> list[str]:
    """Return the samples to evaluate; raises ResultsError if samples differ or there are none."""
    if not covered.is_complete and not allow_partial:
        remedy = (
            "; give results of these samples, choose the list that they are of (--split, "
            "--agents, --samples, --scope, --horizon; in Python a SampleSelection), or evaluate "
            "the samples that have a prediction with allow_partial=True (--allow-partial), which "
            "marks every number as partial"
        )
        if covered.options or not (covered.missing or covered.unknown):
            remedy = ""  # the text of the coverage has a better one
        raise ResultsError(f"{results.path}: {covered.to_text()}{remedy}")
    tokens = [token for token in selection.tokens(dataset) if token in results]
    if not tokens:
        raise ResultsError(f"{results.path}: {covered.to_text()}; nothing is left to evaluate")
    return tokens


def check_metas(dataset: Dataset, tokens: Sequence[str], split: str) -> None:
    """Raise EvaluationError if scenarios of samples have no meta file, which names the pair.

    The message has the number of such scenarios.
    """
    scenarios = list(dict.fromkeys(map(scenario_of, tokens)))
    without_meta = [
        token for token in scenarios if dataset.get("scenario", token)["weather"] is None
    ]
    if without_meta:
        of_split = ""
        if split in SPLITS:
            of_split = f" --where split={split}"
        more = ""
        if len(without_meta) > 3:
            more = ", …"
        raise EvaluationError(
            f"{len(without_meta)} of {len(scenarios)} scenarios have no meta file, which names the "
            "colliding pair, so that accidents cannot be evaluated there: "
            f"{', '.join(without_meta[:3])}{more}; unpack their meta folders, or leave them out "
            "with a split file of your own: deepaccident split "
            f"{shlex.quote(str(dataset.dataroot))}{of_split} --where 'weather!=unknown' --out "
            "mine.txt, then --split mine.txt"
        )


def partial_of(covered: Coverage) -> Partial | None:
    """Return the mark of a run; None if only predictions of other samples are left out."""
    missing = len(covered.missing)
    if not missing:
        return None
    return Partial(
        missing=missing,
        extra=len(covered.extra) + len(covered.unknown),
        expected=covered.expected,
        evaluated=covered.expected - missing,
    )
