"""Make runs of each task on a small release, which pictures and reports are tested with."""

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
from deepaccident_devkit.geometry import Boxes
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
    """Evaluate predictions that are mostly right, and always the same for the same tokens."""
    evaluator = setup.evaluator()
    if setup.task in ("planning", "forecasting"):  # they look further ahead
        tokens = default_selection(setup, "train").tokens(dataset)[::3]
    for number, token in enumerate(tokens):
        evaluator.update(token, *_arguments(dataset, setup, token, np.random.default_rng(number)))

    attributes = sample_attributes(dataset, tokens)
    hashes = {
        sample.scenario: ScenarioHashes(label="1a", meta="2b", calib="3c")
        for sample in attributes.values()
    }
    resampling = Resampling(resamples=20)
    return EvaluationRun(
        setup=setup,
        selection=SampleSelection(split="train", horizon=setup.horizon),
        evaluator=evaluator,
        result=evaluator.compute(),
        partial=partial,
        attributes=attributes,
        times_to_impact={token: dataset.get("sample", token)["time_to_impact"] for token in tokens},
        breakdowns=tuple(breakdown(evaluator, attributes, by, resampling) for by in BREAKDOWNS),
        release=ReleaseInfo(dataroot="/data/DeepAccident", version="v1", scenarios=hashes),
        results=ResultsInfo(
            path="results", task=setup.task, fingerprint="5e5e", meta=meta, form=None
        ),
        **more,
    )


def _arguments(
    dataset: DeepAccident, setup: EvaluationSetup, token: str, generator: np.random.Generator
) -> tuple[Any, ...]:
    """Return the arguments of the evaluator's update, the prediction first."""
    if setup.task in ("planning", "forecasting"):
        from deepaccident_devkit.plugins.baselines import (  # a plug-in, which may be missing
            predict_forecasts,
            predict_plan,
        )

        if setup.task == "planning":
            prediction: Any = [predict_plan(dataset, token)]
        else:
            prediction = predict_forecasts(dataset, token)
        return prediction, *setup.evaluator().truth(dataset, token, None, setup.horizon)
    if setup.task == "detection":
        truth = detection_truth(dataset, token, setup.rules)
        return _detect_most(truth, generator), truth

    context = accident_context(dataset, token, setup.horizon, references=setup.task == "warning")
    if setup.protocol == "boxes" or setup.task == "warning":
        return _predict_accidents(context.truth, generator), None, context

    config = MotionLabelConfig(protocol=setup.rules.labels)
    label = dataset.motion_labels(token, config).to_present("bilinear")
    maps = np.roll(label.instance, generator.integers(-2, 3, 2), (1, 2))
    lost_instance = generator.integers(1, 8)
    output = instances_of(np.where(maps == lost_instance, 0, maps), label.config.grid)
    return (output, label) if setup.task == "motion" else (output, label, context)


def _detect_most(truth: Boxes, generator: np.random.Generator) -> DetectedBoxes:
    """Return about four of five true boxes, moved by about half a metre."""
    boxes = truth.select(generator.uniform(size=len(truth)) < 0.8)
    shift = generator.normal(0, 0.6, (len(boxes), 3)) * (1, 1, 0)
    scores = np.round(generator.uniform(size=len(boxes)), 2)
    return DetectedBoxes(boxes=replace(boxes, center=boxes.center + shift), scores=scores)


def _predict_accidents(truth: BoxTruth | None, generator: np.random.Generator) -> list[Accident]:
    """Return the true accident, mostly and somewhat off; sometimes one where none comes."""
    if truth is None or truth.accident is None:
        if generator.uniform() >= 0.3:
            return []
        return [Accident(positions=np.ones((2, 2)), time=0.5, score=0.3)]

    shift = generator.normal(0, 2.5, (2, 2))
    time = float(np.clip(truth.accident.time + generator.choice((-0.5, 0, 0, 0.5)), 0, None))
    score = round(float(generator.uniform(0.3, 1)), 2)
    accident = Accident(positions=truth.accident.positions + shift, time=time, score=score)
    return [accident] if generator.uniform() < 0.8 else []


def stored_run(
    dataset: DeepAccident,
    setup: EvaluationSetup,
    path: Path,
    selection: SampleSelection | None = None,
) -> tuple[EvaluationRun, Results]:
    """Write the same predictions as results and evaluate them from there.

    The samples are of the split train unless `selection` names others.
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
