"""Prevented accidents: which collisions the drivers avoid if they brake when an alarm is raised.

Figures and tables are computed from the counts of a warning evaluation. `PREVENTED` registers this
result with evaluations (`evaluation.runs.further`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
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
from deepaccident_devkit.evaluation.runs.text import table_number_text
from deepaccident_devkit.evaluation.warning import (
    WARNING_PROTOCOLS,
    CleanWarnings,
    WarningEvaluator,
)
from deepaccident_devkit.evaluation.warning.anticipation import (
    LATENCIES,
    draws_of,
    mean_of_records,
    reference_threshold,
)
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN_SCORES,
    PREDICTORS,
    TRIVIAL,
    UNPLACED,
    Recording,
    ScoresOf,
    group_recordings,
    recordings_of,
    split_counts,
)
from deepaccident_devkit.plugins.safety.prevention_result import (
    BUDGET,
    NOMINAL,
    SETTINGS,
    AccidentOutcomes,
    AlarmOutcomes,
    OutcomeTable,
    PreventedResult,
    PreventionFigures,
)
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.human_names import heading_name, human_name
from deepaccident_devkit.support.parallel import Places, in_order, run_unordered
from deepaccident_devkit.support.reports import Table
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.render.evaluation.figures import RunFigure
    from deepaccident_devkit.support.parallel import Engine

# Suffix of the group names for accidents with a pedestrian.
_PEDESTRIAN_SUFFIX = ", pedestrian"
# Suffix of the name of a random predictor whose threshold costs at most one braking second per
# minute.
_QUIET_SUFFIX = ", quiet"
# Last columns of the tables: share with an alarm, share with contact only after the recording, and
# the cost. Before them are the shares with each outcome, and the share avoided by lasting alarms.
_LAST_COLUMNS = ("warned", "extrapolated", "braking_seconds_per_minute")
# Kind of alarm that warns the drivers → its name in tables, and the scores that trigger it.
_ALARM_KINDS: Mapping[str, tuple[str, ScoresOf]] = {
    "right": ("right alarms", "pair"),
    "any_alarm": ("any alarm", "recording"),
}
# JSON key of the latency of zero seconds.
_ZERO_LATENCY = "0"
FramesByAgent = Mapping[str, Sequence[int]]
"""Agent → frame numbers of its evaluated samples."""


def prevented_accidents(
    dataset: Dataset,
    evaluator: Evaluator[Any],
    **engine: Unpack[Engine],
) -> PreventedResult:
    """Compute which accidents braking after the alarms prevents, and the cost of false alarms.

    If the agent that raises the alarm is one of the two colliders, only that agent brakes. An alarm
    of any other agent warns both colliders, after a latency.

    Args:
        dataset: Release that contains the samples.
        evaluator: `WarningEvaluator` with the protocol `clean`, after it has counted the samples.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        EvaluationError: If the evaluator is for another task or protocol.
        TokenError: If a sample belongs to no scenario in the release.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    return prevention_evaluator(dataset, evaluator, **engine).compute()


def with_prevented(
    run: EvaluationRun,
    dataset: Dataset,
    resampling: Resampling | None = None,
    **engine: Unpack[Engine],
) -> EvaluationRun:
    """Add to a run which accidents its alarms would have prevented, with bootstrap intervals.

    Args:
        run: Evaluation of warnings with the protocol `clean`.
        dataset: Release on which the run was evaluated.
        resampling: How intervals are computed, with each accident and its twin drawn together; None
            for the defaults.
        **engine: `workers` (1 by default), `executor` and `progress`; see `parallel.Engine`.

    Raises:
        EvaluationError: If the run is for another task or protocol.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    return with_further(run, "prevented", dataset, resampling, **engine)


def prevention_evaluator(
    dataset: Dataset, evaluator: Evaluator[Any], **engine: Unpack[Engine]
) -> PreventedEvaluator:
    """Build an evaluator of prevented accidents from the counts of a warning evaluator."""
    protocol = getattr(evaluator, "protocol", None)
    if not isinstance(protocol, CleanWarnings):
        raise EvaluationError(
            "evaluator: prevented accidents need an evaluator of warnings with the protocol "
            f"clean, which scores whole recordings; found {evaluator!r} with the protocol "
            f"{type(protocol).__name__}"
        )
    counts = evaluator.counts
    frames: dict[str, dict[str, list[int]]] = {}
    for token in sorted(evaluator.tokens):
        sample = counts[token]
        if sample["kind"] in ("accident", UNPLACED):  # notes say why an unplaced one is not judged
            scenario, _, agent = sample["recording"].rpartition("/")
            frames_by_agent = frames.setdefault(scenario, {})
            frames_by_agent.setdefault(agent, []).append(sample["frame"])
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
    """Replay accidents for each frame in which an agent can raise its first alarm.

    The results are bit-identical for any number of workers.

    Args:
        dataset: Release that contains the accidents.
        frames: Scenario → agent → frame numbers of the agent's samples, for the agents whose alarms
            are judged.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    work = partial(_scenario_outcomes, dataset)
    places = Places(reads=dataset.places)
    scenarios = sorted(frames.items())
    results = run_unordered(work, scenarios, label="Replaying accidents", places=places, **engine)
    tables: dict[str, OutcomeTable] = {}
    dropped: list[Skipped] = []
    skipped: list[Skipped] = []
    for outcomes in in_order(results):
        tables.update(outcomes.tables)
        dropped += outcomes.dropped
        skipped += outcomes.skipped
    return AccidentOutcomes(tables=tables, dropped=tuple(dropped), skipped=tuple(skipped))


def _scenario_outcomes(dataset: Dataset, item: tuple[str, FramesByAgent]) -> AccidentOutcomes:
    """Replay one scenario; `item` is its token, and the frame numbers of each agent's samples."""
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
    first, second = accident.agents
    table_by_role: dict[tuple[bool, bool], OutcomeTable] = {}
    tables = {}
    for agent in sorted(agents):
        role = (agent == first, agent == second)
        if role not in table_by_role:
            table_by_role[role] = _make_table(accident, role, frame)
        tables[f"{scenario}/{agent}"] = table_by_role[role]
    return AccidentOutcomes(tables=tables)


def _make_table(accident: Accident, role: tuple[bool, bool], frame: IntArray) -> OutcomeTable:
    """Replay an accident for each possible first alarm of an agent.

    If the agent is not one of the two colliders, both brake, after a latency. A driver who is
    warned before both vehicles appear in the recording brakes from their first common frame.

    Args:
        accident: The accident.
        role: Whether the agent is the first collider, and whether it is the second.
        frame: Frame numbers of possible first alarms, shape (W,).
    """
    seconds = (frame - accident.first_frame) * FRAME_PERIOD
    first_alarms = np.append(seconds, np.nan)  # NaN for no alarm
    brakers = (True, True)
    latencies: tuple[float, ...] = LATENCIES
    if any(role):
        brakers = role
        latencies = LATENCIES[:1]
    outcome = []
    extrapolated = []
    for latency in latencies:
        outcomes = outcomes_of(accident, brakers, first_alarms, latency=latency)
        outcome.append(outcomes.outcome)
        extrapolated.append(outcomes.extrapolated)
    return OutcomeTable(
        frame=frame,
        outcome=np.stack(outcome).astype(np.int8),
        extrapolated=np.stack(extrapolated),
        latencies=latencies,
        pedestrian="pedestrian" in accident.categories,
    )


class PreventedEvaluator(Evaluator[PreventedResult]):
    """Evaluator of prevented accidents that counts like `WarningEvaluator` with protocol `clean`.

    `prevention_evaluator` replays the accidents, and copies the counts of a warning evaluator.
    """

    protocols = WARNING_PROTOCOLS
    result_class = PreventedResult

    def __init__(self, outcomes: AccidentOutcomes, protocol: str | CleanWarnings = "clean") -> None:
        """Start without any samples.

        Args:
            outcomes: Outcomes of each accident, by frame of the first alarm.
            protocol: `clean`, or a protocol of the same class.

        Raises:
            EvaluationError: If the protocol does not store scores by recording.
            ChoiceError: If no protocol has that name.
        """
        super().__init__(protocol)
        if not isinstance(self.protocol, CleanWarnings):
            raise EvaluationError(
                "protocol: prevented accidents are counted by the protocol clean, found "
                f"{type(self.protocol).__name__}"
            )
        self._outcomes = outcomes

    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample like `WarningEvaluator.update`, with the same EvaluationErrors."""
        warnings = WarningEvaluator(self.protocol)
        warnings.update(token, *arguments)
        self.add(token, warnings.counts[token])

    def result_of(self, counts: Collection[Counts]) -> PreventedResult:
        """Compute the figures from counts in any order, without references and curves."""
        return self._result(split_counts(counts), references=False)

    def compute(self, tokens: Iterable[str] | None = None) -> PreventedResult:
        """Compute the figures of `tokens`; if None, of all samples, with references and curves."""
        if tokens is not None:
            return super().compute(tokens)
        return self._result(split_counts(list(self._counts.values())), references=True)

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[PreventedResult]:
        """Yield the result of each bootstrap draw, without references and curves."""
        outcomes_by_group = {}
        for group, recordings in self._recording_groups(recordings_of(parts)):
            outcomes_by_group[group] = self._alarm_outcomes(recordings, GIVEN_SCORES)
        for draw in times:
            figures_by_group = {}
            for group, outcomes in outcomes_by_group.items():
                figures_by_group[group] = self._prediction_figures(outcomes, draw)
            yield self._make_result(figures_by_group)

    def _result(self, parts: Sequence[Collection[Counts]], *, references: bool) -> PreventedResult:
        """Compute the figures of samples, with references and curves if `references` is true."""
        predictions = {}
        reference_figures: dict[str, dict[str, PreventionFigures]] = {}
        curves = {}
        for group, recordings in self._recording_groups(recordings_of(parts)):
            outcomes = self._alarm_outcomes(recordings, GIVEN_SCORES)
            predictions[group] = self._prediction_figures(outcomes)
            if references:
                curves[group] = outcomes[self._alarm_kind].curve()
                for name, figures in self._reference_figures(recordings):
                    reference_figures.setdefault(name, {})[group] = figures
        return self._make_result(
            predictions,
            references=reference_figures,
            curves=curves,
            notes=tuple(self._notes(predictions)),
        )

    def _make_result(
        self, groups: Mapping[str, PreventionFigures], **parts: Any
    ) -> PreventedResult:
        """Return the result with the predictions' figures by group; `parts` has other fields."""
        return PreventedResult(
            operating_by="budget" if self.protocol.threshold is None else "given",
            alarms=self._alarm_kind,
            groups=groups,
            dropped=self._outcomes.dropped,
            skipped=self._outcomes.skipped,
            **{"references": {}, "curves": {}, **parts},
        )

    @property
    def _alarm_kind(self) -> str:
        """The kind of alarm that the protocol scores: `right` or `any_alarm`."""
        kinds = {scores_of: kind for kind, (_, scores_of) in _ALARM_KINDS.items()}
        return kinds[self.protocol.scores_of]

    def _recording_groups(
        self, recordings: Sequence[Recording]
    ) -> Iterator[tuple[str, list[Recording]]]:
        """Yield each group's name and recordings; accidents with pedestrians form separate groups.

        Recordings without an accident are in both the group and its pedestrian counterpart.
        """
        for group, members in group_recordings(recordings):
            vehicle_members = []
            pedestrian_members = []
            has_pedestrian = False
            for recording in members:
                table = self._outcomes.tables.get(recording.name)
                is_pedestrian = table is not None and table.pedestrian
                has_pedestrian |= is_pedestrian
                if not is_pedestrian:
                    vehicle_members.append(recording)
                if is_pedestrian or recording.kind != "accident":
                    pedestrian_members.append(recording)
            yield group, vehicle_members
            if has_pedestrian:
                yield f"{group}{_PEDESTRIAN_SUFFIX}", pedestrian_members

    def _alarm_outcomes(
        self, recordings: Sequence[Recording], predictor: str, draw: int = 0
    ) -> Mapping[str, AlarmOutcomes]:
        """Return the outcomes in some recordings for each kind of alarm that a predictor raises."""
        tables = self._outcomes.tables
        right = AlarmOutcomes(recordings, predictor, "pair", tables, draw)
        any_alarm = right
        if predictor not in TRIVIAL:
            any_alarm = AlarmOutcomes(recordings, predictor, "recording", tables, draw)
        return {"right": right, "any_alarm": any_alarm}

    def _prediction_figures(
        self, outcomes: Mapping[str, AlarmOutcomes], draw: IntArray | None = None
    ) -> PreventionFigures:
        """Compute the figures of the predictions.

        Args:
            outcomes: Outcomes by kind of alarm.
            draw: How often each group of samples is drawn; None if each is used once.
        """
        scored = outcomes[self._alarm_kind]
        weight = np.ones(len(scored.part))
        if draw is not None:
            weight *= draw[scored.part]
        quiet = scored.quiet_braking(weight)
        threshold = self.protocol.threshold
        if threshold is None:
            threshold = quiet
        return self._figures(outcomes, threshold, quiet, weight)

    def _figures(
        self,
        outcomes: Mapping[str, AlarmOutcomes],
        threshold: float,
        quiet: float,
        weight: FloatArray,
    ) -> PreventionFigures:
        """Compute the figures at one threshold.

        Args:
            outcomes: Outcomes by kind of alarm.
            threshold: Lowest score that counts as an alarm.
            quiet: Lowest threshold whose cost is within the budget.
            weight: Weight of each recording, shape (N,).
        """
        scored = outcomes[self._alarm_kind]
        return PreventionFigures(
            threshold=threshold,
            quiet_braking=quiet,
            accidents=int(weight[scored.accident].sum()),
            recordings=int(weight[scored.normal].sum()),
            minutes=scored.minutes(weight),
            right=outcomes["right"].ends(threshold, weight),
            any_alarm=outcomes["any_alarm"].ends(threshold, weight),
            lasting=scored.ends(threshold, weight, lasting=True),
        )

    def _reference_figures(
        self, recordings: Sequence[Recording]
    ) -> Iterator[tuple[str, PreventionFigures]]:
        """Yield the name and figures of each reference predictor.

        The figures of a random predictor are means over its draws: first at its own threshold, then
        at the threshold of each draw that is within the budget.
        """
        weight = np.ones(len(recordings))
        for predictor in PREDICTORS[1:]:
            threshold = reference_threshold(predictor)
            if draws_of(predictor) == 1:
                outcomes = self._alarm_outcomes(recordings, predictor)
                yield predictor, self._figures(outcomes, threshold, math.nan, weight)
                continue
            figures = []
            quiet_figures = []
            for draw in range(draws_of(predictor)):
                outcomes = self._alarm_outcomes(recordings, predictor, draw)
                quiet = outcomes[self._alarm_kind].quiet_braking(weight)
                figures.append(self._figures(outcomes, threshold, quiet, weight))
                quiet_figures.append(self._figures(outcomes, quiet, quiet, weight))
            yield predictor, _mean_figures(figures)
            yield f"{predictor}{_QUIET_SUFFIX}", _mean_figures(quiet_figures)

    def _notes(self, groups: Mapping[str, PreventionFigures]) -> Iterator[str]:
        """Yield the sentences that a reader of the figures needs to know."""
        for group, figures in groups.items():
            group_name = human_name(group)
            if not figures.accidents:
                yield (
                    f"{group_name}: no accident can be judged, so the share of prevented accidents "
                    "is unknown; also evaluate accident scenarios"
                )
            if not figures.recordings:
                yield (
                    f"{group_name}: no recording without an accident, so the braking for false "
                    "alarms is unknown; also evaluate normal scenarios"
                )
        if groups:
            yield (
                "an alarm that is over before the driver brakes costs nothing, but counts as a "
                "warning: compare with 'random per frame, ≤ 1 s/min', and with the share "
                "'if lasting', where alarms must outlast the reaction"
            )
        if groups and self.protocol.threshold is None:
            yield (
                f"the threshold is the lowest with at most {BUDGET:g} s of braking per minute on "
                "these very recordings, so the numbers are too good; take the threshold from "
                "another split that was evaluated with --prevented: --threshold-from BUNDLE "
                "--threshold-by braking"
            )
        for dropped in self._outcomes.dropped:
            yield f"the self-check drops {dropped.scenario}: {dropped.reason}"
        for skipped in self._outcomes.skipped:
            yield f"not judged {skipped.scenario}: {skipped.reason}"


def _mean_figures(draws: Sequence[PreventionFigures]) -> PreventionFigures:
    """Average figures over draws; counts are left empty."""
    figures: PreventionFigures = mean_of_records(draws)
    without_counts: NamedValues = {}
    for kind in (*_ALARM_KINDS, "lasting"):
        by_latency: dict[float, NamedValues] = {}
        for latency, by_setting in getattr(figures, kind).items():
            by_latency[latency] = {}
            for setting, outcome in by_setting.items():
                by_latency[latency][setting] = replace(outcome, counts={})
        without_counts[kind] = by_latency
    return replace(figures, **without_counts)


def prevention_tables(prevented: Json) -> list[Table]:
    """Return two tables per group of recordings.

    One compares the predictors at the nominal setting. The other shows the predictions at all
    settings.
    """
    tables = []
    headings = (*OUTCOMES, "if lasting", *map(heading_name, _LAST_COLUMNS))
    alarms = prevented["alarms"]
    for group, predictions in prevented["groups"].items():
        figures_by_predictor = {GIVEN_SCORES: predictions}
        for name, figures_by_group in prevented["references"].items():
            figures_by_predictor[name] = figures_by_group[group]
        group_name = human_name(group)
        head = (f"{group_name}, {NOMINAL}", *headings)
        predictor_rows = _predictor_rows(alarms, figures_by_predictor)
        notes = tuple(_group_notes(prevented, group, predictions))
        setting_rows = [(name, *_cells(predictions, alarms, setting=name)) for name in SETTINGS]
        tables += [
            Table((head, *predictor_rows), notes),
            Table(((f"{group_name}, {human_name(GIVEN_SCORES)}", *headings), *setting_rows)),
        ]
    return tables


def _predictor_rows(
    alarms: str, figures_by_predictor: Mapping[str, Json]
) -> Iterator[tuple[str, ...]]:
    """Yield each predictor's row; for the predictions, also rows for latencies and any alarm."""
    for name, figures in figures_by_predictor.items():
        row_name = human_name(name)
        yield row_name, *_cells(figures, alarms)
        if name == GIVEN_SCORES:
            for latency in figures[alarms]:
                if latency != _ZERO_LATENCY:
                    yield f"{row_name}, {latency} s later", *_cells(figures, alarms, latency)
            (other_alarms,) = _ALARM_KINDS.keys() - {alarms}
            alarm_name, _ = _ALARM_KINDS[other_alarms]
            yield f"{row_name}, {alarm_name}", *_cells(figures, other_alarms, lasting=None)


def _cells(
    prediction: Json,
    alarms: str,
    latency: str = _ZERO_LATENCY,
    setting: str = NOMINAL,
    lasting: str | None = "lasting",
) -> Iterator[str]:
    """Yield the cells of a row for one predictor at one latency and setting."""
    figures = prediction[alarms][latency][setting]
    avoided = None
    if lasting is not None:
        avoided = prediction[lasting][latency][setting]["shares"][OUTCOMES[0]]
    yield from map(table_number_text, (*figures["shares"].values(), avoided))
    for name in _LAST_COLUMNS:
        yield table_number_text(figures[name])


def _group_notes(prevented: Json, group: str, predictions: Json) -> Iterator[str]:
    """Yield notes on the share avoided in a group, and on how the threshold was chosen."""
    threshold = predictions["threshold"]
    quiet = predictions["quiet_braking"]
    threshold_text = "none"
    if threshold is not None:
        threshold_text = f"{threshold:.4g}"
    quiet_text = "–" if quiet is None else f"{quiet:.4g}"
    origin = "as given"
    if prevented["operating_by"] != "given":
        origin = "chosen for at most 1 s of braking per minute on these recordings"
    alarms = prevented["alarms"]
    figures = predictions[alarms][_ZERO_LATENCY][NOMINAL]
    lasting = predictions["lasting"][_ZERO_LATENCY][NOMINAL]
    avoided = table_number_text(figures["shares"][OUTCOMES[0]])
    avoided_if_lasting = table_number_text(lasting["shares"][OUTCOMES[0]])
    cost = table_number_text(figures["braking_seconds_per_minute"])
    path = f"groups/{group}/{alarms}/{_ZERO_LATENCY}/{NOMINAL}/shares/{OUTCOMES[0]}"
    ends = prevented["intervals"].get(path)
    interval = ""
    if ends and None not in ends:
        low, high = ends
        interval = f" [{low:.3f}, {high:.3f}]"
    yield (
        f"avoided: {avoided}{interval} of {counted(predictions['accidents'], 'accident')} "
        f"({avoided_if_lasting} by alarms that outlast the reaction), at a cost of {cost} s of "
        f"braking per minute in the {predictions['minutes']:.1f} min of "
        f"{counted(predictions['recordings'], 'recording')} without an accident"
    )
    yield (
        f"threshold {threshold_text}, {origin}; threshold for another split: braking {quiet_text}"
    )


def _figures(result: PreventedResult) -> Iterator[RunFigure]:
    """Return the figures of a result; each is only drawn when it is needed."""
    # A local import, because the module imports matplotlib.
    from deepaccident_devkit.plugins.safety.prevention_figures import prevention_figures

    return prevention_figures(result)


PREVENTED: Final = ExtraResult(
    title="prevented accidents",
    evaluator=prevention_evaluator,
    tables=prevention_tables,
    figures=_figures,
)
