"""Every task, also of a plug-in, is drawn in cameras, from above, in MCAP files, and replayed."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.asgi_client import get_response
from support.mcap_reader import McapFile, read_mcap
from support.replay_page import read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Forecast,
    MotionOutput,
    Plan,
    read_results,
)
from deepaccident_devkit.evaluation.forecasting.truth import forecasting_truth
from deepaccident_devkit.evaluation.results import ResultsWriter
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup, evaluator_class
from deepaccident_devkit.export.mcap import export_mcap
from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.render import detached_figure, render_evaluation
from deepaccident_devkit.render.outcomes import render_outcome_in_cameras

MCAP_TOPICS = {
    "motion": {"motion/points", "paths", "paths/points", "boxes"},
    "accident": {"marks", "marks/points", "alarm", "boxes", "paths"},
    "detection": {"boxes", "boxes/points"},
    "warning": {"marks", "marks/points", "alarm"},
    "planning": {"paths", "paths/points"},
    "forecasting": {"paths", "paths/points"},
    "counting": {"boxes", "boxes/points"},
}
"""Topics below `/ego_vehicle/prediction`."""
REPLAYED = {
    "motion": "lines",
    "accident": "places",
    "detection": "lines",
    "warning": "alarm",
    "planning": "lines",
    "forecasting": "lines",
    "counting": "lines",
}
"""What a replay has of each task's samples."""
PLUGIN_PAGE = Path(__file__).parents[4] / "docs" / "plugins.md"


@pytest.fixture(autouse=True)
def plugin_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the task `counting` of the example of docs/plugins.md."""
    page = PLUGIN_PAGE.read_text(encoding="utf-8")
    (source,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    module: dict[str, Any] = {"__name__": __name__}
    exec(source, module)  # noqa: S102 - the code of a page of this repository
    monkeypatch.setitem(TASKS, "counting", module["CountingEvaluator"])


def make_prediction(dataset: DeepAccident, sample: str, task: str) -> Any:
    times = np.array([0.5, 3.0])
    path = np.array([[2.0, 0.0], [20.0, 1.0]])
    if task == "motion":
        labels = motion_labels(dataset, sample).to_present()
        frames = [np.roll(labels.instance[0], frame, axis=-1) for frame in range(5)]
        return MotionOutput(grid=labels.config.grid, instances=np.stack(frames)[None])
    if task in ("detection", "counting"):
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
    assert figure.legends
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


def test_results_in_mcap_files_are_drawn_by_their_own_task(
    da: DeepAccident, approach_sample: str, tmp_path: Path
) -> None:
    with ResultsWriter(tmp_path / "forecasts.json", "forecasting") as writer:
        writer.add(approach_sample, [])
    path = export_mcap(
        da,
        approach_sample.rsplit("/", 2)[0],
        tmp_path / "drawn.mcap",
        prediction=read_results(tmp_path / "forecasts.json"),
        agents=["ego_vehicle"],
        channels=[],
        frames=[3],
    )
    topics = read_mcap(path).messages
    assert "/ego_vehicle/prediction/paths" in topics
    assert "/ego_vehicle/prediction/alarm" not in topics


@pytest.mark.parametrize("task", REPLAYED)
def test_every_task_is_replayed_in_the_explorer(
    da: DeepAccident, approach_sample: str, tmp_path: Path, task: str
) -> None:
    evaluator = evaluator_class(task)
    path = tmp_path / "predicted.json"
    kind: Any = evaluator.result_kinds[-1]
    with ResultsWriter(path, kind) as writer:
        writer.add(approach_sample, make_prediction(da, approach_sample, task))
    explorer = Explorer(da, results=[path])
    setup = EvaluationSetup(task=task, protocol=next(iter(evaluator.protocols)))
    vars(explorer.models["predicted"])["setup"] = setup  # as if a bundle had it
    scenario = approach_sample.rsplit("/", 2)[0]

    page = get_response(make_app(explorer), f"/scenario/{scenario}/?model=predicted")
    explorer.jobs.end()

    prediction = read_page_data(page.text)["prediction"]
    (sample,) = prediction["samples"]
    assert (sample["frame"], sample["agent"]) == (2, 0)
    assert sample[REPLAYED[task]]
    assert task in prediction["rule"]
