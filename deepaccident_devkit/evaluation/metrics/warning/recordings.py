"""What one sample adds to the metrics of warnings: its alarms, and how far the impact is, in recorded frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, get_args

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.alarms.raised import (
    Pair,
    named_alarms,
    position_difference,
    within_horizon,
)
from deepaccident_devkit.evaluation.metrics.alarms.reading import TIE, AccidentReading
from deepaccident_devkit.evaluation.metrics.alarms.truth import SLACK, AccidentContext, BoxTruth
from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.evaluation.metrics.predictions import Accident, Prediction, checked_prediction
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Kind = Literal["accident", "twins", "others"]
"""Of a recording: somebody collides; nobody does, but in the scenario's twin; nobody does, and none there is known."""
_NEAR: Final = 10.0
"""Metres: an alarm is right whose positions differ by less in sum from where the pair meets, as errors of `paper`."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
UNPLACED: Final = "unplaced"
"""In place of the kind: somebody collides, but no label shows with whom (`BoxTruth.unplaced`); such samples are counted
and left out, since no alarm in them can be called right or false."""


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
) -> Counts:
    """What one sample adds, the same for all warning protocols.

    An alarm for later than the horizon does not count. Unlike an accident that counts for APA, the impact may be later
    than the model looks ahead: an early alarm with the right pair or the right place is a warning. Cells of maps are
    coarse, so that they raise more false alarms than explicit accidents.

    Returns:
        `recording`: scenario and agent; `frame`: its number there; `kind` (or `UNPLACED`) and `involvement` of the
        recording; `ahead`: recorded frames to the impact, None without one; `to_end`: the same, of a twin to the
        accident's impact;
        `alarms`: [score, whether it is right], the surest first; `unjudged`: scores of those that nothing can refute;
        `beyond`: how many are for later than the horizon, and so none; `references`: of each of `REFERENCES` the scores
        of its surest right alarm and its surest one, empty without any.

    Raises:
        EvaluationError: the token is no sample's, the context lacks something, or the prediction is neither motion nor
            accidents.
    """
    recording, frame = _place(token)
    truth, to_end = context.truth, context.time_to_end
    if truth is None or to_end is None:
        raise EvaluationError(
            "context: warnings need to know what happens, and when; give accident_context(dataset, sample, horizon=2.0)"
        )
    raised = named_alarms(checked_prediction(prediction), label, truth, AccidentReading())
    within = within_horizon(raised, truth)
    ahead, kind = context.time_to_impact, _kind(context) if truth.unplaced is None else UNPLACED
    judged = [each for each in within if ahead is not None or each[0].time <= to_end + SLACK]
    end = context.time_to_twin_impact if kind == "twins" else ahead
    return {
        "recording": recording,
        "frame": frame,
        "kind": kind,
        "involvement": context.involvement,
        "ahead": None if ahead is None else round(ahead / FRAME_PERIOD),
        "to_end": None if end is None else round(end / FRAME_PERIOD),
        "alarms": [[each[0].score, int(_is_right(*each, truth, context))] for each in judged],
        "unjudged": [each[0].score for each in within if each not in judged] if len(judged) < len(within) else [],
        "beyond": len(raised) - len(within),
        "references": [
            surest([[each.score, int(_is_right(each, each.ids, truth, context))] for each in alarms], kind)
            for alarms in context.references.values()
        ],
    }


def surest(alarms: Sequence[Sequence[float]], kind: str) -> list[float | None]:
    """The scores of the surest right alarm and of the surest one, None for none; [score, whether it is right] of each.

    Where nobody collides no alarm is right, and both are of the surest one.
    """
    best = max((score for score, _ in alarms), default=None)
    return [max((score for score, right in alarms if right), default=None) if kind == "accident" else best, best]


def _place(token: object) -> tuple[str, int]:
    recording, _, frame = token.rpartition("/") if isinstance(token, str) else ("", "", "")
    if not recording or not frame.isdecimal():
        raise EvaluationError(
            f"token: expected a sample's, such as type1_subtype1_accident/Town03_…/ego_vehicle/045, found {token!r}: "
            "warnings are counted by recording"
        )
    return recording, int(frame)


def _kind(context: AccidentContext) -> Kind:
    if context.time_to_impact is not None:
        return "accident"
    return "twins" if context.twin else "others"


def _is_right(accident: Accident, ids: Pair | None, truth: BoxTruth, context: AccidentContext) -> bool:
    """Whether an alarm names the pair that collides, in either order, or the place where they meet."""
    if context.time_to_impact is None or context.pair is None:
        return False
    if ids is not None and set(ids) == set(context.pair):
        return True
    return truth.impact is not None and position_difference(accident.positions, truth.impact.positions) < _NEAR - TIE
