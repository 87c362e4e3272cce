"""`evaluate_results`: from a results file and a release to an `EvaluationRun`, its numbers and what they depend on."""

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
"""What results are broken down by if nothing else is asked for; `all` for intervals of the result itself."""


def breakdowns_of(task: str) -> tuple[str, ...]:
    """What a task's results are broken down by if nothing else is asked for: warnings by whole recordings alone."""
    whole = evaluator_class(task).needs_whole_recordings
    return tuple(name for name in BREAKDOWNS if not (whole and name in WITHIN_RECORDINGS))


# Whose versions stand in a summary: arithmetic is theirs.
_LIBRARIES: Final = ("numpy", "scipy")


@dataclass(frozen=True, slots=True, kw_only=True)
class Partial:
    """How many of the expected samples were not evaluated.

    Attributes:
        missing: samples without a prediction.
        extra: predictions that are left out: of other samples, or of none.
        expected: samples that should be evaluated.
        evaluated: those that were.
    """

    missing: int
    extra: int
    expected: int
    evaluated: int

    def text(self) -> str:
        """The mark that every number bears: `PARTIAL: 120 of 180 samples`."""
        left_out = f", {counted(self.extra, 'prediction')} left out" if self.extra else ""
        return f"PARTIAL: {self.evaluated} of {counted(self.expected, 'sample')}{left_out}"

    def as_dict(self) -> dict[str, Any]:
        """By name, with the text as `mark`."""
        return asdict(self) | {"mark": self.text()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseInfo(ShortRepr):
    """Of which release the truth is.

    Attributes:
        dataroot: its folder.
        version: `v1` or `v1-mini`.
        scenarios: hashes of the label, meta and calib files of each scenario evaluated.
    """

    dataroot: str
    version: str
    scenarios: Mapping[str, ScenarioHashes]

    @property
    def fingerprint(self) -> str:
        """One hash over all these."""
        return fingerprint(self.scenarios)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultsInfo(ShortRepr):
    """Of which results the predictions are.

    Attributes:
        path: of their file or folder.
        task: what they hold: `motion`, `accident` or `detection`.
        fingerprint: a hash over all of them.
        meta: what their maker says of them.
        form: of motion, how they are stored, as JSON holds it; None for others.
    """

    path: str
    task: str
    fingerprint: str
    meta: Mapping[str, Any]
    form: Mapping[str, Any] | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EvaluationRun:
    """An evaluation that is done.

    Attributes:
        setup: task and rules.
        selection: which samples.
        evaluator: with the counts of each sample.
        result: of all samples, as the task's evaluator computes it.
        partial: what is missing; None for nothing.
        left_out: how many predictions of other samples the results have.
        attributes: of each sample evaluated, by token.
        times_to_impact: seconds from each of them to the recorded impact; None where there is none, or none is known.
        breakdowns: results by attribute; `all` has the intervals of the result itself.
        release: whose labels are the truth.
        results: whose predictions they are.
        sanity: what the sanity check says, as JSON holds it; None without.
        further: name → a further result (`further.with_further`), as one group `all` with intervals.
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
        """Task, protocol, whether it is partial, and the first headlines."""
        mark = "" if self.partial is None else f", {self.partial.text()}"
        return f"EvaluationRun({self.setup.task}, protocol {self.setup.protocol}{mark}: {self.result!r})"

    @property
    def prevented(self) -> Breakdown[Any] | None:
        """Of warnings, the accidents that they would have prevented; None without (`with_prevented`)."""
        return self.further.get("prevented")

    @property
    def stamp(self) -> dict[str, Any]:
        """The stamp of every file: devkit, task, protocol, and whether it is partial."""
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
        **how: Unpack[Engine],
    ) -> EvaluationRun:
        """The same run with results by these attributes, in place of those it has.

        Args:
            by: of `breakdowns.ATTRIBUTES`; one that is given twice counts once. None for `breakdowns_of` the task.
            resampling: how intervals are made; None for the defaults.
            **how: `workers` (1 if not given), `executor` and `progress`, as `parallel.Engine` says.

        Raises:
            ChoiceError: no such attribute.
        """
        chosen = breakdowns_of(self.setup.task) if by is None else map(attribute_name, by)
        work = partial(breakdown, self.evaluator, dict(self.attributes), resampling=resampling)
        how = {"workers": 1, **how}
        found = run_batch(work, list(dict.fromkeys(chosen)), **how)
        return replace(self, breakdowns=tuple(found))

    def summary(self) -> dict[str, Any]:
        """All numbers except those of single samples, and what they depend on, as JSON holds it."""
        from importlib.metadata import version as installed_version

        made = {
            "format": SUMMARY_FORMAT,
            "version": SUMMARY_VERSION,
            **self.stamp,
            **{
                name: each
                for name, each in self.setup.as_dict().items()
                if name not in ("task", "protocol")
            },
            **{name: each for name, each in self.selection.as_dict().items() if name != "horizon"},
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
            "headlines": [{**asdict(each), "text": each.text()} for each in headlines(self.result)],
            "metrics": self.result.as_dict(),
            "breakdowns": {each.by: self._breakdown(each) for each in self.breakdowns},
            "environment": {
                "python": platform.python_version(),
                **{name: installed_version(name) for name in _LIBRARIES},
            },
            "sanity": self.sanity,
            **{name: _further(each) for name, each in self.further.items()},
        }
        plain_form: dict[str, Any] = json.loads(json.dumps(plain(made)))
        return plain_form

    def _breakdown(self, given: Breakdown[Any]) -> dict[str, Any]:
        return {
            "resampling": plain(given.resampling),
            "groups": self._groups(given.groups),
            "without_infrastructure": self._groups(given.without_infrastructure),
        }

    def _groups(self, groups: Sequence[Group[Any]]) -> list[dict[str, Any]]:
        return [
            {
                "value": group.value,
                "samples": group.samples,
                "scenarios": group.scenarios,
                "clusters": group.clusters,
                "headlines": {each.path: each.value for each in headlines(group.result)},
                "metrics": group.result.as_dict(),
                "intervals": plain(group.intervals),
                "notes": list(group.notes),
            }
            for group in groups
        ]


def _further(given: Breakdown[Any]) -> dict[str, Any]:
    (group,) = given.groups
    return {
        **group.result.as_dict(),
        "resampling": plain(given.resampling),
        "intervals": plain(group.intervals),
        "interval_notes": list(group.notes),
    }


@dataclass(frozen=True, eq=False)
class _AttributesWhenAsked(Mapping[str, SampleAttributes]):
    """`sample_attributes`, made when one is asked for: an evaluation that is not broken down needs none."""

    dataset: Dataset
    tokens: Sequence[str]

    @cached_property
    def _made(self) -> dict[str, SampleAttributes]:
        return sample_attributes(self.dataset, self.tokens)

    def __getitem__(self, token: str) -> SampleAttributes:
        return self._made[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self._made)

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
    **how: Unpack[Engine],
) -> EvaluationRun:
    """Evaluate a results file. It is checked wholly before any long work; any number of workers gives the same bits.

    Args:
        dataset: the release.
        results: opened, or their path.
        setup: task and rules.
        selection: which samples; the name of a split for what `default_selection` has of it.
        allow_partial: whether to evaluate the samples that are in both where the results lack some, or have others;
            if some are missing, all output is marked as partial.
        out: the folder that the run will be saved to (`save_run`): counts are kept beside it, a run that broke off goes
            on with them if nothing that they depend on has changed, and several processes that are given it share the
            samples. None for no such counts.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Returns:
        The run, without breakdowns: `EvaluationRun.broken_down` adds them.

    Raises:
        ResultsError: the results cannot be read, an entry is wrong, they are of other recordings (`check_recordings`),
            or they do not have the samples of the selection.
        EvaluationError: they are of another kind than the task is evaluated from or look less far ahead, scenarios lack
            the meta that the task needs, or samples cannot be evaluated.
        ChoiceError: no such split.
        NotAvailableError: the release has no such samples.
        IndexStoreError: files of these scenarios have changed since the index was made.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = (
        selection if isinstance(selection, SampleSelection) else default_selection(setup, selection)
    )
    loader = SampleLoader(
        dataset, results if isinstance(results, Results) else read_results(results), setup
    )
    check_recordings(loader.results, dataset)
    covered = coverage(dataset, loader.results.tokens, chosen, explain=not allow_partial)
    tokens = _covered_tokens(dataset, loader.results, chosen, covered, allow_partial=allow_partial)
    if evaluator_class(setup.task).needs_meta:
        check_metas(dataset, tokens, chosen.split)
    how = {"workers": None, **how}
    loader.results.check(**how)
    hashes = scenario_hashes(
        dataset, set(map(scenario_of, tokens)), workers=how["workers"], executor=how.get("executor")
    )
    prints = {"results": loader.results.fingerprint, "release": fingerprint(hashes)}
    checkpoint = None if out is None else checkpoint_path(out, setup, tokens, prints)
    samples = {token: token for token in tokens}
    evaluator = evaluate_samples(
        setup.evaluator(), samples, loader, checkpoint=checkpoint, places=loader.places, **how
    )
    return EvaluationRun(
        setup=setup,
        selection=chosen,
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=partial_of(covered),
        left_out=len(covered.extra) + len(covered.unknown),
        attributes=_AttributesWhenAsked(dataset, tokens),
        times_to_impact={token: dataset.get("sample", token)["time_to_impact"] for token in tokens},
        breakdowns=(),
        release=ReleaseInfo(
            dataroot=str(dataset.dataroot), version=dataset.version, scenarios=hashes
        ),
        results=results_info(loader.results),
    )


def results_info(results: Results) -> ResultsInfo:
    """The facts on its results that a run keeps."""
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
    if not covered.is_complete and not allow_partial:
        remedy = (
            "; give results of these samples, choose the list that they are of (--split, --agents, --samples, --scope, "
            "--horizon; in Python a SampleSelection), or evaluate the samples that have a prediction with "
            "allow_partial=True (--allow-partial), which marks every number as partial"
        )
        is_enough = covered.options or not (covered.missing or covered.unknown)
        raise ResultsError(f"{results.path}: {covered.to_text()}{'' if is_enough else remedy}")
    tokens = [token for token in selection.tokens(dataset) if token in results]
    if not tokens:
        raise ResultsError(f"{results.path}: {covered.to_text()}; nothing is left to evaluate")
    return tokens


def check_metas(dataset: Dataset, tokens: Sequence[str], split: str) -> None:
    """Raise EvaluationError, which counts them, if scenarios of samples have no meta file: it names the pair."""
    scenarios = list(dict.fromkeys(map(scenario_of, tokens)))
    silent = [token for token in scenarios if dataset.get("scenario", token)["weather"] is None]
    if silent:
        of_split = f" --where split={split}" if split in SPLITS else ""
        raise EvaluationError(
            f"{len(silent)} of {len(scenarios)} scenarios have no meta file, which names the colliding pair, so that "
            f"accidents cannot be evaluated there: {', '.join(silent[:3])}{', …' if len(silent) > 3 else ''}; unpack "
            f"their meta folders, or leave them out with a split file of your own: deepaccident split "
            f"{shlex.quote(str(dataset.dataroot))}{of_split} --where 'weather!=unknown' --out mine.txt, then "
            "--split mine.txt"
        )


def partial_of(covered: Coverage) -> Partial | None:
    """The mark of a run; predictions of other samples alone change no number."""
    missing = len(covered.missing)
    if not missing:
        return None
    return Partial(
        missing=missing,
        extra=len(covered.extra) + len(covered.unknown),
        expected=covered.expected,
        evaluated=covered.expected - missing,
    )
