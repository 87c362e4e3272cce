"""The counts of samples, and tallies: the sums over their recordings, each one drive of one agent.

All times in a tally are recorded frames, whole numbers, so that no order of the samples and no parts change a bit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import accumulate, chain, groupby, pairwise
from operator import itemgetter
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.alarms.raised import (
    NamedAlarm,
    named_alarms,
    position_difference,
    within_horizon,
)
from deepaccident_devkit.evaluation.metrics.alarms.reading import TIE
from deepaccident_devkit.evaluation.metrics.alarms.truth import SLACK, AccidentContext, BoxTruth
from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.evaluation.metrics.predictions import Prediction, checked_prediction
from deepaccident_devkit.evaluation.metrics.warning.protocol import WarningProtocol, WarningRules
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.taxonomy import FRAME_PERIOD

Kind = Literal["accident", "twins", "others"]
"""Of a recording: somebody collides; nobody does, but in the scenario's twin; nobody does, and none there is known."""
Tally = Mapping[str, Any]
"""Of some recordings, as JSON holds it; `united` adds several up.

Numbers: `samples`, `alarms`, `right` (alarms that are), `unjudged`, `beyond`, `unplaced` (samples). `step`: frames, the
smallest from a sample to the next one of its recording; None where no recording has two. For each `Kind` under its
name: `recordings`, `alarmed` (those with a false alarm), `seen` (samples before the impact whose alarms are judged),
`frames` (that the samples of recordings with several stand for), `lone` (recordings of a single sample), `false` (the
score of the surest false alarm of each sample that has one) and `lasting` (the lower one of two such scores, of samples
next to each other). Of accidents: `reach`, `first` and `steady`: frames before the impact of the first sample, of the
first right alarm, and of that from which on each sample has one, of each recording that has it; `gains`: rows of score,
how many frames more the first right alarm is before the impact if alarms of this score count too, and whether it is the
recording's surest; `reached` and `in_time`: for each lead, the curve's at last, how many recordings have samples as
early, and the score of the surest right alarm as early of each that has one.
"""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
UNPLACED: Final = "unplaced"
"""In place of the kind: somebody collides, but no label shows with whom (`BoxTruth.unplaced`); such samples are counted
and left out, since no alarm in them can be called right or false."""
_NUMBERS: Final = ("samples", "alarms", "right", "unjudged", "beyond", UNPLACED)
_KIND_NUMBERS: Final = ("recordings", "alarmed", "seen", "frames", "lone")
_LISTS: Final = ("reach", "first", "steady", "gains")


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
    rules: WarningRules,
) -> Counts:
    """What one sample adds, the same for all warning protocols.

    Returns:
        `recording`: scenario and agent; `frame`: its number there; `kind` (or `UNPLACED`) and `involvement` of the
        recording; `ahead`:
        recorded frames to the impact, None without one; `to_end`: the same, of a twin to the accident's impact;
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
    raised = named_alarms(checked_prediction(prediction), label, truth, rules)
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
        "alarms": [[each[0].score, int(_is_right(each, truth, context, rules))] for each in judged],
        "unjudged": [each[0].score for each in within if each not in judged] if len(judged) < len(within) else [],
        "beyond": len(raised) - len(within),
        "references": [
            surest([[each.score, int(_is_right((each, each.ids), truth, context, rules))] for each in alarms], kind)
            for alarms in context.references.values()
        ],
    }


def surest(alarms: Sequence[Sequence[float]], kind: str) -> list[float | None]:
    """The scores of the surest right alarm and of the surest one, None for none; [score, whether it is right] of each.

    Where nobody collides no alarm is right, and both are of the surest one.
    """
    best = max((score for score, _ in alarms), default=None)
    return [max((score for score, right in alarms if right), default=None) if kind == "accident" else best, best]


def tally_of(counts: Collection[Counts], protocol: WarningProtocol) -> Tally:
    """The tally of samples, and of tallies among them: recordings of different tallies are never put together.

    In accident recordings samples at the impact or after it are left out, since no alarm warns there any more.
    """
    samples = [each for each in counts if "recording" in each and each["kind"] != UNPLACED]
    unplaced = {**united([], protocol), UNPLACED: sum(each.get("kind") == UNPLACED for each in counts)}
    of_recordings = [
        _recording_tally(list(those), protocol)
        for _, those in groupby(sorted(samples, key=itemgetter("recording", "frame")), key=itemgetter("recording"))
    ]
    return united([unplaced, *of_recordings, *(each for each in counts if "recording" not in each)], protocol)


def united(tallies: Sequence[Tally], protocol: WarningProtocol) -> Tally:
    """The tally of several together."""
    steps = [each["step"] for each in tallies if each["step"] is not None]
    leads = range(len(protocol.leads) + 1)
    return {
        **{name: sum(each[name] for each in tallies) for name in _NUMBERS},
        **{name: list(chain.from_iterable(each[name] for each in tallies)) for name in _LISTS},
        "step": min(steps, default=None),
        "reached": [sum(each["reached"][lead] for each in tallies) for lead in leads],
        "in_time": [list(chain.from_iterable(each["in_time"][lead] for each in tallies)) for lead in leads],
        **{kind: kind_united(each[kind] for each in tallies) for kind in KINDS},
    }


def kind_united(tallies: Iterable[Tally]) -> dict[str, Any]:
    """Of one kind of recordings, or of several kinds."""
    given = list(tallies)
    return {
        **{name: sum(each[name] for each in given) for name in _KIND_NUMBERS},
        **{name: list(chain.from_iterable(each[name] for each in given)) for name in ("false", "lasting")},
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


def _is_right(alarm: NamedAlarm, truth: BoxTruth, context: AccidentContext, rules: WarningRules) -> bool:
    accident, ids = alarm
    ahead, impact = context.time_to_impact, truth.impact
    if ahead is None or context.pair is None:
        return False
    tolerance = rules.time_tolerance
    if tolerance is not None and abs(accident.time - ahead) > tolerance + TIE:
        return False
    if rules.correct_by != "place" and ids is not None and set(ids) == set(context.pair):
        return True
    if rules.correct_by == "pair" or impact is None:
        return False
    return position_difference(accident.positions, impact.positions) < rules.distance - TIE


def _recording_tally(given: Sequence[Counts], protocol: WarningProtocol) -> Tally:
    """Of one recording's samples, in the order of time."""
    kind = given[0]["kind"]
    samples = [each for each in given if each["ahead"] is None or each["ahead"] > 0]
    if protocol.unjudged_are_false:
        samples = [
            {**each, "alarms": [*each["alarms"], *([score, 0] for score in each["unjudged"])]} for each in samples
        ]
    step = min((after["frame"] - before["frame"] for before, after in pairwise(samples)), default=None)
    alarms = [alarm for each in samples for alarm in each["alarms"]]
    unjudged = [] if protocol.unjudged_are_false else [score for each in given for score in each["unjudged"]]
    nothing: dict[str, Any] = {name: kind_united([]) for name in KINDS}
    return {
        "samples": len(given),
        "alarms": len(alarms),
        "right": sum(right for _, right in alarms),
        "unjudged": len(unjudged),
        "beyond": sum(each["beyond"] for each in given),
        UNPLACED: 0,
        "step": step,
        **nothing,
        kind: _false_alarms(samples, step),
        **_warnings(samples if kind == "accident" else [], step, protocol),
    }


def _false_alarms(samples: Sequence[Counts], step: int | None) -> dict[str, Any]:
    """Of samples that raise a false alarm one after another, all but the first are no new alarm.

    An alarm after a missing sample is a new one: nothing shows that it lasted.
    """
    false = [max((score for score, right in each["alarms"] if not right), default=None) for each in samples]
    return {
        "recordings": int(bool(samples)),
        "alarmed": int(any(score is not None for score in false)),
        "seen": sum(score is not None or not sample["unjudged"] for score, sample in zip(false, samples, strict=True)),
        "frames": len(samples) * (step or 0),
        "lone": int(len(samples) == 1),
        "false": [score for score in false if score is not None],
        "lasting": [
            min(score, later_score)
            for (score, sample), (later_score, later) in pairwise(zip(false, samples, strict=True))
            if score is not None and later_score is not None and later["frame"] - sample["frame"] == step
        ],
    }


def _warnings(samples: Sequence[Counts], step: int | None, protocol: WarningProtocol) -> dict[str, Any]:
    """What the right alarms of an accident recording say."""
    surest = [max((score for score, right in each["alarms"] if right), default=None) for each in samples]
    right = [(score, each["ahead"]) for score, each in zip(surest, samples, strict=True) if score is not None]
    reach = samples[0]["ahead"] if samples else 0
    leads = [lead / FRAME_PERIOD - 0.5 for lead in (*protocol.leads, protocol.curve_lead)]
    in_time = [max((score for score, ahead in right if ahead >= lead), default=None) for lead in leads]
    return {
        "reach": [each["ahead"] for each in samples[:1]],
        "first": [ahead for _, ahead in right[:1]],
        "steady": _steady(samples, surest, step),
        "gains": _gains(right),
        "reached": [int(reach >= lead) for lead in leads],
        "in_time": [[] if score is None else [score] for score in in_time],
    }


def _steady(samples: Sequence[Counts], surest: Sequence[float | None], step: int | None) -> list[int]:
    """Frames before the impact from which on every sample has a right alarm, without a sample missing; [] for never."""
    since: list[int] = []
    frame = None
    for sample, score in zip(reversed(samples), reversed(surest), strict=True):
        if score is None or (frame is not None and frame - sample["frame"] != step):
            break
        since, frame = [sample["ahead"]], sample["frame"]
    return since


def _gains(right: Sequence[tuple[float, int]]) -> list[list[Any]]:
    """By how many frames right alarms come earlier than all surer ones: [score, frames, whether it is the surest]."""
    ranked = sorted(right, key=lambda each: (-each[0], -each[1]))
    earliest = list(accumulate((ahead for _, ahead in ranked), max, initial=0))
    return [
        [score, after - before, int(place == 0)]
        for place, ((score, _), (before, after)) in enumerate(zip(ranked, pairwise(earliest), strict=True))
        if after > before
    ]
