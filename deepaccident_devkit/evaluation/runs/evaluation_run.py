"""`evaluate_results` evaluates results against a release and returns an `EvaluationRun`."""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
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
from deepaccident_devkit.support.parallel import keep_workers, run_batch
from deepaccident_devkit.support.text import PathType, counted
from deepaccident_devkit.support.values import NamedValues
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
"""Default attributes of breakdowns; `all` provides the intervals of the result itself."""
# Libraries whose arithmetic affects the numbers; a summary states their versions.
_LIBRARIES = ("numpy", "scipy")
# Largest number of scenarios that an error names.
_MAX_NAMED_SCENARIOS = 3


def breakdowns_of(task: str) -> tuple[str, ...]:
    """Return the default attributes of a task's breakdowns.

    A task that needs whole recordings, such as warnings, is not broken down by attributes that
    change within a recording.
    """
    if not evaluator_class(task).needs_whole_recordings:
        return BREAKDOWNS
    return tuple(name for name in BREAKDOWNS if name not in WITHIN_RECORDINGS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Partial:
    """How many expected samples were and were not evaluated.

    Attributes:
        missing: Number of samples without a prediction.
        extra: Number of predictions that are left out, since they belong to other samples or to
            unknown ones.
        expected: Number of samples that should be evaluated.
        evaluated: Number of samples that were evaluated.
    """

    missing: int
    extra: int
    expected: int
    evaluated: int

    def text(self) -> str:
        """Return the mark that is shown with every number: `PARTIAL: 120 of 180 samples`."""
        left_out = ""
        if self.extra:
            left_out = f", {counted(self.extra, 'prediction')} left out"
        samples = counted(self.expected, "sample")
        return f"PARTIAL: {self.evaluated} of {samples}{left_out}"

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, and the text under the key `mark`."""
        return asdict(self) | {"mark": self.text()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseInfo(ShortRepr):
    """Description of the release that the ground truth comes from.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        scenarios: Hashes of the label, meta and calib files of each evaluated scenario.
    """

    dataroot: str
    version: str
    scenarios: Mapping[str, ScenarioHashes]

    @property
    def fingerprint(self) -> str:
        """One hash over the hashes of all scenarios."""
        return fingerprint(self.scenarios)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultsInfo(ShortRepr):
    """Description of the results that were evaluated.

    Attributes:
        path: Path of the file or folder.
        task: Kind of the predictions, such as `motion`, `accident` or `detection`.
        fingerprint: Hash over all predictions.
        meta: The author's notes.
        form: How motion predictions are stored, as JSON values; None for other results.
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
        selection: Selection of the samples.
        evaluator: Evaluator with the counts of each sample.
        result: Result over all samples, as computed by the task's evaluator.
        partial: Numbers of missing samples; None if no sample is missing.
        left_out: Number of predictions that were left out, since their samples are not selected.
        attributes: Token → attributes of the sample, for each evaluated sample.
        times_to_impact: Token → seconds to the recorded impact; None if there is no impact or its
            time is unknown.
        breakdowns: Results by attribute; `all` contains the intervals of the result itself.
        release: Description of the release that the ground truth comes from.
        results: Description of the results that were evaluated.
        sanity: Report of the sanity check as JSON values; None if there was no check.
        further: Name → further result with intervals (`further.with_further`), as a breakdown with
            the single group `all`.
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
        """Return the task, the protocol, the mark of a partial run, and the first headlines."""
        mark = ""
        if self.partial is not None:
            mark = f", {self.partial.text()}"
        protocol = f"protocol {self.setup.protocol}{mark}"
        return f"EvaluationRun({self.setup.task}, {protocol}: {self.result!r})"

    @property
    def prevented(self) -> Breakdown[Any] | None:
        """Accidents that warnings would have prevented, if `with_prevented` added them."""
        return self.further.get("prevented")

    @property
    def stamp(self) -> dict[str, Any]:
        """Stamp in every file of the run: devkit version, task, protocol, and missing samples."""
        partial_values = None
        if self.partial is not None:
            partial_values = self.partial.as_dict()
        return {
            "devkit_version": __version__,
            "task": self.setup.task,
            "protocol": self.setup.protocol,
            "partial": partial_values,
        }

    def broken_down(
        self,
        by: Sequence[str] | None = None,
        resampling: Resampling | None = None,
        **engine: Unpack[Engine],
    ) -> EvaluationRun:
        """Return a copy of the run whose breakdowns are replaced.

        Args:
            by: Attributes to break the result down by (`breakdowns.ATTRIBUTES`); repeated names
                count once. None for the defaults of the task (`breakdowns_of`).
            resampling: Settings of the intervals; None for the defaults.
            **engine: `workers` (1 by default), `executor` and `progress`; see `parallel.Engine`.

        Raises:
            ChoiceError: If an attribute does not exist.
        """
        names = breakdowns_of(self.setup.task) if by is None else map(attribute_name, by)
        work = partial(breakdown, self.evaluator, dict(self.attributes), resampling=resampling)
        engine = {"workers": 1, **engine}
        breakdowns = run_batch(work, list(dict.fromkeys(names)), **engine)
        return replace(self, breakdowns=tuple(breakdowns))

    def summary(self) -> dict[str, Any]:
        """Return all numbers except single samples', and what they depend on, as JSON."""
        setup = self.setup.as_dict()
        del setup["task"], setup["protocol"]  # they are in the stamp
        selection = self.selection.as_dict()
        del selection["horizon"]  # it is in the setup
        values = {
            "format": SUMMARY_FORMAT,
            "version": SUMMARY_VERSION,
            **self.stamp,
            **setup,
            **selection,
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
            "headlines": [
                asdict(headline) | {"text": headline.text()} for headline in headlines(self.result)
            ],
            "metrics": self.result.as_dict(),
            "breakdowns": {table.by: _breakdown_values(table) for table in self.breakdowns},
            "environment": _environment(),
            "sanity": self.sanity,
            **{name: _further_values(table) for name, table in self.further.items()},
        }
        plain_form: NamedValues = json.loads(json.dumps(plain(values)))
        return plain_form


def _environment() -> dict[str, str]:
    """Return the versions of Python and of the libraries by name."""
    from importlib.metadata import version as installed_version

    versions = {name: installed_version(name) for name in _LIBRARIES}
    return {"python": platform.python_version(), **versions}


def _breakdown_values(table: Breakdown[Any]) -> NamedValues:
    """Convert a breakdown to the values that a summary contains."""
    return {
        "resampling": table.resampling,
        "groups": [_group_values(group) for group in table.groups],
        "without_infrastructure": [_group_values(group) for group in table.without_infrastructure],
    }


def _group_values(group: Group[Any]) -> NamedValues:
    """Convert a group of a breakdown to the values that a summary contains."""
    return {
        "value": group.value,
        "samples": group.samples,
        "scenarios": group.scenarios,
        "clusters": group.clusters,
        "headlines": {headline.path: headline.value for headline in headlines(group.result)},
        "metrics": group.result.as_dict(),
        "intervals": group.intervals,
        "notes": group.notes,
    }


def _further_values(table: Breakdown[Any]) -> NamedValues:
    """Convert a further result to the values that a summary contains."""
    (group,) = table.groups
    return {
        **group.result.as_dict(),
        "resampling": table.resampling,
        "intervals": group.intervals,
        "interval_notes": group.notes,
    }


@dataclass(frozen=True, eq=False)
class _LazyAttributes(Mapping[str, SampleAttributes]):
    """Attributes of samples by token, computed on first use, since only breakdowns need them."""

    dataset: Dataset
    tokens: Sequence[str]

    @cached_property
    def _attributes(self) -> dict[str, SampleAttributes]:
        """Attributes of all samples by token."""
        return sample_attributes(self.dataset, self.tokens)

    def __getitem__(self, token: str) -> SampleAttributes:
        return self._attributes[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self._attributes)

    def __len__(self) -> int:
        return len(self.tokens)


@keep_workers()
def evaluate_results(
    dataset: Dataset,
    results: Results | str | os.PathLike[str],
    setup: EvaluationSetup,
    selection: SampleSelection | str | os.PathLike[str] = "val",
    *,
    allow_partial: bool = False,
    out: PathType | None = None,
    **engine: Unpack[Engine],
) -> EvaluationRun:
    """Evaluate results; they are fully checked before any long computation.

    The numbers are identical for any number of workers.

    Args:
        dataset: Release with the ground truth.
        results: Opened results, or their path.
        setup: Task and rules.
        selection: Selection of the samples; the name of a split selects its `default_selection`.
        allow_partial: Whether to accept results whose samples differ from the selected ones. Then
            predictions for other samples are ignored, and if samples are missing, all output is
            marked as partial. For tracking, a recording that lacks samples is left out as a whole.
        out: Folder that the run will be saved to (`save_run`); counts are stored next to it. An
            interrupted run continues with these counts if nothing that they depend on has changed,
            and several processes with the same folder share the samples. None stores no counts.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Returns:
        The run, without breakdowns; `EvaluationRun.broken_down` adds them.

    Raises:
        ResultsError: If the results cannot be read, have an invalid entry, were predicted on other
            recordings (`check_recordings`), or do not cover the selected samples.
        EvaluationError: If the task cannot be evaluated from such results, the predictions do not
            look far enough ahead, scenarios lack the meta file that the task needs, or samples
            cannot be evaluated.
        ChoiceError: If the split does not exist.
        NotAvailableError: If the release does not have the selected samples.
        IndexStoreError: If files of the scenarios have changed since the index was made.
        WorkerError: If a worker was killed, or cannot do its work.
    """
    if not isinstance(selection, SampleSelection):
        selection = default_selection(setup, selection)
    opened = results if isinstance(results, Results) else read_results(results)
    loader = SampleLoader(dataset, opened, setup)
    check_recordings(opened, dataset)
    predicted: Collection[str] = opened.tokens
    if allow_partial and evaluator_class(setup.task).needs_complete_recordings:
        predicted = _complete_recordings(predicted, selection.tokens(dataset))
    covered = coverage(dataset, predicted, selection, explain=not allow_partial)
    tokens = _covered_tokens(dataset, opened, selection, covered, allow_partial=allow_partial)
    if evaluator_class(setup.task).needs_meta:
        check_metas(dataset, tokens, selection.split)
    engine = {"workers": None, **engine}
    opened.check(**engine)
    scenarios = set(map(scenario_of, tokens))
    hashes = scenario_hashes(
        dataset, scenarios, workers=engine["workers"], executor=engine.get("executor")
    )
    fingerprints = {"results": opened.fingerprint, "release": fingerprint(hashes)}
    checkpoint = None
    if out is not None:
        checkpoint = checkpoint_path(out, setup, tokens, fingerprints)
    samples = {token: token for token in tokens}
    evaluator = evaluate_samples(
        setup.evaluator(), samples, loader, checkpoint=checkpoint, places=loader.places, **engine
    )
    times_to_impact = {token: dataset.get("sample", token)["time_to_impact"] for token in tokens}
    release = ReleaseInfo(dataroot=str(dataset.dataroot), version=dataset.version, scenarios=hashes)
    return EvaluationRun(
        setup=setup,
        selection=selection,
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=partial_of(covered),
        left_out=len(covered.extra) + len(covered.unknown),
        attributes=_LazyAttributes(dataset, tokens),
        times_to_impact=times_to_impact,
        breakdowns=(),
        release=release,
        results=results_info(opened),
    )


def results_info(results: Results) -> ResultsInfo:
    """Describe results as a run stores them."""
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
    """Return the samples to evaluate.

    Raise ResultsError if there are none, or if the samples of the results differ from the selected
    ones and `allow_partial` is False.
    """
    if not covered.is_complete and not allow_partial:
        remedy = (
            "; give results of the evaluated samples, select the samples of the results (--split, "
            "--agents, --samples, --scope, --horizon; in Python a SampleSelection), or evaluate "
            "only samples with a prediction by allow_partial=True (--allow-partial), which marks "
            "every number as partial"
        )
        if covered.options or not (covered.missing or covered.unknown):
            remedy = ""  # the text of the coverage suggests a better one
        raise ResultsError(f"{results.path}: {covered.to_text()}{remedy}")
    missing = set(covered.missing)
    tokens = [token for token in selection.tokens(dataset) if token not in missing]
    if not tokens:
        raise ResultsError(f"{results.path}: {covered.to_text()}; no sample is left to evaluate")
    return tokens


def _complete_recordings(predicted: Collection[str], expected: Sequence[str]) -> list[str]:
    """Return the predicted samples without those of recordings that lack an expected sample."""
    recordings = {token.rpartition("/")[0] for token in set(expected).difference(predicted)}
    return [token for token in predicted if token.rpartition("/")[0] not in recordings]


def check_metas(dataset: Dataset, tokens: Sequence[str], split: str) -> None:
    """Raise EvaluationError if a sample's scenario has no meta file, which names the pair."""
    scenarios = dict.fromkeys(map(scenario_of, tokens))
    without_meta = []
    for scenario in scenarios:
        if dataset.get("scenario", scenario)["weather"] is None:
            without_meta.append(scenario)
    if not without_meta:
        return
    split_option = ""
    if split in SPLITS:
        split_option = f" --where split={split}"
    more = ""
    if len(without_meta) > _MAX_NAMED_SCENARIOS:
        more = ", …"
    raise EvaluationError(
        f"no meta file, which names the colliding pair, for {len(without_meta)} of "
        f"{counted(len(scenarios), 'scenario')}, so their accidents cannot be evaluated: "
        f"{', '.join(without_meta[:_MAX_NAMED_SCENARIOS])}{more}; unpack the meta folders, or "
        "exclude these scenarios with your own split file: deepaccident split "
        f"{shlex.quote(str(dataset.dataroot))}{split_option} --where 'weather!=unknown' --out "
        "mine.txt, then --split mine.txt"
    )


def partial_of(covered: Coverage) -> Partial | None:
    """Return how many samples are missing in a run; None if all are there."""
    num_missing = len(covered.missing)
    if not num_missing:
        return None
    return Partial(
        missing=num_missing,
        extra=len(covered.extra) + len(covered.unknown),
        expected=covered.expected,
        evaluated=covered.expected - num_missing,
    )
