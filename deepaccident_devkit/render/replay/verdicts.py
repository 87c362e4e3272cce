"""The accidents that a model foresees in a scenario, and whether they are right by the accident protocol `boxes`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation import Accident, AccidentContext, BoxAccidents, MotionOutput, accident_context
from deepaccident_devkit.evaluation.accident import Prediction
from deepaccident_devkit.evaluation.accident.scoring import ERRORS_AT, hit_of
from deepaccident_devkit.evaluation.accident_truth import RELEASED_HORIZON, Pair, named_alarms
from deepaccident_devkit.evaluation.predictions import checked_prediction
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.outcomes.above import count_words
from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.taxonomy import short_name

Foreseen = Results | Mapping[str, MotionOutput | Iterable[Accident]]
"""A results file of motion or accidents, or predictions by sample token."""
_RULES: Final = BoxAccidents()
_SHOWN: Final = 3
"""The most alarms of a sample that are shown: right alarms first, then the surest ones."""


def verdicts(recording: Recording, prediction: Foreseen) -> dict[str, Any]:
    """The foreseen accidents as the page has them: the rule in words, and each sample that has a prediction.

    Args:
        recording: the scenario and the agents; only their samples are taken.
        prediction: a model's predictions. Instance maps given by token have the orientation of the released labels.

    Raises:
        NotAvailableError: no prediction is of this scenario and these agents, or a sample has no label.
        EvaluationError: a prediction is neither motion nor accidents.
    """
    horizon = _horizon(prediction)
    samples = [
        _sample(recording, prediction, agent, frame, horizon)
        for frame in recording.frames
        for agent in recording.agents
        if recording.sample(agent, frame) in prediction
    ]
    if not samples:
        raise NotAvailableError(
            f"prediction: has no sample of {recording.scenario['token']} and {', '.join(recording.agents)}; "
            "choose a scenario and agents that it has, or replay without it"
        )
    rule = (
        f"Protocol boxes: an accident within {horizon:g} s counts as foreseen if the errors of the two places "
        f"are less than {ERRORS_AT:g} m in sum."
    )
    return {"rule": rule, "samples": samples}


def _horizon(prediction: Foreseen) -> float:
    form = prediction.form if isinstance(prediction, Results) else None
    return RELEASED_HORIZON if form is None else min(RELEASED_HORIZON, (form.frames - 1) * form.step)


def _sample(recording: Recording, prediction: Foreseen, agent: str, frame: int, horizon: float) -> dict[str, Any]:
    token = recording.sample(agent, frame)
    given, label, context = _loaded(recording, prediction, token, horizon)
    truth = context.truth
    if truth is None:  # only for the type checker: a context with a horizon has a truth
        raise NotAvailableError(f"{token}: has no truth to compare with; choose a labelled sample")
    world_from_ego = recording.dataset.world_from(token, "ego")
    alarms = [
        _alarm(recording, accident, ids, context, world_from_ego)
        for accident, ids in named_alarms(given, label, truth, _RULES.reading)
    ]
    return {
        "frame": frame - 1,
        "agent": recording.agents.index(agent),
        "verdict": _verdict(given, label, context),
        "text": f"{short_name(agent)} at frame {frame}: {_truth_text(context)}",
        "alarms": sorted(alarms, key=lambda alarm: not alarm["right"])[:_SHOWN],
        "more": max(0, len(alarms) - _SHOWN),
    }


def _loaded(
    recording: Recording, prediction: Foreseen, token: str, horizon: float
) -> tuple[MotionOutput | list[Accident], MotionLabels | None, AccidentContext]:
    if isinstance(prediction, Results):
        setup = EvaluationSetup(task="accident", protocol="boxes", horizon=horizon)
        given, label, context = SampleLoader(recording.dataset, prediction, setup)(token)
        return checked_prediction(given), label, context
    return checked_prediction(prediction[token]), None, accident_context(recording.dataset, token, horizon)


def _verdict(given: Prediction, label: MotionLabels | None, context: AccidentContext) -> str:
    """What the sample counts as, or `not judged`."""
    counts = _RULES.counts(given, label, context)
    if counts["unjudged"] and not (counts["positive"] or counts["alarms"]):
        return "not judged"
    return count_words(_RULES.result([counts]).within[ERRORS_AT])


def _alarm(
    recording: Recording, accident: Accident, ids: Pair | None, context: AccidentContext, world_from_ego: SE3
) -> dict[str, Any]:
    counts = _RULES.counts([accident], None, context)
    off = counts["alarms"][0] if counts["alarms"] else None
    right = bool(off and hit_of([off], ERRORS_AT))
    text = f"foreseen in {accident.time:.1f} s, score {accident.score:.2g}"
    if off and off["position"] is not None:
        text += f": places off by {off['position']:.1f} m, time by {off['time']:+.1f} s"
    elif off is None:
        text += ": it would be after the end of the recording"
    if ids is not None:
        right_two = context.pair is not None and set(ids) == set(context.pair)
        names = " and ".join("an unknown actor" if each is None else str(each) for each in ids)
        text += f"; names {names}{', who collide' if right_two else ''}"
    return {
        "places": recording.places(world_from_ego.apply([[x, y, 0.0] for x, y in accident.positions.tolist()])[:, :2]),
        "right": right,
        "time": round(accident.time, 1),
        "text": text,
        "actors": [each for each in ids or () if each is not None],
    }


def _truth_text(context: AccidentContext) -> str:
    truth = context.truth
    if truth is None or truth.accident is None:
        return "no accident comes within the horizon"
    return f"an accident comes in {truth.accident.time:.1f} s"
