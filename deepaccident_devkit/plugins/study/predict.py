"""What a row predicts: by a model, also with spoilt inputs, by a baseline, or what needs no thought."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput, foreseen_accident
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.baselines import (
    detected_accidents,
    predict_accidents,
    predict_detections,
    predict_motion,
)
from deepaccident_devkit.plugins.study.recipe import StudyRow
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.cooperation import visible_actors

# Of an item of `V2XDataset`, what is the ego's or no agent's; all else has a place for each agent.
_OWN: Final = ("token", "agents", "agent_valid", "world_from_ego", "augmentation", "files_missing")
# Of a sample: motion, accidents, and boxes in world.
Predicted = tuple[MotionOutput, list[Accident], DetectedBoxes]


def predictions_of(
    row: StudyRow,
    weights: Path | None,
    device: str,
    dataset: Dataset,
    tokens: Sequence[str],
    labels: MotionLabelConfig,
) -> Iterator[tuple[str, Predicted]]:
    """Predict samples, one after another; yields their tokens, too.

    Args:
        row: what predicts.
        weights: of a row that has some.
        device: where a model is.
        dataset: the release.
        tokens: of the samples.
        labels: of which motion is predicted.

    Raises:
        ConfigError: the weights were trained for other labels, or latency is longer than a sample's past.
        NotAvailableError: there is no other pair of scenarios to take partners from.
        DeepAccidentError: as of `model.predictions`, or of the baselines.
    """
    if weights is not None:
        yield from _by_model(row, weights, device, dataset, tokens, labels)
        return
    for token in tokens:
        yield token, _without_model(row, dataset, token, labels)


def _without_model(
    row: StudyRow, dataset: Dataset, token: str, labels: MotionLabelConfig
) -> Predicted:
    step, seeing = labels.step * FRAME_PERIOD, dict[str, Any](agents=row.cooperating, link=row.link)
    if row.baseline is not None:
        motion = predict_motion(dataset, token, model=row.baseline, config=labels, **seeing)
        ahead = predict_accidents(
            dataset, token, model=row.baseline, horizon=labels.future_frames * step, **seeing
        )
        return motion, ahead, predict_detections(dataset, token, **seeing)
    if row.trivial == "labels":
        told = motion_labels(dataset, token, replace(labels, agents=row.cooperating)).to_present()
        seen = {OWN_BOX_ID, *visible_actors(dataset, token, **seeing).tolist()}
        known = [
            number for actor, number in told.id_map.items() if actor in seen
        ]  # not who comes into sight later
        motion = MotionOutput(
            grid=labels.grid,
            instances=np.where(np.isin(told.instance, known), told.instance, 0)[None],
        )
        foreseen = foreseen_accident(motion, step=step, labels=str(labels.protocol))
        return (
            motion,
            [] if foreseen is None else [foreseen],
            predict_detections(dataset, token, **seeing),
        )
    maps = np.full(
        (1, labels.label_frames, *labels.grid.shape), row.trivial == "everything", dtype=np.int32
    )
    empty = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    return (
        MotionOutput(grid=labels.grid, instances=maps),
        [],
        DetectedBoxes(boxes=empty, scores=np.zeros(0)),
    )


def _by_model(
    row: StudyRow,
    weights: Path,
    device: str,
    dataset: Dataset,
    tokens: Sequence[str],
    labels: MotionLabelConfig,
) -> Iterator[tuple[str, Predicted]]:
    from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions
    from deepaccident_devkit.plugins.model.results import prediction_of
    from deepaccident_devkit.plugins.model.training_run import one_thread
    from deepaccident_devkit.training.torch import V2XDataset, collate

    model = load_model(weights).to(device).eval()
    if (learned := model.config.labels_protocol) != labels.protocol:
        raise ConfigError(
            f"{weights}: was trained with the labels {learned}; give `labels: {learned}` in the recipe's `test`"
        )
    config = PredictConfig(agents=row.cooperating, link=row.link, device=device)
    if row.control is None:
        found = predictions(model, dataset, tokens, config)
    else:
        given = model.config.inputs(config.agents, link=config.link)
        items: Any = V2XDataset(dataset, tokens, given)
        foreign: Any = (
            V2XDataset(dataset, strangers_of(tokens), given) if row.control == "strangers" else None
        )
        changed = (
            blanked(items[at]) if foreign is None else with_strangers(items[at], foreign[at])
            for at in range(len(items))
        )
        found = (prediction_of(model, collate([item]), config) for item in changed)
    with one_thread():
        for each in found:
            ahead = (
                each.accidents
                if row.baseline is None
                else detected_accidents(
                    dataset, each.token, each.boxes, horizon=model.config.horizon
                )
            )
            yield each.token, (each.motion, ahead, each.boxes)


def strangers_of(tokens: Sequence[str]) -> list[str]:
    """For each sample one at the same place in the list of another pair's scenario, whose partners take part in it.

    Raises NotAvailableError: all are of one pair.
    """
    scenarios: dict[str, list[str]] = {}
    for token in tokens:
        scenarios.setdefault(scenario_of(token), []).append(token)
    names, chosen = list(scenarios), []
    for at, name in enumerate(names):
        other = next(
            (each for each in names[at:] + names[:at] if cluster_of(each) != cluster_of(name)), None
        )
        if other is None:
            raise NotAvailableError(
                f"{name}: there is no other pair to take strangers from; test on several pairs"
            )
        chosen += [
            scenarios[other][min(rank, len(scenarios[other]) - 1)]
            for rank in range(len(scenarios[name]))
        ]
    return chosen


def blanked(item: Mapping[str, Any]) -> dict[str, Any]:
    """An item of `V2XDataset` with all images black, and no point in any cloud."""
    images = {name: item[name] * 0 for name in ("images",) if name in item}
    points = {
        name: [[cloud[:0] for cloud in each] for each in item[name]]
        for name in ("points",)
        if name in item
    }
    return {**item, **images, **points}


def with_strangers(item: Mapping[str, Any], stranger: Mapping[str, Any]) -> dict[str, Any]:
    """An item whose partners' sensors and poses are those of another item's agents with the same names."""
    changed = {
        name: copy(value) if isinstance(value, list) else value.clone()
        for name, value in item.items()
        if name not in _OWN
    }
    for slot, name in enumerate(item["agents"]):
        if slot and name in stranger["agents"]:
            for key, values in changed.items():
                values[slot] = stranger[key][stranger["agents"].index(name)]
    return {**item, **changed}
