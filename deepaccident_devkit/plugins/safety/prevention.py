"""Which accidents braking after the alarms would have prevented: from the counts of warnings to numbers and tables.

`PREVENTED` is what evaluations know of it (`evaluation.runs.further`).
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

_WALKING: Final = ", pedestrian"
# End of the name of a random predictor at the threshold of at most one braking second a minute.
_QUIET: Final = ", quiet"
# Shares of the accidents: the classes, avoided if alarms must last, with an alarm, of contacts after the recording.
_COLUMNS: Final = (*OUTCOMES, "if lasting", "warned", "after end", "braking s/min")
# Which alarms warn → how tables call them, and the scores that are of them.
_ALARMS: Final[Mapping[str, tuple[str, ScoresOf]]] = {
    "right": ("right alarms", "pair"),
    "any_alarm": ("any alarm", "recording"),
}
# Name of no latency, as JSON has it.
_AT_ONCE: Final = "0"
FramesByAgent = Mapping[str, Sequence[int]]
"""Agent → frame numbers of its samples."""


def prevented_accidents(
    dataset: Dataset,
    evaluator: Evaluator[Any],
    **how: Unpack[Engine],
) -> PreventedResult:
    """The accidents that alarms would have prevented if somebody had braked, and what false alarms cost.

    An agent of the pair that collides brakes alone; any other agent warns both of the pair, after a latency.

    Args:
        dataset: the release that the samples are of.
        evaluator: a `WarningEvaluator` of the protocol `clean` that has counted them.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        EvaluationError: it is another evaluator, or of another protocol.
        TokenError: a sample is of no scenario of the release.
        WorkerError: a worker was killed, or cannot do the work.
    """
    return prevention_evaluator(dataset, evaluator, **how).compute()


def with_prevented(
    run: EvaluationRun,
    dataset: Dataset,
    resampling: Resampling | None = None,
    **how: Unpack[Engine],
) -> EvaluationRun:
    """The same run with the accidents that its alarms would have prevented, and intervals of their numbers.

    Args:
        run: an evaluation of warnings, protocol `clean`.
        dataset: the release that it is of.
        resampling: how intervals are made, an accident and its twin together; None for the defaults.
        **how: `workers` (1 if not given), `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        EvaluationError: the run is of another task or protocol.
        WorkerError: a worker was killed, or cannot do the work.
    """
    return with_further(run, "prevented", dataset, resampling, **how)


def prevention_evaluator(
    dataset: Dataset, evaluator: Evaluator[Any], **how: Unpack[Engine]
) -> PreventedEvaluator:
    """An evaluator with the same counts that computes prevented accidents; see `prevented_accidents`."""
    protocol = getattr(evaluator, "protocol", None)
    if not isinstance(protocol, CleanWarnings):
        raise EvaluationError(
            "evaluator: prevented accidents need one of warnings, protocol clean, which scores whole recordings; "
            f"found {evaluator!r} with the protocol {type(protocol).__name__}"
        )
    counts = evaluator.counts
    frames: dict[str, dict[str, list[int]]] = {}
    for token in sorted(evaluator.tokens):
        each = counts[token]
        if each["kind"] in ("accident", UNPLACED):  # of the latter it is told why nothing is judged
            scenario, _, agent = each["recording"].rpartition("/")
            frames.setdefault(scenario, {}).setdefault(agent, []).append(each["frame"])
    made = PreventedEvaluator(accident_outcomes(dataset, frames, **how), protocol)
    for token in evaluator.tokens:
        made.add(token, counts[token])
    return made


def accident_outcomes(
    dataset: Dataset,
    frames: Mapping[str, FramesByAgent],
    **how: Unpack[Engine],
) -> AccidentOutcomes:
    """How accidents end, for each frame at which an agent can raise its first alarm; any workers give the same bits.

    Frames are those of the samples of each scenario's agents whose alarms are judged. Raises TokenError, WorkerError.
    """
    work = partial(_outcomes_of, dataset)
    places = Places(reads=dataset.places)
    parts = list(
        in_order(run_unordered(work, sorted(frames.items()), label="braking", places=places, **how))
    )
    return AccidentOutcomes(
        tables={name: table for each in parts for name, table in each.tables.items()},
        dropped=tuple(chain.from_iterable(each.dropped for each in parts)),
        skipped=tuple(chain.from_iterable(each.skipped for each in parts)),
    )


def _outcomes_of(dataset: Dataset, item: tuple[str, FramesByAgent]) -> AccidentOutcomes:
    """Of one scenario."""
    scenario, agents = item
    try:
        accident = accident_of(dataset, scenario)
    except NotAvailableError as error:
        return AccidentOutcomes(skipped=(Skipped(scenario=scenario, reason=str(error)),))
    if accident is None:
        return AccidentOutcomes(
            skipped=(Skipped(scenario=scenario, reason="its meta file names no collision"),)
        )
    check = undisturbed(accident)
    if not check.usable:
        found = (
            f"{check.margin:.2f} m between the two at its last frame"
            if check.collides
            else "no contact"
        )
        reason = f"the recording does not show the impact: {found}, though nobody brakes"
        return AccidentOutcomes(dropped=(Skipped(scenario=scenario, reason=reason),))
    frame = np.unique(
        np.concatenate([np.array(those, dtype=np.int64) for those in agents.values()])
    )
    own = {
        agent: (accident.agents[0] == agent, accident.agents[1] == agent)
        for agent in sorted(agents)
    }
    made = {each: _table(accident, each, frame) for each in dict.fromkeys(own.values())}
    return AccidentOutcomes(
        tables={f"{scenario}/{agent}": made[each] for agent, each in own.items()}
    )


def _table(accident: Accident, own: tuple[bool, bool], frame: IntArray) -> OutcomeTable:
    """The table of an agent that is one of the pair, or neither: then both brake, told after some latency.

    Who is warned before the first frame that shows both brakes from there on, at the earliest.
    """
    seconds = (frame - accident.first_frame) * FRAME_PERIOD
    brakers, latencies = (own, LATENCIES[:1]) if any(own) else ((True, True), LATENCIES)
    ends = [
        outcomes_of(accident, brakers, np.append(seconds, np.nan), latency=each)
        for each in latencies
    ]
    return OutcomeTable(
        frame=frame,
        outcome=np.stack([each.outcome for each in ends]).astype(np.int8),
        extrapolated=np.stack([each.extrapolated for each in ends]),
        latencies=latencies,
        pedestrian="pedestrian" in accident.categories,
    )


class PreventedEvaluator(Evaluator[PreventedResult]):
    """What a `WarningEvaluator` of the protocol `clean` counts, as accidents prevented.

    `compute` gives a `PreventedResult`. `evaluation.runs.prevented_accidents` makes the tables and takes the counts.
    """

    protocols = WARNING_PROTOCOLS
    result_class = PreventedResult

    def __init__(self, outcomes: AccidentOutcomes, protocol: str | CleanWarnings = "clean") -> None:
        """Start without samples.

        Args:
            outcomes: how each accident ends, by the frame of the first alarm.
            protocol: `clean`, or your own of its kind.

        Raises:
            EvaluationError: it is another protocol, which has no recordings with scores.
            ChoiceError: no protocol has that name.
        """
        super().__init__(protocol)
        if not isinstance(self.protocol, CleanWarnings):
            raise EvaluationError(
                f"protocol: prevented accidents are counted by the protocol clean, found {type(self.protocol).__name__}"
            )
        self._outcomes = outcomes

    def update(self, token: str, *arguments: Any) -> None:
        """Count one sample, as `WarningEvaluator.update` does; raises EvaluationError."""
        warnings = WarningEvaluator(self.protocol)
        warnings.update(token, *arguments)
        self.add(token, warnings.counts[token])

    def result_of(self, counts: Collection[Counts]) -> PreventedResult:
        """The figures of some samples' counts, in any order, without references and curves."""
        return self._result(parts_of(counts), references=False)

    def compute(self, tokens: Iterable[str] | None = None) -> PreventedResult:
        """The figures of all samples, with references and curves; or of some, without."""
        if tokens is not None:
            return super().compute(tokens)
        return self._result(parts_of(list(self._counts.values())), references=True)

    def resampled(
        self, parts: Sequence[Sequence[Counts]], times: IntArray
    ) -> Iterator[PreventedResult]:
        """The result of each draw, without references and curves."""
        groups = dict(self._groups(recordings_of(parts)))
        tables = {group: self._ends(those, GIVEN) for group, those in groups.items()}
        for draw in times:
            figures = {group: self._given(ends, draw) for group, ends in tables.items()}
            yield self._of_groups({GIVEN: figures})

    def _result(self, parts: Sequence[Collection[Counts]], *, references: bool) -> PreventedResult:
        groups = dict(self._groups(recordings_of(parts)))
        given = {group: self._ends(those, GIVEN) for group, those in groups.items()}
        made = {GIVEN: {group: self._given(ends) for group, ends in given.items()}}
        if not references:
            return self._of_groups(made, tuple(self._notes(made[GIVEN])))
        for group, those in groups.items():
            for name, figures in self._references(those):
                made.setdefault(name, {})[group] = figures
        curves = {group: ends[self._alarms].curve() for group, ends in given.items()}
        return self._of_groups(made, tuple(self._notes(made[GIVEN])), curves)

    def _of_groups(
        self,
        made: Mapping[str, Mapping[str, PreventionFigures]],
        notes: tuple[str, ...] = (),
        curves: Mapping[str, PreventionCurve] | None = None,
    ) -> PreventedResult:
        return PreventedResult(
            operating_by="budget" if self.protocol.threshold is None else "given",
            alarms=self._alarms,
            groups=made[GIVEN],
            references={name: each for name, each in made.items() if name != GIVEN},
            curves=curves or {},
            dropped=self._outcomes.dropped,
            skipped=self._outcomes.skipped,
            notes=notes,
        )

    @property
    def _alarms(self) -> str:
        """A predictor that names nobody has no right alarms."""
        return next(
            name for name, (_, scores_of) in _ALARMS.items() if scores_of == self.protocol.scores_of
        )

    def _groups(self, recordings: Sequence[Recording]) -> Iterator[tuple[str, list[Recording]]]:
        """Group → its recordings, accidents of pedestrians apart; those without an accident are in both."""
        tables = self._outcomes.tables
        for group, those in by_group(recordings):
            walking = {
                each.name for each in those if each.name in tables and tables[each.name].pedestrian
            }
            yield group, [each for each in those if each.name not in walking]
            if walking:
                yield (
                    f"{group}{_WALKING}",
                    [each for each in those if each.kind != "accident" or each.name in walking],
                )

    def _ends(
        self, recordings: Sequence[Recording], predictor: str, draw: int = 0
    ) -> Mapping[str, AlarmOutcomes]:
        """Which alarms warn → one predictor's scores of a group of recordings, with the ends of its accidents."""
        tables = self._outcomes.tables
        right = AlarmOutcomes(recordings, predictor, "pair", tables, draw)
        any_alarm = (
            right
            if predictor in TRIVIAL
            else AlarmOutcomes(recordings, predictor, "recording", tables, draw)
        )
        return {"right": right, "any_alarm": any_alarm}

    def _given(
        self, ends: Mapping[str, AlarmOutcomes], draw: IntArray | None = None
    ) -> PreventionFigures:
        main = ends[self._alarms]
        weight = np.ones(len(main.part)) if draw is None else draw[main.part].astype(np.float64)
        quiet = main.quiet_braking(weight)
        threshold = quiet if self.protocol.threshold is None else self.protocol.threshold
        return self._figures(ends, threshold, quiet, weight)

    def _figures(
        self, ends: Mapping[str, AlarmOutcomes], threshold: float, quiet: float, weight: FloatArray
    ) -> PreventionFigures:
        main = ends[self._alarms]
        return PreventionFigures(
            threshold=threshold,
            quiet_braking=quiet,
            accidents=int(weight[main.accident].sum()),
            recordings=int(weight[main.normal].sum()),
            minutes=main.minutes(weight),
            lasting=main.ends(threshold, weight, lasting=True),
            **{alarms: each.ends(threshold, weight) for alarms, each in ends.items()},
        )

    def _references(
        self, recordings: Sequence[Recording]
    ) -> Iterator[tuple[str, PreventionFigures]]:
        """Predictor → figures; of a random one the means over some draws, also at the threshold within the budget."""
        weight = np.ones(len(recordings))
        for predictor in PREDICTORS[1:]:
            fixed = reference_threshold(predictor)
            if draws_of(predictor) == 1:
                yield (
                    predictor,
                    self._figures(self._ends(recordings, predictor), fixed, math.nan, weight),
                )
            else:
                drawn = [
                    self._ends(recordings, predictor, draw) for draw in range(draws_of(predictor))
                ]
                quiet = [each[self._alarms].quiet_braking(weight) for each in drawn]
                for name, thresholds in (
                    (predictor, [fixed] * len(drawn)),
                    (f"{predictor}{_QUIET}", quiet),
                ):
                    yield (
                        name,
                        _mean(
                            [
                                self._figures(*each, weight)
                                for each in zip(drawn, thresholds, quiet, strict=True)
                            ]
                        ),
                    )

    def _notes(self, groups: Mapping[str, PreventionFigures]) -> Iterator[str]:
        for group, figures in groups.items():
            if not figures.accidents:
                yield f"{group}: no accident is judged, so that no share prevented is known; give accident scenarios"
            if not figures.recordings:
                yield f"{group}: no recording without an accident, so that no braking for nothing is known; give some"
        if groups:
            yield (
                "an alarm that is over before the driver brakes costs nothing, but counts as a warning: compare with "
                "'random per frame, quiet', and with the share 'if lasting', where alarms must outlast the reaction"
            )
        if groups and self.protocol.threshold is None:
            yield (
                f"the threshold is the lowest with at most {BUDGET:g} braking second a minute on these very "
                "recordings, which flatters; take it from another split, evaluated with --prevented: --threshold-from "
                "BUNDLE --threshold-by braking"
            )
        for why, left_out in (
            ("the self-check drops", self._outcomes.dropped),
            ("not judged", self._outcomes.skipped),
        ):
            for each in left_out:
                yield f"{why} {each.scenario}: {each.reason}"


def _mean(drawn: Sequence[PreventionFigures]) -> PreventionFigures:
    """The means, which have no counts."""
    figures: PreventionFigures = mean_of(drawn)
    ends: dict[str, Any] = {
        alarms: {
            latency: {setting: replace(each, counts={}) for setting, each in settings.items()}
            for latency, settings in getattr(figures, alarms).items()
        }
        for alarms in (*_ALARMS, "lasting")
    }
    return replace(figures, **ends)


def prevention_tables(prevented: Json) -> list[Table]:
    """Two tables for each group of recordings: predictors at the nominal setting, and predictions at all settings."""
    tables = []
    for group, given in prevented["groups"].items():
        everyone = {
            GIVEN: given,
            **{name: each[group] for name, each in prevented["references"].items()},
        }
        head = (f"{group}, {NOMINAL}", *_COLUMNS)
        rows = tuple((name, *_cells(given, prevented["alarms"], setting=name)) for name in SETTINGS)
        tables += [
            Table(
                (head, *_predictors(prevented["alarms"], everyone)),
                tuple(_notes(prevented, group, given)),
            ),
            Table(((f"{group}, {GIVEN}", *_COLUMNS), *rows)),
        ]
    return tables


def _predictors(alarms: str, everyone: Mapping[str, Json]) -> Iterator[tuple[str, ...]]:
    """A row a predictor; the given one also with other alarms, and with each latency."""
    for name, figures in everyone.items():
        yield name, *_cells(figures, alarms)
        if name == GIVEN:
            for latency in figures[alarms]:
                if latency != _AT_ONCE:
                    yield f"{name}, {latency} s later", *_cells(figures, alarms, latency)
            (other,) = _ALARMS.keys() - {alarms}
            yield f"{name}, {_ALARMS[other][0]}", *_cells(figures, other, lasting=None)


def _cells(
    given: Json,
    alarms: str,
    latency: str = _AT_ONCE,
    setting: str = NOMINAL,
    lasting: str | None = "lasting",
) -> Iterator[str]:
    figures = given[alarms][latency][setting]
    avoided = None if lasting is None else given[lasting][latency][setting]["shares"][OUTCOMES[0]]
    others = (figures[name] for name in ("warned", "extrapolated", "braking_seconds_per_minute"))
    yield from map(number_text, (*figures["shares"].values(), avoided, *others))


def _notes(prevented: Json, group: str, given: Json) -> Iterator[str]:
    threshold, quiet = given["threshold"], given["quiet_braking"]
    how = (
        "given"
        if prevented["operating_by"] == "given"
        else "at most 1 braking s/min on these recordings"
    )
    figures = given[prevented["alarms"]][_AT_ONCE][NOMINAL]
    lasting = given["lasting"][_AT_ONCE][NOMINAL]
    path = f"groups/{group}/{prevented['alarms']}/{_AT_ONCE}/{NOMINAL}/shares/{OUTCOMES[0]}"
    ends = prevented["intervals"].get(path)
    interval = "" if not ends or None in ends else f" [{ends[0]:.3f}, {ends[1]:.3f}]"
    yield (
        f"avoided: {number_text(figures['shares'][OUTCOMES[0]])}{interval} of {given['accidents']} accidents "
        f"({number_text(lasting['shares'][OUTCOMES[0]])} by alarms that outlast the reaction), for "
        f"{number_text(figures['braking_seconds_per_minute'])} braking seconds a minute in {given['minutes']:.1f} min "
        f"of {given['recordings']} recordings without an accident"
    )
    yield (
        f"threshold {'none' if threshold is None else f'{threshold:.4g}'} ({how}); for another split: braking "
        f"{'–' if quiet is None else f'{quiet:.4g}'}"
    )


def _figures(result: PreventedResult) -> Iterator[RunFigure]:
    from deepaccident_devkit.plugins.safety.prevention_figures import (
        prevention_figures,
    )  # which imports matplotlib

    return prevention_figures(result)


PREVENTED: Final = ExtraResult(
    title="prevented accidents",
    evaluator=prevention_evaluator,
    tables=prevention_tables,
    figures=_figures,
)
