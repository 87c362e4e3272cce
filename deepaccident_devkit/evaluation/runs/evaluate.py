"""`evaluate_results`: from a results file and a release to an `EvaluationRun`; `evaluate_shard` counts a part."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, EvaluationError, ResultsError
from deepaccident_devkit.evaluation.metrics.attributes import sample_attributes
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs.checkpoints import checkpoint_path, stored_shards, whole_counts
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun, Partial, ReleaseInfo, ResultsInfo
from deepaccident_devkit.evaluation.runs.many_samples import evaluate_samples, take_stored
from deepaccident_devkit.evaluation.runs.selection import (
    Coverage,
    SampleList,
    SampleSelection,
    ScopeName,
    coverage,
    scenario_of,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.parallel import Shard, check_whole
from deepaccident_devkit.release.fingerprints import ScenarioHashes, fingerprint, scenario_hashes
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from concurrent.futures import Executor

_OF_ACCIDENTS: Final = ("accident", "warning")
"""Tasks whose truth is in meta."""


def default_selection(
    setup: EvaluationSetup,
    split: str | os.PathLike[str] = "val",
    *,
    samples: SampleList | None = None,
    scope: ScopeName | None = None,
    agents: Sequence[str] | None = None,
) -> SampleSelection:
    """The samples that a setup is evaluated at.

    Args:
        setup: its task and horizon.
        split: `train`, `val`, … or the path of a split file.
        samples: None for `all` of the task `warning`, which follows whole recordings, and else `evaluate`.
        scope: None for `all` where all samples are evaluated, and else `accident`.
        agents: whose; None for all.

    Raises:
        ChoiceError: no such list, scope or agent.
    """
    listed: SampleList = samples or ("all" if setup.task == "warning" else "evaluate")
    return SampleSelection(
        split=os.fspath(split),
        samples=listed,
        scope=scope or ("all" if listed == "all" else "accident"),
        agents=None if agents is None else tuple(agents),
        horizon=setup.horizon,
    )


def evaluate_results(  # noqa: PLR0913 - of what, by which rules, on what, and where counts are kept
    dataset: Dataset,
    results: Results | str | os.PathLike[str],
    setup: EvaluationSetup,
    selection: SampleSelection | str | os.PathLike[str] = "val",
    *,
    allow_partial: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    out: str | os.PathLike[str] | None = None,
    merge: bool = False,
    progress: bool = False,
) -> EvaluationRun:
    """Evaluate a results file. It is checked wholly before any long work; any number of workers gives the same bits.

    Args:
        dataset: the release.
        results: opened, or their path.
        setup: task and rules.
        selection: which samples; the name of a split for what `default_selection` has of it.
        allow_partial: whether to evaluate the samples that are in both where the results lack some, or have others;
            if some are missing, all output is marked as partial.
        workers: processes; None takes what the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        out: the folder that the run will be saved to (`save_run`): counts are kept beside it every half minute, and a
            run that broke off goes on with them, and with those of shards, if nothing that they depend on has changed.
            None for no such file.
        merge: whether to take the counts of shards (`evaluate_shard`) alone, which have checked the results; label
            files are read for their hashes, so that counts of other labels are not taken.
        progress: whether to show bars.

    Returns:
        The run, without breakdowns: `EvaluationRun.broken_down` adds them.

    Raises:
        ResultsError: the results cannot be read, an entry is wrong, or they do not have the samples of the selection.
        EvaluationError: they are of another kind than the task is evaluated from or look less far ahead, scenarios lack
            the meta that the task needs, or samples cannot be evaluated.
        ChoiceError: no such split, or `merge` without `out`.
        NotAvailableError: the release has no such samples.
        UnfinishedError: to merge, samples are missing, or what they depend on has changed.
        WorkerError: a worker was killed, or cannot do the work.
    """
    if merge and out is None:
        raise ChoiceError("merge: expected the folder `out` of the shards, found None")
    plan = _planned(dataset, results, setup, selection, allow_partial=allow_partial)
    engine: dict[str, Any] = {"workers": workers, "executor": executor}
    if not merge:
        plan.loader.results.check(**engine, progress=progress)
    release = ReleaseInfo(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        scenarios=scenario_hashes(dataset, _scenarios(plan.tokens), **engine),
    )
    evaluator = setup.evaluator()
    if out is not None:
        _take_shards(evaluator, plan, release.scenarios, out)
    if merge:
        check_whole(plan.tokens, evaluator.tokens, out)
    else:
        checkpoint = None if out is None else plan.checkpoint(plan.tokens, release.scenarios, out)
        _evaluate(evaluator, plan.tokens, plan.loader, checkpoint, progress=progress, **engine)
    return EvaluationRun(
        setup=setup,
        selection=plan.selection,
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=_partial(plan.covered),
        left_out=len(plan.covered.extra) + len(plan.covered.unknown),
        attributes=sample_attributes(dataset, plan.tokens),
        times_to_impact={token: dataset.sample.get(token)["time_to_impact"] for token in plan.tokens},
        breakdowns=(),
        release=release,
        results=results_info(plan.loader.results),
    )


def evaluate_shard(  # noqa: PLR0913 - those of `evaluate_results`
    dataset: Dataset,
    results: Results | str | os.PathLike[str],
    setup: EvaluationSetup,
    selection: SampleSelection | str | os.PathLike[str],
    shard: Shard,
    *,
    out: str | os.PathLike[str],
    allow_partial: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> Evaluator[Any]:
    """Count the samples of every Nth scenario, and keep the counts beside `out` until a run is saved there.

    `evaluate_results(…, out=out, merge=True)` makes the run of all shards' counts. One that was killed goes on with
    those that it has kept.

    Args:
        dataset: as of `evaluate_results`, to which most arguments must be equal.
        results: likewise.
        setup: likewise.
        selection: likewise.
        shard: which part.
        out: the folder that the run will be saved to; all shards must see it.
        allow_partial: as of `evaluate_results`.
        workers: processes; None takes what the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show bars.

    Returns:
        The counts; those of no sample if there are more shards than scenarios.

    Raises:
        DeepAccidentError: as of `evaluate_results`.
    """
    plan = _planned(dataset, results, setup, selection, allow_partial=allow_partial)
    engine: dict[str, Any] = {"workers": workers, "executor": executor}
    opened = plan.loader.results
    opened.check(samples=set(_part(opened.tokens, shard)), progress=progress, **engine)
    tokens = _part(plan.tokens, shard)
    hashes = scenario_hashes(dataset, _scenarios(tokens), **engine)
    evaluator = setup.evaluator()
    _evaluate(evaluator, tokens, plan.loader, plan.checkpoint(tokens, hashes, out, shard), progress=progress, **engine)
    return evaluator


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """What is to be evaluated, as all shards and the whole find it.

    Attributes:
        loader: of the samples, with the rules.
        selection: the samples that are wanted.
        covered: those against the results.
        tokens: the samples that are evaluated.
    """

    loader: SampleLoader
    selection: SampleSelection
    covered: Coverage
    tokens: list[str]

    def checkpoint(
        self,
        tokens: Sequence[str],
        hashes: Mapping[str, ScenarioHashes],
        out: str | os.PathLike[str],
        shard: Shard | None = None,
    ) -> Path:
        """Where the counts of some of its samples are kept; `hashes` are of their scenarios' files."""
        fingerprints = {"results": self.loader.results.fingerprint, "release": fingerprint(hashes)}
        return checkpoint_path(out, self.loader.setup, tokens, fingerprints, shard=shard)


def _planned(
    dataset: Dataset,
    results: Results | str | os.PathLike[str],
    setup: EvaluationSetup,
    selection: SampleSelection | str | os.PathLike[str],
    *,
    allow_partial: bool,
) -> _Plan:
    """What is to be evaluated; raises all that can be found without long work."""
    chosen = selection if isinstance(selection, SampleSelection) else default_selection(setup, selection)
    loader = SampleLoader(dataset, results if isinstance(results, Results) else read_results(results), setup)
    covered = coverage(dataset, loader.results.tokens, chosen)
    tokens = _covered_tokens(dataset, loader.results, chosen, covered, allow_partial=allow_partial)
    if setup.task in _OF_ACCIDENTS:
        check_metas(dataset, tokens, chosen.split)
    return _Plan(loader=loader, selection=chosen, covered=covered, tokens=tokens)


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
    dataset: Dataset, results: Results, selection: SampleSelection, covered: Coverage, *, allow_partial: bool
) -> list[str]:
    if not covered.is_complete and not allow_partial:
        remedy = (
            "; give results of these samples, choose the list that they are of, or evaluate the samples that have a "
            "prediction with allow_partial=True (--allow-partial), which marks every number as partial"
        )
        raise ResultsError(f"{results.path}: {covered.to_text()}{remedy if covered.missing or covered.unknown else ''}")
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


def _partial(covered: Coverage) -> Partial | None:
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


def _scenarios(tokens: Iterable[str]) -> set[str]:
    return set(map(scenario_of, tokens))


def _part(tokens: Sequence[str], shard: Shard) -> list[str]:
    """The samples of a shard's scenarios."""
    own = set(shard.of(sorted(_scenarios(tokens))))
    return [token for token in tokens if scenario_of(token) in own]


def _take_shards(
    evaluator: Evaluator[Any], plan: _Plan, hashes: Mapping[str, ScenarioHashes], out: str | os.PathLike[str]
) -> None:
    """Take the counts of shards with the same samples, rules, predictions and labels."""
    for shard in stored_shards(out):
        tokens = _part(plan.tokens, shard)
        own = _scenarios(tokens)
        path = plan.checkpoint(tokens, {name: each for name, each in hashes.items() if name in own}, out, shard)
        counts = whole_counts(path, evaluator)
        if counts is not None:
            take_stored(evaluator, counts)


def _evaluate(
    evaluator: Evaluator[Any], tokens: Sequence[str], loader: SampleLoader, checkpoint: Path | None, **how: Any
) -> None:
    if checkpoint is not None:
        whole_counts(checkpoint, evaluator)  # a damaged one goes
    samples = {token: token for token in tokens}
    evaluate_samples(evaluator, samples, loader, checkpoint=checkpoint, places=loader.places, **how)
