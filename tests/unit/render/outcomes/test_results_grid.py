"""Several results side by side: the truth and methods in rows, samples in columns."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from support.command_calls import invoke_command
from support.rendered_pixels import collections_of_kind

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, TokenError
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    Plan,
    box_truth,
    instances_of,
    read_results,
)
from deepaccident_devkit.evaluation.planning import planning_scene
from deepaccident_devkit.evaluation.results import Results, ResultsWriter
from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import render_results
from deepaccident_devkit.render.outcomes.results_grid import (
    named_results,
    pick_samples,
    shared_samples,
)

TIMES = np.arange(1, 7) * 0.5


def straight_plan(length: float) -> list[Plan]:
    return [Plan(times=TIMES, path=np.column_stack([TIMES / 3.0 * length, 0.0 * TIMES]))]


def recorded_plan(dataset: DeepAccident, sample: str) -> list[Plan]:
    """Plan the path that the agent drives; after the end of the recording it stands."""
    recorded = planning_scene(dataset, sample).recorded[:, :2]
    frames = np.minimum(np.rint(TIMES * 10).astype(int), len(recorded) - 1)
    return [Plan(times=TIMES, path=recorded[frames])]


def write(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for sample, prediction in predictions.items():
            writer.add(sample, prediction)
    return read_results(path)


@pytest.fixture(scope="module")
def planned_samples(da_motion: DeepAccident) -> list[str]:
    """A sample of each of the two scenarios, and a second one of the first."""
    tokens = da_motion.samples("train", "all")
    first, *others = [token for token in tokens if token.endswith("ego_vehicle/005")]
    return [first, first.replace("/005", "/003"), others[0]]


def plans(path: Path, samples: list[str], lengths: list[float]) -> Results:
    by_sample = {
        sample: straight_plan(length) for sample, length in zip(samples, lengths, strict=True)
    }
    return write(path, "planning", by_sample, meta={"method": path.stem})


def prediction_for(dataset: DeepAccident, sample: str, task: str) -> Any:
    accident: Any = box_truth(dataset, sample).accident
    if task == "motion":
        label = motion_labels(dataset, sample)
        return instances_of(label.instance, label.config.grid)
    if task == "detection":
        boxes = dataset.boxes(sample, "world")
        return DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    if task == "accident":
        return [Accident(positions=accident.positions + 2.0, time=accident.time, score=0.9)]
    return recorded_plan(dataset, sample)


@pytest.mark.parametrize("task", ["motion", "detection", "accident", "planning"])
def test_the_truth_stands_above_the_methods_of_every_task(
    da_motion: DeepAccident, sample: str, tmp_path: Path, task: Any
) -> None:
    prediction = prediction_for(da_motion, sample, task)
    opened = write(tmp_path / "results.json", task, {sample: prediction})

    figure = render_results(
        da_motion, [sample], {"ours": opened, "theirs": opened}, fig=detached_figure((4, 12))
    )

    truth, ours, theirs = figure.axes
    assert [ax.get_ylabel() for ax in figure.axes] == ["ground truth", "ours", "theirs"]
    assert truth.axis() == ours.axis() == theirs.axis()
    assert len(ours.lines) == len(theirs.lines)


def test_samples_are_in_columns_and_the_truth_has_no_prediction(
    da_motion: DeepAccident, planned_samples: list[str], tmp_path: Path
) -> None:
    results = {
        "short": plans(tmp_path / "short.json", planned_samples, [6.0, 6.0, 6.0]),
        "long": plans(tmp_path / "long.json", planned_samples, [30.0, 30.0, 30.0]),
    }

    figure = render_results(da_motion, planned_samples, results, fig=detached_figure((9, 9)))

    axes = np.array(figure.axes, dtype=object).reshape(3, 3)
    ends = [[farthest(ax) for ax in row] for row in axes[1:]]
    np.testing.assert_allclose(ends, [[6.0] * 3, [30.0] * 3])
    for column, sample in enumerate(planned_samples):
        recorded = planning_scene(da_motion, sample).recorded[:31, :2]
        paths = [path for path, _ in drawn_paths(axes[0, column])]
        assert any(np.array_equal(path, recorded) for path in paths)
        assert farthest(axes[0, column]) == 0


def drawn_paths(ax: Any) -> list[tuple[Any, float]]:
    """Return the positions and the line width of each path from above."""
    paths = []
    for lines in collections_of_kind(ax, LineCollection):
        widths = itertools.cycle(lines.get_linewidths())
        for path, width in zip(lines.get_paths(), widths, strict=False):
            paths.append((path.vertices, float(width)))
    return paths


def farthest(ax: Any) -> float:
    """Return the largest x of the predicted paths, which are the widest lines; 0 without any."""
    ends = [float(path[:, 0].max()) for path, width in drawn_paths(ax) if width == 2.4]
    return max(ends, default=0.0)


def test_samples_are_picked_by_the_first_score_or_by_the_difference(
    da_motion: DeepAccident, planned_samples: list[str], tmp_path: Path
) -> None:
    near, nearer, other = planned_samples
    good = {sample: recorded_plan(da_motion, sample) for sample in planned_samples}
    first = write(tmp_path / "first.json", "planning", {**good, other: straight_plan(90.0)})
    second = write(tmp_path / "second.json", "planning", {**good, nearer: straight_plan(95.0)})
    results = {"first": first, "second": second}

    def pick(name: Any) -> list[str]:
        return pick_samples(da_motion, results, name, workers=1)

    assert pick("worst")[0] == other
    assert pick("best")[-1] == other
    assert set(pick("differ")) == {other, nearer}
    assert near not in pick("differ")
    with pytest.raises(ChoiceError, match="two methods"):
        pick_samples(da_motion, {"first": first}, "differ", workers=1)


def test_results_are_called_by_their_method_unless_they_have_a_name(
    planned_samples: list[str], tmp_path: Path
) -> None:
    mine = plans(tmp_path / "mine.json", planned_samples, [1.0, 2.0, 3.0])
    nameless = write(tmp_path / "x.json", "planning", {planned_samples[0]: straight_plan(5.0)})
    alarms = write(tmp_path / "y.json", "accident", {planned_samples[0]: []})

    assert list(named_results([("", mine), ("b", mine)], None)) == ["mine", "b"]
    with pytest.raises(ChoiceError, match=r"x\.json: .*NAME="):
        named_results([("a", mine), ("", nameless)], None)
    with pytest.raises(ChoiceError, match=r"x\.json: .*'mine'"):
        named_results([("", mine), ("mine", nameless)], None)
    with pytest.raises(ChoiceError, match=r"accident results, and .* planning"):
        named_results([("", mine), ("b", alarms)], None)


def test_samples_that_a_method_lacks_are_refused(
    da_motion: DeepAccident, planned_samples: list[str], tmp_path: Path
) -> None:
    first, second, third = planned_samples
    a = write(tmp_path / "a.json", "planning", {first: straight_plan(5.0)})
    b = write(tmp_path / "b.json", "planning", {second: straight_plan(5.0)})
    both = plans(tmp_path / "c.json", planned_samples, [1.0, 1.0, 1.0])

    assert shared_samples({"both": both, "b": b}) == [second]
    with pytest.raises(EvaluationError, match=r"a\.json, .*b\.json: .*no sample in common"):
        shared_samples({"a": a, "b": b})
    with pytest.raises(TokenError, match=r"a\.json: has no prediction for"):
        render_results(da_motion, [third], {"both": both, "a": a}, fig=detached_figure((4, 9)))


@pytest.mark.slow
def test_the_command_draws_one_picture_of_all_results(
    da_motion: DeepAccident, planned_samples: list[str], tmp_path: Path
) -> None:
    path = plans(tmp_path / "a=b.json", planned_samples, [5.0, 6.0, 7.0]).path
    command = ("render", "evaluation", da_motion.dataroot, "--results", path)
    options = ("--size", "700x900", "--workers", 1, "--out")
    first, _, other = planned_samples

    named = ("--results", f"ours={path}")
    output = invoke_command(*command, *named, "--pick", "worst", *options, tmp_path / "out").output
    assert len(list((tmp_path / "out").iterdir())) == 1
    assert other in output

    output = invoke_command(*command, *options, tmp_path / "one.png").output
    assert f"wrote {tmp_path / 'one.png'} ({first})" in output
