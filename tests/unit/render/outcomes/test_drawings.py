"""Tasks draw themselves: plans, forecasts, warnings and tasks of plug-ins, with their verdicts."""

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle
from support.rendered_pixels import new_axes

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import Forecast, Plan
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnAlarm, DrawnPath
from deepaccident_devkit.evaluation.forecasting.truth import forecasting_truth
from deepaccident_devkit.evaluation.planning import planning_scene, trivial_plans
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render import render_evaluation
from deepaccident_devkit.render.outcomes.described import sample_drawing
from deepaccident_devkit.render.outcomes.drawings import (
    draw_drawing_in_camera,
    is_covered,
    ribbon,
)
from deepaccident_devkit.render.styles import COLLIDER_COLOR, PREDICTED_COLOR
from deepaccident_devkit.v2x.poses import camera_of


def straight_plan(length: float = 30.0) -> Plan:
    times = np.arange(1, 7) * 0.5
    return Plan(times=times, path=np.column_stack([times / 3.0 * length, 0.1 * times]))


def forecasts_of_truth(dataset: DeepAccident, sample: str) -> list[Forecast]:
    """Forecast, for each actor, that it stands and that it moves 3 m forward."""
    truth = forecasting_truth(dataset, sample)
    forecasts = []
    for actor, present in zip(truth.actor_id.tolist(), truth.present, strict=True):
        forward = present + np.array([3.0, 0.0])
        paths = np.stack([[present, present], [present, forward]])
        forecast = Forecast(
            actor_id=actor,
            times=np.array([0.5, 3.0]),
            paths=paths,
            probabilities=np.array([0.2, 0.8]),
        )
        forecasts.append(forecast)
    return forecasts


def view_points(points: Any, intrinsic: Any) -> Any:
    """Project as nuscenes-devkit's `view_points(points, view, normalize=True)` does."""
    projected = intrinsic @ points.T
    return (projected / projected[2:3])[:2].T


def test_a_drawn_plan_lies_where_nuscenes_view_points_puts_it(
    da: DeepAccident, approach_sample: str
) -> None:
    plan = straight_plan()
    camera = f"{approach_sample}/Camera_Front"
    points = np.column_stack([plan.path, np.zeros(len(plan.path))])
    optical_from_ego = da.ego_from(approach_sample, "Camera_Front").inverse()
    expected = view_points(optical_from_ego.apply(points), camera_of(da, camera).intrinsic)

    ax = new_axes((5, 5))
    draw_drawing_in_camera(da, approach_sample, plan.drawing(width=2.0), camera, ax)

    drawn = []
    for collection in ax.collections:
        color = collection.get_edgecolor()
        if len(color) and np.allclose(color[0, :3], to_rgba(PREDICTED_COLOR)[:3], atol=1e-3):
            drawn += [line.vertices for line in collection.get_paths()]
    vertices = np.concatenate(drawn)
    distances = np.linalg.norm(expected[:, None] - vertices, axis=-1).min(axis=1)
    assert distances.max() < 0.5


def test_a_plan_through_a_recorded_actor_has_its_contact_marked_at_its_time(
    da: DeepAccident, approach_sample: str
) -> None:
    scene = planning_scene(da, approach_sample)
    later = scene.footprint[2]  # in 0.2 s
    rows = np.flatnonzero(np.isfinite(later[:, 0]))
    nearest = rows[np.hypot(*later[rows, :2].T).argmin()]
    position = later[nearest, :2]
    plan = Plan(times=np.array([0.2, 3.0]), path=np.stack([position, position + 0.1]))

    described = sample_drawing(da, approach_sample, [plan], task="planning")

    (place,) = described.drawing.places
    assert 0 < place.time <= 0.21
    assert place.note == f"contact in {place.time:.1f} s"
    assert place.note in described.words
    (boxes,) = described.drawing.boxes
    ego, other = boxes.boxes
    for box in (ego, other):
        in_box = box.rotation_matrix.T @ (np.append(place.xy, 0.5) - box.center)
        assert (np.abs(in_box) <= box.size / 2 + 0.3).all()


def test_the_recorded_path_is_the_truth_of_a_plan(da: DeepAccident, approach_sample: str) -> None:
    scene = planning_scene(da, approach_sample)
    plan = trivial_plans(scene)["recorded"]

    planned, recorded = sample_drawing(da, approach_sample, [plan], task="planning").drawing.paths

    assert (planned.role, recorded.role) == ("predicted", "truth")
    assert planned.width == scene.size[1]
    count = len(recorded.xy)
    np.testing.assert_allclose(planned.xy[:count], recorded.xy, atol=1e-6)


def test_forecasts_have_a_past_a_truth_and_modes_by_probability(
    da: DeepAccident, approach_sample: str
) -> None:
    forecasts = forecasts_of_truth(da, approach_sample)

    drawing = sample_drawing(da, approach_sample, forecasts, task="forecasting").drawing

    roles = [path.role for path in drawing.paths]
    assert roles.count("predicted") == 2 * len(forecasts)
    assert {"past", "truth"} < {*roles}
    for path in drawing.paths:
        if path.role == "past":
            assert path.times[-1] == 0
            assert path.times[0] >= -1
    probabilities = [path.probability for path in drawing.paths if path.role == "predicted"]
    assert sorted({*probabilities}) == pytest.approx([0.25, 1.0])


@pytest.mark.parametrize(("score", "fires"), [(0.9, True), (0.1, False)])
def test_an_alarm_that_fires_has_a_border(
    da: DeepAccident, approach_sample: str, score: float, fires: bool
) -> None:
    drawing = Drawing(alarm=DrawnAlarm(score=score, fires=fires))
    ax = new_axes((5, 5))

    draw_drawing_in_camera(da, approach_sample, drawing, f"{approach_sample}/Camera_Front", ax)

    rectangles = [patch for patch in ax.patches if isinstance(patch, Rectangle)]
    is_border = [
        patch.get_width() == 1 and np.allclose(patch.get_edgecolor(), to_rgba(COLLIDER_COLOR))
        for patch in rectangles
    ]
    assert any(is_border) == fires
    assert any(np.isclose(patch.get_width(), 0.3 * score) for patch in rectangles)


def test_points_behind_boxes_are_covered_and_others_are_not() -> None:
    boxes = Boxes.from_arrays([[10.0, 0, 0]], [[4.0, 2, 2]], [0.3], frame="lidar")
    points = np.array([[20.0, 0, 0], [5.0, 0, 0], [20.0, 9, 0], [-20.0, 0, 0], [10.0, 0, 0]])

    assert is_covered(points, boxes).tolist() == [True, False, False, False, True]


def test_a_hidden_part_of_a_path_is_faint(da: DeepAccident, approach_sample: str) -> None:
    channel = "Camera_Front"
    boxes = da.boxes(approach_sample, "ego")
    ego_from_camera = da.ego_from(approach_sample, channel)
    lens = camera_of(da, f"{approach_sample}/{channel}")
    in_image = lens.boxes_in_image(boxes.transform(ego_from_camera.inverse(), channel))
    (row, *_) = np.flatnonzero(in_image & (boxes.actor_id != -100))
    start = boxes.center[row, :2]
    camera_xy = ego_from_camera.translation[:2]
    away = (start - camera_xy) / np.linalg.norm(start - camera_xy)
    behind = np.stack([start + away * 1.0, start + away * 6.0])
    path = DrawnPath(xy=behind, times=np.array([0.0, 1.0]), role="predicted")
    ax = new_axes((5, 5))

    camera = f"{approach_sample}/{channel}"
    draw_drawing_in_camera(da, approach_sample, Drawing(paths=(path,)), camera, ax)

    assert min(collection.get_alpha() for collection in ax.collections) < 0.3


def test_a_ribbon_has_the_width_of_the_vehicle() -> None:
    path = np.array([[0.0, 0], [2.0, 0], [2.0, 0], [4.0, 0]])

    outline = ribbon(path, 2.0)

    assert {abs(y) for y in outline[:, 1].tolist()} == {1.0}
    np.testing.assert_allclose(outline[0], outline[-1])


def test_a_prediction_for_another_task_is_refused(da: DeepAccident, approach_sample: str) -> None:
    with pytest.raises(ChoiceError, match="planning"):
        render_evaluation(da, approach_sample, [straight_plan()], task="forecasting")


def test_an_empty_list_is_for_the_task_that_draws_it(
    da: DeepAccident, approach_sample: str
) -> None:
    drawing = sample_drawing(da, approach_sample, [], task="forecasting").drawing
    assert {path.role for path in drawing.paths} == {"past", "truth"}
    assert sample_drawing(da, approach_sample, []).words.startswith("accident: ")
