"""Every task is drawn in cameras, from above, and in MCAP files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.mcap_reader import McapFile, read_mcap

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, Forecast, MotionOutput, Plan
from deepaccident_devkit.evaluation.forecasting.truth import forecasting_truth
from deepaccident_devkit.export.mcap import export_mcap
from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.render import detached_figure, render_evaluation
from deepaccident_devkit.render.outcomes import render_outcome_in_cameras

MCAP_TOPICS = {
    "motion": {"motion/points", "paths", "paths/points"},
    "accident": {"marks", "marks/points", "alarm"},
    "detection": {"boxes", "boxes/points"},
    "warning": {"marks", "marks/points", "alarm"},
    "planning": {"paths", "paths/points"},
    "forecasting": {"paths", "paths/points"},
}
"""Topics below `/ego_vehicle/prediction`."""


def make_prediction(dataset: DeepAccident, sample: str, task: str) -> Any:
    times = np.array([0.5, 3.0])
    path = np.array([[2.0, 0.0], [20.0, 1.0]])
    if task == "motion":
        labels = motion_labels(dataset, sample).to_present()
        frames = [np.roll(labels.instance[0], frame, axis=-1) for frame in range(5)]
        return MotionOutput(grid=labels.config.grid, instances=np.stack(frames)[None])
    if task == "detection":
        boxes = dataset.boxes(sample, "world")
        return DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    if task == "planning":
        return [Plan(times=times, path=path)]
    if task == "forecasting":
        actor = int(forecasting_truth(dataset, sample).actor_id[0])
        paths = np.stack([path, path + 1.0])
        return [Forecast(actor_id=actor, times=times, paths=paths, probabilities=[0.3, 0.7])]
    return [Accident(positions=path, time=0.5, score=0.9)]


def draw_in_cameras(dataset: DeepAccident, sample: str, prediction: Any, task: str) -> None:
    figure = render_outcome_in_cameras(
        dataset, sample, prediction, task=task, fig=detached_figure((10, 6))
    )
    assert len(figure.axes) == 6
    assert figure.legends


def draw_from_above(dataset: DeepAccident, sample: str, prediction: Any, task: str) -> None:
    figure = render_evaluation(dataset, sample, prediction, task=task, fig=detached_figure((10, 6)))
    assert len(figure.axes) == 2
    assert ": " in figure.get_suptitle()


@pytest.mark.parametrize("task", MCAP_TOPICS)
@pytest.mark.parametrize("draw", [draw_in_cameras, draw_from_above])
def test_every_task_has_pictures(
    da: DeepAccident, approach_sample: str, task: str, draw: Callable[..., None]
) -> None:
    draw(da, approach_sample, make_prediction(da, approach_sample, task), task)


@pytest.mark.parametrize("task", MCAP_TOPICS)
def test_every_task_is_in_mcap_files(
    da: DeepAccident, approach_sample: str, tmp_path: Path, task: str
) -> None:
    scenario = approach_sample.rsplit("/", 2)[0]
    prediction = make_prediction(da, approach_sample, task)
    path = export_mcap(
        da,
        scenario,
        tmp_path / "drawn.mcap",
        prediction={approach_sample: prediction},
        task=task,
        agents=["ego_vehicle"],
        channels=[],
        frames=[3],
    )

    recording: McapFile = read_mcap(path)

    start = "/ego_vehicle/prediction/"
    drawn = {topic.removeprefix(start) for topic in recording.messages if topic.startswith(start)}
    assert drawn >= MCAP_TOPICS[task]
    for topic in MCAP_TOPICS[task]:
        (message,) = recording.decoded(f"{start}{topic}")
        if topic.endswith("/points"):
            assert message.data
        elif topic == "alarm":
            assert message.value == pytest.approx(0.9)
        else:
            assert message.entities
    script = path.with_suffix(".rerun.py").read_text()
    for topic in MCAP_TOPICS[task]:
        if topic.endswith(("/points", "alarm")):
            assert f"'{start}{topic}'" in script
