"""Prevented accidents: which collisions braking after the alarms would have avoided.

Computes figures and tables from the counts of warnings. `PREVENTED` is what evaluations know of
this result (`evaluation.runs.further`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.outcomes import OUTCOMES, outcomes_of, undisturbed
from deepaccident_devkit.collisions.recorded import Accident, Skipped, accident_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.further import ExtraResult, Json, with_further
from deepaccident_devkit.evaluation.runs.text import number_text
from deepaccident_devkit.evaluation.warning import (
    WARNING_PROTOCOLS,
    CleanWarnings,
    WarningEvaluator,
)
from deepaccident_devkit.evaluation.warning.anticipation import (
    LATENCIES,
    draws_of,
    mean_of,
    reference_threshold,
)
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN,
    PREDICTORS,
    TRIVIAL,
    UNPLACED,
    Recording,
    ScoresOf,
    by_group,
    parts_of,
    recordings_of,
)
from deepaccident_devkit.plugins.safety.prevention_result import (
    BUDGET,
    NOMINAL,
    SETTINGS,
    AccidentOutcomes,
    AlarmOutcomes,
    OutcomeTable,
    PreventedResult,
    PreventionCurve,
    PreventionFigures,
)
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.parallel import Places, in_order, run_unordered
from deepaccident_devkit.support.reports import Table
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.render.evaluation.figures import RunFigure
    from deepaccident_devkit.support.parallel import Engine

# Suffix of the name of a group of accidents with a pedestrian.
_PEDESTRIAN_SUFFIX: Final = ", pedestrian"
# Suffix of a random predictor at the threshold that costs at most one braking second a minute.
_QUIET_SUFFIX: Final = ", quiet"
# Shares of the accidents: each class of outcome, avoided by lasting alarms, with an alarm, and with
# a contact only after the recording; and the cost.
_COLUMNS: Final = (*OUTCOMES, "if lasting", "warned", "after end", "braking s/min")
# Kind of alarm that warns → its name in tables, and the scores that raise it.
_ALARM_KINDS: Final[Mapping[str, tuple[str, ScoresOf]]] = {
    "right": ("right alarms", "pair"),
    "any_alarm": ("any alarm", "recording"),
}
# Key of a latency of zero seconds in the JSON of a result.
_ZERO_LATENCY: Final = "0"
FramesByAgent = Mapping[str, Sequence[int]]
"""Agent → frame numbers of its samples."""


def prevented_accidents(
    dataset: Dataset,
    evaluator: Evaluator[Any],
    **engine: Unpack[Engine],
) -> PreventedResult:
    """Return the accidents that braking after alarms prevents, and the cost of false alarms.

    If the alarm is of an agent of the colliding pair, only this agent brakes. Any other agent warns
    both of the pair, after a latency.

    Args:
        dataset: Release that the samples belong to.
        evaluator: `WarningEvaluator` of the protocol `clean` that has counted the samples.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        EvaluationError: The evaluator is of another task or protocol.
        TokenError: A sample belongs to no scenario of the release.
        WorkerError: A worker was killed, or cannot do the work.
    """
    return prevention_evaluator(dataset, evaluator, **engine).compute()


def with_prevented(
    run: EvaluationRun,
    dataset: Dataset,
    resampling: Resampling | None = None,
    **engine: Unpack[Engine],
) -> EvaluationRun:
    """Return the run with the accidents that its alarms would have prevented, and their intervals.

    Args:
        run: Evaluation of warnings, protocol `clean`.
        dataset: Release that the run evaluates.
        resampling: How intervals are made, an accident and its twin together; None for the
            defaults.
        **engine: `workers` (1 by default), `executor` and `progress`; see `parallel.Engine`.

    Raises:
        EvaluationError: The run is of another task or protocol.
        WorkerError: A worker was killed, or cannot do the work.
    """
    return with_further(run, "prevented", dataset, resampling, **engine)


def prevention_evaluator(
    dataset: Dataset, evaluator: Evaluator[Any], **engine: Unpack[Engine]
) -> PreventedEvaluator:
    """Return an evaluator of prevented accidents with the same counts (`prevented_accidents`)."""
    protocol = getattr(evaluator, "protocol", None)
    if not isinstance(protocol, CleanWarnings):
        raise EvaluationError(
            "evaluator: prevented accidents need one of warnings, protocol clean, which scores "
            "whole recordings; "
            f"found {evaluator!r} with the protocol {type(protocol).__name__}"
        )
    counts = evaluator.counts
    frames: dict[str, dict[str, list[int]]] = {}
    for token in sorted(evaluator.tokens):
        sample = counts[token]
        if sample["kind"] in ("accident", UNPLACED):  # notes say why an unplaced one is not judged
            scenario, _, agent = sample["recording"].rpartition("/")
            frames.setdefault(scenario, {}).setdefault(agent, []).append(sample["frame"])
    outcomes = accident_outcomes(dataset, frames, **engine)
    prevention = PreventedEvaluator(outcomes, protocol)
    for token in evaluator.tokens:
        prevention.add(token, counts[token])
    return prevention


def accident_outcomes(
    dataset: Dataset,
    frames: Mapping[str, FramesByAgent],
    **engine: Unpack[Engine],
) -> AccidentOutcomes:
    """Replay accidents for each frame at which an agent can raise its first alarm.

    The result is the same to the bit for any number of workers.

    Args:
        dataset: Release with the accidents.
        frames: Scenario → agent → frame numbers of its samples, for agents with judged alarms.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: The release has no such scenario.
        WorkerError: A worker was killed, or cannot do the work.
    """
    work = partial(_scenario_outcomes, dataset)
    places = Places(reads=dataset.places)
    scenarios = sorted(frames.items())
    results = run_unordered(work, scenarios, label="braking", places=places, **engine)
    parts = list(in_order(results))
    tables: dict[str, OutcomeTable] = {}
    for part in parts:
        tables.update(part.tables)
    return AccidentOutcomes(
        tables=tables,
        dropped=tuple(chain.from_iterable(part.dropped for part in parts)),
        skipped=tuple(chain.from_iterable(part.skipped for part in parts)),
    )


def _scenario_outcomes(dataset: Dataset, item: tuple[str, FramesByAgent]) -> AccidentOutcomes:
    """Return the outcomes of one scenario, given as its token and the frames of its agents."""
    scenario, agents = item
    try:
        accident = accident_of(dataset, scenario)
    except NotAvailableError as error:
        return AccidentOutcomes(skipped=(Skipped(scenario=scenario, reason=str(error)),))
    if accident is None:
        reason = "its meta file names no collision"
        return AccidentOutcomes(skipped=(Skipped(scenario=scenario, reason=reason),))
    check = undisturbed(accident)
    if not check.usable:
        fault = "no contact"
        if check.collides:
            fault = f"{check.margin:.2f} m between the two at its last frame"
        reason = f"the recording does not show the impact: {fault}, though nobody brakes"
        return AccidentOutcomes(dropped=(Skipped(scenario=scenario, reason=reason),))
    agent_frames = [np.array(frames, dtype=np.int64) for frames in agents.values()]
    frame = np.unique(np.concatenate(agent_frames))
    pair = accident.agents
    roles = {agent: (pair[0] == agent, pair[1] == agent) for agent in sorted(agents)}
    table_by_role = {
        role: _outcome_table(accident, role, frame) for role in dict.fromkeys(roles.values())
    }
    tables = {f"{scenario}/{agent}": table_by_role[role] for agent, role in roles.items()}
    return AccidentOutcomes(tables=tables)


def _outcome_table(accident: Accident, role: tuple[bool, bool], frame: IntArray) -> OutcomeTable:
    """Return the table of an agent, given whether it is the first and the second of the pair.

    If it is neither, both brake, warned after some latency. A driver warned before the first frame
    that shows both vehicles brakes from that frame on, at the earliest.
    """
    seconds = (frame - accident.first_frame) * FRAME_PERIOD
    brakers = (True, True)
    latencies: tuple[float, ...] = LATENCIES
    if any(role):
        brakers, latencies = role, LATENCIES[:1]
    first_alarms = np.append(seconds, np.nan)
    outcomes = [
        outcomes_of(accident, brakers, first_alarms, latency=latency) for latency in latencies
    ]
    return OutcomeTable(
        frame=frame,
        outcome=np.stack([part.outcome for part in outcomes]).astype(np.int8),
        extrapolated=np.stack([part.extrapolated for part in outcomes]),
        latencies=latencies,
        pedestrian="pedestrian" in accident.categories,
    )


class PreventedEvaluator(Evaluator[PreventedResult]):
    """The counts of a `WarningEvaluator` of the protocol `clean`, scored as prevented accidents.

    `compute` returns a `PreventedResult`. `prevented_accidents` replays the accidents and takes
    over the counts.
    """

    protocols = WARNING_PROTOCOLS
    result_class = PreventedResult

    def __init__(self, outcomes: AccidentOutcomes, protocol: str | CleanWarnings = "clean") -> None:
        """Start without samples.

        Args:
            outcomes: How each accident ends, by the frame of the first alarm.
            protocol: `clean`, or your own of its kind.

        Raises:
            EvaluationError: The protocol is another one, which has no recordings with scores.
            ChoiceError: No protocol has that name.
        """
        super().__init__(protocol)
        if not isinstance(self.protocol, CleanWarnings):
            raise EvaluationError(
                "protocol: prevented accidents are counted by the protocol clean, found "
                f"{type(self.protocol).__name__}"
            )
        self._outcomes = outcomes

    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample, as `WarningEvaluator.update` does; raises EvaluationError."""
        warnings = WarningEvaluator(self.protocol)
        warnings.update(token, *arguments)
        self.add(token, warnings.counts[token])

    def result_of(self, counts: Collection[Counts]) -> PreventedResult:
        """Return the figures of counts, in any order, without references and curves."""
        return self._result(parts_of(counts), references=False)

    def compute(self, tokens: Iterable[str] | None = None) -> PreventedResult:
        """Return the figures of all samples, with references and curves; or of some, without."""
        if tokens is not None:
            return super().compute(tokens)
        return self._result(parts_of(list(self._counts.values())), references=True)

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[PreventedResult]:
        """Yield the result of each draw, without references and curves."""
        groups = dict(self._recording_groups(recordings_of(parts)))
        outcomes_by_group = {
            group: self._alarm_outcomes(recordings, GIVEN) for group, recordings in groups.items()
        }
        for draw in times:
            figures = {
                group: self._prediction_figures(outcomes, draw)
                for group, outcomes in outcomes_by_group.items()
            }
            yield self._to_result({GIVEN: figures})

    def _result(self, parts: Sequence[Collection[Counts]], *, references: bool) -> PreventedResult:
        groups = dict(self._recording_groups(recordings_of(parts)))
        outcomes_by_group = {
            group: self._alarm_outcomes(recordings, GIVEN) for group, recordings in groups.items()
        }
        predictions = {
            group: self._prediction_figures(outcomes)
            for group, outcomes in outcomes_by_group.items()
        }
        by_predictor = {GIVEN: predictions}
        if not references:
            return self._to_result(by_predictor, tuple(self._notes(predictions)))
        for group, recordings in groups.items():
            for name, figures in self._reference_figures(recordings):
                by_predictor.setdefault(name, {})[group] = figures
        curves = {
            group: outcomes[self._alarm_kind].curve()
            for group, outcomes in outcomes_by_group.items()
        }
        return self._to_result(by_predictor, tuple(self._notes(predictions)), curves)

    def _to_result(
        self,
        by_predictor: Mapping[str, Mapping[str, PreventionFigures]],
        notes: tuple[str, ...] = (),
        curves: Mapping[str, PreventionCurve] | None = None,
    ) -> PreventedResult:
        references = {name: groups for name, groups in by_predictor.items() if name != GIVEN}
        return PreventedResult(
            operating_by="budget" if self.protocol.threshold is None else "given",
            alarms=self._alarm_kind,
            groups=by_predictor[GIVEN],
            references=references,
            curves=curves or {},
            dropped=self._outcomes.dropped,
            skipped=self._outcomes.skipped,
            notes=notes,
        )

    @property
    def _alarm_kind(self) -> str:
        """The kind of alarm that the protocol scores.

        A predictor that names nobody has no right alarms.
        """
        return next(
            kind
            for kind, (_, scores_of) in _ALARM_KINDS.items()
            if scores_of == self.protocol.scores_of
        )

    def _recording_groups(
        self, recordings: Sequence[Recording]
    ) -> Iterator[tuple[str, list[Recording]]]:
        """Yield each group and its recordings; accidents of pedestrians have groups of their own.

        Recordings without an accident belong to both groups.
        """
        tables = self._outcomes.tables
        for group, members in by_group(recordings):
            with_pedestrian = {
                recording.name
                for recording in members
                if recording.name in tables and tables[recording.name].pedestrian
            }
            yield (
                group,
                [recording for recording in members if recording.name not in with_pedestrian],
            )
            if with_pedestrian:
                pedestrian_members = [
                    recording
                    for recording in members
                    if recording.kind != "accident" or recording.name in with_pedestrian
                ]
                yield f"{group}{_PEDESTRIAN_SUFFIX}", pedestrian_members

    def _alarm_outcomes(
        self, recordings: Sequence[Recording], predictor: str, draw: int = 0
    ) -> Mapping[str, AlarmOutcomes]:
        """Return the outcomes by kind of alarm, for a predictor's scores of some recordings."""
        tables = self._outcomes.tables
        right = AlarmOutcomes(recordings, predictor, "pair", tables, draw)
        if predictor in TRIVIAL:
            return {"right": right, "any_alarm": right}
        any_alarm = AlarmOutcomes(recordings, predictor, "recording", tables, draw)
        return {"right": right, "any_alarm": any_alarm}

    def _prediction_figures(
        self, outcomes: Mapping[str, AlarmOutcomes], draw: IntArray | None = None
    ) -> PreventionFigures:
        """Return the figures of the predictions; a recording weighs as often as it is drawn."""
        scored = outcomes[self._alarm_kind]
        if draw is None:
            weight = np.ones(len(scored.part))
        else:
            weight = draw[scored.part].astype(np.float64)
        quiet = scored.quiet_braking(weight)
        threshold = quiet if self.protocol.threshold is None else self.protocol.threshold
        return self._figures(outcomes, threshold, quiet, weight)

    def _figures(
        self,
        outcomes: Mapping[str, AlarmOutcomes],
        threshold: float,
        quiet: float,
        weight: FloatArray,
    ) -> PreventionFigures:
        scored = outcomes[self._alarm_kind]
        figures_by_alarm = {kind: part.ends(threshold, weight) for kind, part in outcomes.items()}
        return PreventionFigures(
            threshold=threshold,
            quiet_braking=quiet,
            accidents=int(weight[scored.accident].sum()),
            recordings=int(weight[scored.normal].sum()),
            minutes=scored.minutes(weight),
            lasting=scored.ends(threshold, weight, lasting=True),
            **figures_by_alarm,
        )

    def _reference_figures(
        self, recordings: Sequence[Recording]
    ) -> Iterator[tuple[str, PreventionFigures]]:
        """Yield each reference predictor and its figures.

        A random predictor has the means over its draws, also at the threshold within the budget.
        """
        weight = np.ones(len(recordings))
        for predictor in PREDICTORS[1:]:
            fixed = reference_threshold(predictor)
            if draws_of(predictor) == 1:
                outcomes = self._alarm_outcomes(recordings, predictor)
                yield predictor, self._figures(outcomes, fixed, math.nan, weight)
                continue
            draws = [
                self._alarm_outcomes(recordings, predictor, draw)
                for draw in range(draws_of(predictor))
            ]
            quiet = [outcomes[self._alarm_kind].quiet_braking(weight) for outcomes in draws]
            variants = ((predictor, [fixed] * len(draws)), (f"{predictor}{_QUIET_SUFFIX}", quiet))
            for name, thresholds in variants:
                figures = [
                    self._figures(*settings, weight)
                    for settings in zip(draws, thresholds, quiet, strict=True)
                ]
                yield name, _mean_figures(figures)

    def _notes(self, groups: Mapping[str, PreventionFigures]) -> Iterator[str]:
        for group, figures in groups.items():
            if not figures.accidents:
                yield (
                    f"{group}: no accident is judged, so that no share prevented is known; give "
                    "accident scenarios"
                )
            if not figures.recordings:
                yield (
                    f"{group}: no recording without an accident, so that no braking for nothing is "
                    "known; give some"
                )
        if groups:
            yield (
                "an alarm that is over before the driver brakes costs nothing, but counts as a "
                "warning: compare with "
                "'random per frame, quiet', and with the share 'if lasting', where alarms must "
                "outlast the reaction"
            )
        if groups and self.protocol.threshold is None:
            yield (
                f"the threshold is the lowest with at most {BUDGET:g} braking second a minute on "
                "these very "
                "recordings, which flatters; take it from another split, evaluated with "
                "--prevented: --threshold-from "
                "BUNDLE --threshold-by braking"
            )
        for verdict, left_out in (
            ("the self-check drops", self._outcomes.dropped),
            ("not judged", self._outcomes.skipped),
        ):
            for skipped in left_out:
                yield f"{verdict} {skipped.scenario}: {skipped.reason}"


def _mean_figures(draws: Sequence[PreventionFigures]) -> PreventionFigures:
    """Return the means over draws, which have no counts."""
    figures: PreventionFigures = mean_of(draws)
    replaced: dict[str, Any] = {}
    for kind in (*_ALARM_KINDS, "lasting"):
        replaced[kind] = {
            latency: {setting: replace(outcome, counts={}) for setting, outcome in settings.items()}
            for latency, settings in getattr(figures, kind).items()
        }
    return replace(figures, **replaced)


def prevention_tables(prevented: Json) -> list[Table]:
    """Return two tables for each group of recordings.

    One compares the predictors at the nominal setting, the other has the predictions at all
    settings.
    """
    tables = []
    alarms = prevented["alarms"]
    for group, predictions in prevented["groups"].items():
        figures_by_predictor = {GIVEN: predictions}
        for name, groups in prevented["references"].items():
            figures_by_predictor[name] = groups[group]
        head = (f"{group}, {NOMINAL}", *_COLUMNS)
        predictor_rows = _predictor_rows(alarms, figures_by_predictor)
        notes = tuple(_group_notes(prevented, group, predictions))
        setting_rows = [(name, *_cells(predictions, alarms, setting=name)) for name in SETTINGS]
        tables += [
            Table((head, *predictor_rows), notes),
            Table(((f"{group}, {GIVEN}", *_COLUMNS), *setting_rows)),
        ]
    return tables


def _predictor_rows(
    alarms: str, figures_by_predictor: Mapping[str, Json]
) -> Iterator[tuple[str, ...]]:
    """Yield a row for each predictor; the evaluated one also with other alarms and each latency."""
    for name, figures in figures_by_predictor.items():
        yield name, *_cells(figures, alarms)
        if name == GIVEN:
            for latency in figures[alarms]:
                if latency != _ZERO_LATENCY:
                    yield f"{name}, {latency} s later", *_cells(figures, alarms, latency)
            (other,) = _ALARM_KINDS.keys() - {alarms}
            yield f"{name}, {_ALARM_KINDS[other][0]}", *_cells(figures, other, lasting=None)


def _cells(
    prediction: Json,
    alarms: str,
    latency: str = _ZERO_LATENCY,
    setting: str = NOMINAL,
    lasting: str | None = "lasting",
) -> Iterator[str]:
    """Yield the cells of `_COLUMNS` for one predictor, latency and setting."""
    figures = prediction[alarms][latency][setting]
    avoided = None
    if lasting is not None:
        avoided = prediction[lasting][latency][setting]["shares"][OUTCOMES[0]]
    yield from map(number_text, (*figures["shares"].values(), avoided))
    for name in ("warned", "extrapolated", "braking_seconds_per_minute"):
        yield number_text(figures[name])


def _group_notes(prevented: Json, group: str, predictions: Json) -> Iterator[str]:
    """Yield what is avoided in a group, and at which threshold."""
    threshold, quiet = predictions["threshold"], predictions["quiet_braking"]
    threshold_text = "none" if threshold is None else f"{threshold:.4g}"
    quiet_text = "–" if quiet is None else f"{quiet:.4g}"
    origin = "given"
    if prevented["operating_by"] != "given":
        origin = "at most 1 braking s/min on these recordings"
    figures = predictions[prevented["alarms"]][_ZERO_LATENCY][NOMINAL]
    lasting = predictions["lasting"][_ZERO_LATENCY][NOMINAL]
    path = f"groups/{group}/{prevented['alarms']}/{_ZERO_LATENCY}/{NOMINAL}/shares/{OUTCOMES[0]}"
    ends = prevented["intervals"].get(path)
    interval = "" if not ends or None in ends else f" [{ends[0]:.3f}, {ends[1]:.3f}]"
    yield (
        f"avoided: {number_text(figures['shares'][OUTCOMES[0]])}{interval} of "
        f"{predictions['accidents']} accidents "
        f"({number_text(lasting['shares'][OUTCOMES[0]])} by alarms that outlast the reaction), for "
        f"{number_text(figures['braking_seconds_per_minute'])} braking seconds a minute in "
        f"{predictions['minutes']:.1f} min "
        f"of {predictions['recordings']} recordings without an accident"
    )
    yield f"threshold {threshold_text} ({origin}); for another split: braking {quiet_text}"


def _figures(result: PreventedResult) -> Iterator[RunFigure]:
    """Return the figures of a result, drawn as they are asked for."""
    # Imported here because it imports matplotlib.
    from deepaccident_devkit.plugins.safety.prevention_figures import prevention_figures

    return prevention_figures(result)


PREVENTED: Final = ExtraResult(
    title="prevented accidents",
    evaluator=prevention_evaluator,
    tables=prevention_tables,
    figures=_figures,
)
