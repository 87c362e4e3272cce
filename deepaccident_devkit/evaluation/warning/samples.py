"""What one sample says of warnings: which alarms it raises, and which of them are right."""

from __future__ import annotations

from typing import Final, Literal

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident.alarms import NamedAlarm, named_alarms
from deepaccident_devkit.evaluation.accident.impact import BoxTruth
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext, Prediction, checked_prediction
from deepaccident_devkit.evaluation.accident.reading import TIE
from deepaccident_devkit.evaluation.accident.scoring import position_difference
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.warning.protocol import WarningProtocol
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Kind = Literal["accident", "twins", "others"]
"""Of a recording: somebody collides; nobody does, but in the scenario's twin; nobody does, and none there is known."""
_SLACK: Final = FRAME_PERIOD / 2
"""Seconds: half a recorded frame, so that decimal moments compare as they are meant."""


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
    protocol: WarningProtocol,
) -> Counts:
    """What one sample adds.

    Returns:
        `recording`: scenario and agent; `frame`: its number there; `kind`: of the recording; `ahead`: recorded frames
        to the impact, None without one; `alarms`: [score, whether it is right], the surest first; `unjudged`: how
        many alarms were left out.

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
    raised = named_alarms(checked_prediction(prediction), label, truth, protocol)
    ahead = context.time_to_impact
    seen = to_end + _SLACK
    judged = [each for each in raised if ahead is not None or protocol.unjudged_are_false or each[0].time <= seen]
    return {
        "recording": recording,
        "frame": frame,
        "kind": _kind(context),
        "ahead": None if ahead is None else round(ahead / FRAME_PERIOD),
        "alarms": [[each[0].score, int(_is_right(each, truth, context, protocol))] for each in judged],
        "unjudged": len(raised) - len(judged),
    }


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


def _is_right(alarm: NamedAlarm, truth: BoxTruth, context: AccidentContext, protocol: WarningProtocol) -> bool:
    accident, ids = alarm
    ahead, impact = context.time_to_impact, truth.impact
    if ahead is None or context.pair is None:
        return False
    tolerance = protocol.time_tolerance
    if tolerance is not None and abs(accident.time - ahead) > tolerance + TIE:
        return False
    if protocol.correct_by != "place" and ids is not None and set(ids) == set(context.pair):
        return True
    if protocol.correct_by == "pair" or impact is None:
        return False
    return position_difference(accident.positions, impact.positions) < protocol.distance - TIE
