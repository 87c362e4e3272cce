"""`prevented_accidents`: from the counts of warnings and a release to the accidents that they would have prevented.

`prevention_tables` shows them: predictors at the operating point, and the ways of braking.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.accidents.outcomes import OUTCOMES, outcomes_of, undisturbed
from deepaccident_devkit.accidents.recorded import Accident, Skipped, accident_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, breakdown
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.evaluation.runs.predictors import number_text
from deepaccident_devkit.evaluation.warning import CleanWarnings
from deepaccident_devkit.evaluation.warning.anticipation import LATENCIES
from deepaccident_devkit.evaluation.warning.evaluator import PreventedEvaluator
from deepaccident_devkit.evaluation.warning.prevention import (
    NOMINAL,
    SETTINGS,
    AccidentOutcomes,
    OutcomeTable,
    PreventedResult,
)
from deepaccident_devkit.evaluation.warning.recordings import GIVEN, UNPLACED
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.reports import Table
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine


Json = Mapping[str, Any]
_COLUMNS: Final = (*OUTCOMES, "if lasting", "warned", "after end", "braking s/min")
"""Shares of the accidents: the classes, avoided if alarms must last, with an alarm, of contacts after the recording."""
_ALARMS: Final = {"right": "right alarms", "any_alarm": "any alarm"}
_AT_ONCE: Final = "0"
"""Name of no latency, as JSON has it."""
_PEDESTRIAN: Final = "pedestrian"
Frames = Mapping[str, tuple[int, ...]]
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
    how = {"workers": 1, **how}
    evaluator = prevention_evaluator(dataset, run.evaluator, **how)
    found = breakdown(evaluator, run.attributes, EVERYTHING, resampling)
    groups = tuple(replace(each, result=evaluator.compute()) for each in found.groups)
    return replace(run, prevented=replace(found, groups=groups, without_infrastructure=()))


def prevention_evaluator(dataset: Dataset, evaluator: Evaluator[Any], **how: Unpack[Engine]) -> PreventedEvaluator:
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
    wanted = {
        scenario: {agent: tuple(sorted(those)) for agent, those in agents.items()}
        for scenario, agents in frames.items()
    }
    outcomes = accident_outcomes(dataset, wanted, **how)
    made = PreventedEvaluator(outcomes, protocol)
    for token in evaluator.tokens:
        made.add(token, counts[token])
    return made


def accident_outcomes(
    dataset: Dataset,
    frames: Mapping[str, Frames],
    **how: Unpack[Engine],
) -> AccidentOutcomes:
    """How accidents end, for each frame at which an agent can raise its first alarm; any workers give the same bits.

    Args:
        dataset: the release.
        frames: scenario → agents whose alarms are judged → frame numbers of their samples.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
        WorkerError: a worker was killed, or cannot do the work.
    """
    found = in_order(
        run_unordered(
            partial(_tables_of, dataset),
            sorted(frames.items()),
            label="braking",
            places=Places(reads=dataset.places),
            **how,
        )
    )
    tables: dict[str, OutcomeTable] = {}
    left_out: dict[bool, list[Skipped]] = {True: [], False: []}
    for each in found:
        if isinstance(each, dict):
            tables.update(each)
        else:
            known, reason = each
            left_out[known].append(reason)
    return AccidentOutcomes(tables=tables, dropped=tuple(left_out[True]), skipped=tuple(left_out[False]))


def _tables_of(dataset: Dataset, item: tuple[str, Frames]) -> dict[str, OutcomeTable] | tuple[bool, Skipped]:
    """Recording → table, of one scenario; else whether its motion is known, and why there is none."""
    scenario, agents = item
    try:
        accident = accident_of(dataset, scenario)
    except NotAvailableError as error:
        return False, Skipped(scenario=scenario, reason=str(error))
    if accident is None:
        return False, Skipped(scenario=scenario, reason="its meta file names no collision")
    check = undisturbed(accident)
    if not check.usable:
        found = f"{check.margin:.2f} m between the two at its last frame" if check.collides else "no contact"
        reason = f"the recording does not show the impact: {found}, though nobody brakes"
        return True, Skipped(scenario=scenario, reason=reason)
    frame = np.unique(np.concatenate([np.array(those, dtype=np.int64) for those in agents.values()]))
    made: dict[tuple[bool, bool], OutcomeTable] = {}
    tables: dict[str, OutcomeTable] = {}
    for agent in sorted(agents):
        own = accident.agents[0] == agent, accident.agents[1] == agent
        if own not in made:
            made[own] = _table(accident, own, frame)
        tables[f"{scenario}/{agent}"] = made[own]
    return tables


def _table(accident: Accident, own: tuple[bool, bool], frame: IntArray) -> OutcomeTable:
    """The table of an agent that is one of the pair, or neither: then both brake, told after some latency.

    Who is warned before the first frame that shows both brakes from there on, at the earliest.
    """
    seconds = (frame - accident.first_frame) * FRAME_PERIOD
    brakers, latencies = (own, LATENCIES[:1]) if any(own) else ((True, True), LATENCIES)
    ends = [outcomes_of(accident, brakers, np.append(seconds, np.nan), latency=each) for each in latencies]
    return OutcomeTable(
        frame=frame,
        outcome=np.stack([each.outcome for each in ends]).astype(np.int8),
        extrapolated=np.stack([each.extrapolated for each in ends]),
        latencies=latencies,
        pedestrian=_PEDESTRIAN in accident.categories,
    )


def prevention_tables(prevented: Json) -> list[Table]:
    """Two tables for each group of recordings: predictors at the nominal setting, and the predictions at all settings.

    Args:
        prevented: of a summary: a `PreventedResult` as JSON holds it, with `intervals` of its numbers.
    """
    tables = []
    for group, given in prevented["groups"].items():
        everyone = {GIVEN: given, **{name: each[group] for name, each in prevented["references"].items()}}
        head = (f"{group}, {NOMINAL}", *_COLUMNS)
        notes = tuple(_notes(prevented, group, given))
        tables.append(Table(rows=(head, *_predictors(prevented["alarms"], everyone)), notes=notes))
        rows = tuple((name, *_cells(given, prevented["alarms"], setting=name)) for name in SETTINGS)
        tables.append(Table(rows=((f"{group}, {GIVEN}", *_COLUMNS), *rows), notes=()))
    return tables


def prevention_text(prevented: Json) -> str:
    """All tables of `prevention_tables` and the notes, as aligned lines."""
    tables = [each.to_text() for each in prevention_tables(prevented)]
    return "\n\n".join([*tables, *(["\n".join(prevented["notes"])] if prevented["notes"] else [])])


def _predictors(alarms: str, everyone: Mapping[str, Json]) -> Iterator[tuple[str, ...]]:
    """A row a predictor; the given one also with other alarms, and with each latency."""
    for name, figures in everyone.items():
        yield name, *_cells(figures, alarms)
        if name == GIVEN:
            for latency in figures[alarms]:
                if latency != _AT_ONCE:
                    yield f"{name}, {latency} s later", *_cells(figures, alarms, latency)
            (other,) = _ALARMS.keys() - {alarms}
            yield f"{name}, {_ALARMS[other]}", *_cells(figures, other, lasting=None)


def _cells(
    given: Json, alarms: str, latency: str = _AT_ONCE, setting: str = NOMINAL, lasting: str | None = "lasting"
) -> Iterator[str]:
    figures = given[alarms][latency][setting]
    avoided = None if lasting is None else given[lasting][latency][setting]["shares"][OUTCOMES[0]]
    values = [*figures["shares"].values(), avoided]
    values += [figures[name] for name in ("warned", "extrapolated", "braking_seconds_per_minute")]
    yield from map(number_text, values)


def _notes(prevented: Json, group: str, given: Json) -> Iterator[str]:
    threshold, quiet = given["threshold"], given["quiet_braking"]
    how = "given" if prevented["operating_by"] == "given" else "at most 1 braking s/min on these recordings"
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
