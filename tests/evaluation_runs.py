"""Runs of each task on a small release: what pictures and reports are tested with."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    DetectedBoxes,
    Resampling,
    breakdown,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident import BoxTruth, accident_context
from deepaccident_devkit.evaluation.breakdowns import sample_attributes
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.results import Results, ResultsTask, ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs import (
    EvaluationRun,
    Partial,
    ReleaseInfo,
    ResultsInfo,
    SampleSelection,
    ScenarioHashes,
    default_selection,
    evaluate_results,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.motion import MotionLabelConfig

BREAKDOWNS = ("all", "time_to_impact", "accident_visibility", "agent", "scenario_type")
PARTIAL = Partial(missing=60, extra=2, expected=180, evaluated=120)
META = MappingProxyType({"method": "made in a test"})


def evaluation_run(
    dataset: DeepAccident,
    setup: EvaluationSetup,
    tokens: Sequence[str],
    *,
    partial: Partial | None = None,
    meta: Mapping[str, Any] = META,
    **more: Any,
) -> EvaluationRun:
    """A run of predictions that are mostly right, for the same tokens always the same ones."""
    evaluator = setup.evaluator()
    if setup.task in ("planning", "forecasting"):  # they look further ahead
        tokens = default_selection(setup, "train").tokens(dataset)[::3]
    for number, token in enumerate(tokens):
        evaluator.update(token, *_arguments(dataset, setup, token, np.random.default_rng(number)))
    attributes = sample_attributes(dataset, tokens)
    hashes = {
        each.scenario: ScenarioHashes(label="1a", meta="2b", calib="3c")
        for each in attributes.values()
    }
    return EvaluationRun(
        setup=setup,
        selection=SampleSelection(split="train", horizon=setup.horizon),
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=partial,
        attributes=attributes,
        times_to_impact={token: dataset.get("sample", token)["time_to_impact"] for token in tokens},
        breakdowns=tuple(
            breakdown(evaluator, attributes, by, Resampling(resamples=20)) for by in BREAKDOWNS
        ),
        release=ReleaseInfo(dataroot="/data/DeepAccident", version="v1", scenarios=hashes),
        results=ResultsInfo(
            path="results", task=setup.task, fingerprint="5e5e", meta=meta, form=None
        ),
        **more,
    )


def _arguments(
    dataset: DeepAccident, setup: EvaluationSetup, token: str, source: np.random.Generator
) -> tuple[Any, ...]:
    if setup.task in ("planning", "forecasting"):
        from deepaccident_devkit.plugins.baselines import (  # a room, which may be missing
            predict_forecasts,
            predict_plan,
        )

        planned = setup.task == "planning"
        predicted = [predict_plan(dataset, token)] if planned else predict_forecasts(dataset, token)
        return predicted, *setup.evaluator().truth(dataset, token, None, setup.horizon)
    if setup.task == "detection":
        truth = detection_truth(dataset, token, setup.rules)
        keep = source.uniform(size=len(truth)) < 0.8
        boxes = truth.select(keep)
        boxes = replace(
            boxes, center=boxes.center + source.normal(0, 0.6, (len(boxes), 3)) * (1, 1, 0)
        )
        return DetectedBoxes(
            boxes=boxes, scores=np.round(source.uniform(size=len(boxes)), 2)
        ), truth
    context = accident_context(dataset, token, setup.horizon, references=setup.task == "warning")
    if setup.protocol == "boxes" or setup.task == "warning":
        return _alarms(context.truth, source), None, context
    label = dataset.motion_labels(token, MotionLabelConfig(protocol=setup.rules.labels)).to_present(
        "bilinear"
    )
    maps = np.roll(label.instance, source.integers(-2, 3, 2), (1, 2))
    lost = source.integers(1, 8)
    output = instances_of(np.where(maps == lost, 0, maps), label.config.grid)
    return (output, label) if setup.task == "motion" else (output, label, context)


def _alarms(truth: BoxTruth | None, source: np.random.Generator) -> list[Accident]:
    """Mostly one, somewhat off; sometimes one where nothing comes."""
    if truth is None or truth.accident is None:
        return (
            [Accident(positions=np.ones((2, 2)), time=0.5, score=0.3)]
            if source.uniform() < 0.3
            else []
        )
    off = source.normal(0, 2.5, (2, 2))
    late = float(np.clip(truth.accident.time + source.choice((-0.5, 0, 0, 0.5)), 0, None))
    score = round(float(source.uniform(0.3, 1)), 2)
    found = Accident(positions=truth.accident.positions + off, time=late, score=score)
    return [found] if source.uniform() < 0.8 else []


def stored_run(
    dataset: DeepAccident,
    setup: EvaluationSetup,
    path: Path,
    selection: SampleSelection | None = None,
) -> tuple[EvaluationRun, Results]:
    """The same predictions, written as results and evaluated from there; by default of the split
    train.
    """
    selection = selection or default_selection(setup, "train")
    kind: ResultsTask = "accident" if setup.task == "warning" else setup.task
    grid = MotionLabelConfig().grid if kind == "motion" else None
    with ResultsWriter(path, kind, meta=META, grid=grid) as writer:
        for number, token in enumerate(selection.tokens(dataset)):
            prediction = _arguments(dataset, setup, token, np.random.default_rng(number))[0]
            if isinstance(prediction, DetectedBoxes):
                world_from_frame = dataset.world_from(token, setup.rules.frame)
                boxes = prediction.boxes.transform(world_from_frame, "world")
                prediction = DetectedBoxes(boxes=boxes, scores=prediction.scores)
            writer.add(token, prediction)
    results = read_results(path)
    run = evaluate_results(dataset, results, setup, selection, workers=1)
    return run.broken_down(BREAKDOWNS, Resampling(resamples=20)), results
