"""Prevented accidents of a small release: the tables, runs with them, and scenarios that cannot be judged."""

import math
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import evaluation_run
from numpy.testing import assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.accidents import outcomes
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    CleanWarnings,
    MotionEvaluator,
    Resampling,
    WarningEvaluator,
    accident_context,
)
from deepaccident_devkit.evaluation.runs import prevented_accidents, with_prevented
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.warning.recordings import REFERENCES
from deepaccident_devkit.safety import BRAKINGS, OUTCOMES, accident_of, outcomes_of
from deepaccident_devkit.safety.prevention import PREVENTED, accident_outcomes, prevention_tables
from deepaccident_devkit.safety.prevention_result import NOMINAL, SETTINGS

EVERYONE = ("ego_vehicle", "other_vehicle_behind", "infrastructure")


@pytest.fixture(scope="module")
def crash(da_motion: DeepAccident) -> str:
    (token,) = (each["token"] for each in da_motion.scenario if each["collision"] is not None)
    return token


def foreseen(dataset: DeepAccident, agents: Sequence[str], frames: Sequence[int], crash: str) -> WarningEvaluator:
    """The true accident is foreseen from a frame on, surer and surer; in the twin something at its first frame."""
    evaluator = WarningEvaluator()
    for token in dataset.samples("train", "all"):
        scenario, agent, frame = token.rsplit("/", 2)
        if agent not in agents:
            continue
        context = accident_context(dataset, token, 10.0)
        impact = None if context.truth is None else context.truth.impact
        alarms = []
        if impact is not None and int(frame) >= min(frames):
            score = 0.3 if int(frame) < max(frames) else 0.9
            alarms = [Accident(positions=impact.positions, time=impact.time, ids=impact.ids, score=score)]
        elif scenario != crash and int(frame) == 1:
            alarms = [Accident(positions=np.ones((2, 2)), time=0.5, score=0.3)]
        evaluator.update(token, alarms, None, context)
    return evaluator


def test_tables_are_what_braking_makes_of_the_accident(da_motion: DeepAccident, crash: str) -> None:
    """Agents of the pair brake alone and at once; others warn both, after a latency."""
    accident = accident_of(da_motion, crash)
    assert accident is not None
    place = accident.agents.index("ego_vehicle")
    made = accident_outcomes(da_motion, {crash: dict.fromkeys(EVERYONE, (1, 11, 21, 31))}, workers=1)
    assert (made.dropped, made.skipped) == ((), ())
    times = [(frame - accident.first_frame) * 0.1 for frame in (1, 11, 21, 31)]
    own = outcomes_of(accident, (place == 0, place == 1), [*times, math.nan])
    ego = made.tables[f"{crash}/ego_vehicle"]
    assert ego.latencies == (0.0,)
    assert_array_equal(ego.outcome[0], own.outcome)
    assert_array_equal(ego.extrapolated[0], own.extrapolated)
    assert ego.outcome[0, -1].tolist() == [OUTCOMES.index("unchanged")] * len(BRAKINGS)
    pole = made.tables[f"{crash}/infrastructure"]
    assert pole.latencies == (0.0, 0.1, 0.3)
    for row, latency in enumerate(pole.latencies):
        both = outcomes_of(accident, (True, True), [*times, math.nan], latency=latency)
        assert_array_equal(pole.outcome[row], both.outcome)
    assert made.tables[f"{crash}/other_vehicle_behind"].outcome.tolist() == pole.outcome.tolist()


def test_the_first_alarm_above_the_threshold_decides(da_motion: DeepAccident, crash: str) -> None:
    accident = accident_of(da_motion, crash)
    assert accident is not None
    evaluator = foreseen(da_motion, ("ego_vehicle",), (11, 21), crash)
    place = accident.agents.index("ego_vehicle")
    sampled = sorted(each["frame"] for each in evaluator.counts.values() if each["kind"] == "accident")
    for threshold, earliest in ((0.3, 11), (0.9, 21)):
        frame = next(each for each in sampled if each >= earliest)
        counted = WarningEvaluator(CleanWarnings(threshold=threshold))
        for token, each in evaluator.counts.items():
            counted.add(token, each)
        found = prevented_accidents(da_motion, counted, workers=1).groups["ego_involved"]
        ends = outcomes_of(accident, (place == 0, place == 1), [(frame - accident.first_frame) * 0.1]).outcome[0]
        for column, setting in enumerate(SETTINGS):
            figures = found.right[0.0][setting]
            assert figures.shares[OUTCOMES[ends[column]]] == 1, setting
            assert figures.warned == 1


def test_other_evaluators_have_no_scores_of_recordings(da_motion: DeepAccident) -> None:
    for evaluator in (WarningEvaluator("field"), MotionEvaluator()):
        with pytest.raises(EvaluationError, match="need one of warnings, protocol clean, which scores whole recording"):
            prevented_accidents(da_motion, evaluator)


def test_the_tables_say_what_the_result_does(da_motion: DeepAccident, crash: str) -> None:
    result = prevented_accidents(da_motion, foreseen(da_motion, EVERYONE, (11, 21), crash), workers=1)
    told = {**result.as_dict(), "intervals": {}}
    tables = prevention_tables(told)
    assert len(tables) == 6
    names = [row[0] for row in tables[2].rows]
    assert names[:5] == [
        f"bystander, {NOMINAL}",
        "given",
        "given, 0.1 s later",
        "given, 0.3 s later",
        "given, any alarm",
    ]
    chance = ["random per frame", "random per frame, quiet", "random per recording", "random per recording, quiet"]
    assert names[5:] == ["always", "never", *chance, *REFERENCES]
    assert [row[0] for row in tables[1].rows] == ["ego_involved, given", *SETTINGS]
    given = result.groups["ego_involved"]
    cells = [*given.right[0.0][NOMINAL].shares.values(), given.lasting[0.0][NOMINAL].shares["avoided"]]
    assert [float(each) for each in tables[0].rows[1][1:7]] == pytest.approx(cells, abs=5e-4)
    text = PREVENTED.text(told)
    assert re.search(r"of 1 accidents \(\d\.\d{3} by alarms that outlast the reaction\), for ", text)
    assert "at most 1 braking s/min on these recordings" in text
    assert text.endswith("--threshold-from BUNDLE --threshold-by braking")


def test_intervals_leave_out_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    tokens = [each for each in da_motion.samples("train", "all") if each.split("/")[2] == "ego_vehicle"]
    run = evaluation_run(da_motion, EvaluationSetup(task="warning", protocol="clean"), tokens)
    made = with_prevented(run, da_motion, Resampling(resamples=7))
    assert made.prevented is not None
    (group,) = made.prevented.groups
    assert (group.clusters, made.prevented.resampling.resamples) == (1, 7)
    assert "of 1 cluster (an accident and its twin are one)" in group.notes[0]
    summary = made.summary()["prevented"]
    assert summary["resampling"]["resamples"] == 7
    assert summary["interval_notes"] == list(group.notes)
    assert "prevented" not in run.summary()


def test_scenarios_that_cannot_be_judged_are_named(
    own_release: Path, da_motion: DeepAccident, crash: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pair that labels show at one frame alone, no label at all, no meta file, no collision, boxes too far apart."""
    dataset = DeepAccident(dataroot=own_release, verbose=False)
    crashes = [each["token"] for each in dataset.scenario if each["collision"] is not None]
    normal = next(each["token"] for each in dataset.scenario if each["token"] not in crashes)
    shutil.rmtree(own_release / ".deepaccident")
    seen_once, unlabelled, *more = crashes
    for token in (seen_once, unlabelled):
        kind, name = token.split("/")
        for path in own_release.rglob(f"label/{name}/*.txt"):
            if kind in path.parts and token == unlabelled:
                path.unlink()
            elif kind in path.parts and not path.stem.endswith("_001"):
                path.write_text(f"{path.read_text().splitlines()[0]}\n")
    if more:
        kind, name = more[0].split("/")
        next(path for path in own_release.rglob(f"{name}.txt") if kind in path.parts and "meta" in path.parts).unlink()
    dataset = DeepAccident(dataroot=own_release, verbose=False)
    asked = {token: {"ego_vehicle": (1, 2)} for token in (*crashes, normal)}
    made = accident_outcomes(dataset, asked, workers=1)
    reasons = {each.scenario: each.reason for each in made.skipped}
    assert (made.tables, made.dropped) == ({}, ())
    assert "together at 1 frames; a motion needs 2" in reasons[seen_once]
    assert "has no labels" in reasons[unlabelled]
    assert reasons[normal] == "its meta file names no collision"
    assert not more or "has no meta file" in reasons[more[0]]
    monkeypatch.setattr(outcomes, "MOST_MARGIN", -1.0)
    made = accident_outcomes(da_motion, {crash: {"ego_vehicle": (1, 11)}}, workers=1)
    assert (made.tables, made.skipped) == ({}, ())
    assert [each.scenario for each in made.dropped] == [crash]
    assert "does not show the impact: 0.00 m between the two at its last frame" in made.dropped[0].reason
