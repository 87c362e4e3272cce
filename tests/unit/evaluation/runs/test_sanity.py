"""`check_sanity`: each classic mistake is named, and no other; right predictions and baselines do
not raise suspicion.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.memory_results import MemoryResults
from support.planning_scenes import blocked_ego_scene

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.forecasting import Forecast, forecasting_truth
from deepaccident_devkit.evaluation.planning import (
    Plan,
    PlanningScene,
    planning_scene,
    trivial_plans,
)
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.runs import default_selection
from deepaccident_devkit.evaluation.runs import sanity as sanity_module
from deepaccident_devkit.evaluation.runs.sanity import (
    SampleEvidence,
    SanityReport,
    check_sanity,
    class_tally,
    label_free_facts,
    sum_tallies,
    suspect_mistakes,
    tallies_of,
    tally_of,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.motion import MotionHeads
from deepaccident_devkit.plugins.baselines import (
    predict_accidents,
    predict_detections,
    predict_forecasts,
    predict_motion,
    predict_plan,
)

pytestmark = pytest.mark.slow

Change = Callable[[DeepAccident, str, Any], Any]
"""A release, a sample's token and its prediction → the prediction with a mistake."""
AXIS_MISTAKES = {
    "x mirrored": [[-1, 0], [0, 1]],
    "y mirrored": [[1, 0], [0, -1]],
    "x and y mirrored": [[-1, 0], [0, -1]],
    "x and y swapped": [[0, 1], [1, 0]],
    "x and y swapped and mirrored": [[0, -1], [-1, 0]],
    "turned left": [[0, -1], [1, 0]],
    "turned right": [[0, 1], [-1, 0]],
}
"""Matrix from true to predicted x, y, by the mistake's name."""


TASKS_BY_KIND = {
    "maps": "motion",
    "heads": "motion",
    "accidents": "accident",
    "boxes": "detection",
    "plans": "planning",
    "forecasts": "forecasting",
}


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Select samples of the accident and its twin: all agents, within the last 2 s."""
    return da_motion.samples("train", "evaluate", "paper", scope="all")[::3]


@pytest.fixture(scope="module")
def right_predictions(da_motion: DeepAccident, tokens: list[str]) -> dict[str, dict[str, Any]]:
    """Make perfect predictions of each kind, by token, with scores that mean nothing."""
    right: dict[str, dict[str, Any]] = {kind: {} for kind in TASKS_BY_KIND}
    for token in tokens:
        label = da_motion.motion_labels(token).to_present("bilinear")
        grid = label.config.grid
        right["maps"][token] = instances_of(label.instance, grid)
        right["heads"][token] = MotionOutput(grid=grid, heads=(MotionHeads.from_labels(label),))
        boxes = da_motion.boxes(token, "world")
        boxes = boxes.select(boxes.actor_id >= 0)
        scores = np.linspace(0.1, 0.9, len(boxes))
        right["boxes"][token] = DetectedBoxes(boxes=boxes, scores=scores)

    for number, token in enumerate(da_motion.samples("train", "evaluate", "paper", scope="all")):
        truth = accident_context(da_motion, token, 2.0).truth
        accidents = [] if truth is None or truth.accident is None else [truth.accident]
        score = 1 / (1 + number)
        right["accidents"][token] = [replace(accident, score=score) for accident in accidents]

    vehicle_tokens = samples_of_vehicles(da_motion)
    for token in vehicle_tokens:
        right["plans"][token] = [recorded_plan(da_motion, token)]

    for token in vehicle_tokens[::7]:
        right["forecasts"][token] = recorded_forecasts(da_motion, token)

    return right


def samples_of_vehicles(dataset: DeepAccident) -> list[str]:
    setup = EvaluationSetup(task="planning", protocol="clean")
    return default_selection(setup, "train").tokens(dataset)


def recorded_plan(dataset: DeepAccident, token: str) -> Plan:
    recorded = trivial_plans(planning_scene(dataset, token))["recorded"]
    return replace(
        recorded, times=recorded.times[4::5], path=recorded.path[4::5], yaw=recorded.yaw[4::5]
    )


def recorded_forecasts(dataset: DeepAccident, token: str) -> list[Forecast]:
    """Return each actor's recorded path every half second, up to its first gap."""
    truth = forecasting_truth(dataset, token)
    forecasts = []
    for actor, path in zip(truth.actor_id.tolist(), truth.path[:, 4:30:5], strict=True):
        is_known = np.isfinite(path[:, 0])
        is_known = is_known & (np.cumsum(~is_known) == 0)
        if is_known.any():
            times = np.arange(1, 7)[is_known] / 2
            paths = path[None, is_known]
            forecasts.append(
                Forecast(actor_id=actor, times=times, paths=paths, probabilities=[1.0])
            )

    return forecasts


def check_predictions(
    dataset: DeepAccident, kind: str, predictions: dict[str, Any]
) -> SanityReport:
    task: Any = TASKS_BY_KIND[kind]
    protocols = {"accident": "boxes", "planning": "clean", "forecasting": "clean"}
    setup = EvaluationSetup(task=task, protocol=protocols.get(task, "released"))
    return check_sanity(dataset, MemoryResults(task, predictions), setup, list(predictions))


def change_maps(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, __, output: instances_of(
        np.ascontiguousarray(change(output.instances[-1])), output.grid
    )


def turn_maps(matrix: list[list[int]]) -> Change:
    """Move the cell at x, y to where the matrix takes it; rows are y, columns x, both rising."""
    (x_from_x, x_from_y), (y_from_x, y_from_y) = matrix
    if x_from_x and y_from_y:
        return change_maps(lambda maps: maps[:, ::y_from_y, ::x_from_x])
    return change_maps(lambda maps: maps.swapaxes(1, 2)[:, ::y_from_x, ::x_from_y])


def change_segmentation(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def change_output(_: DeepAccident, __: str, output: MotionOutput) -> MotionOutput:
        (heads,) = output.heads or ()
        return replace(output, heads=(replace(heads, segmentation=change(heads.segmentation)),))

    return change_output


def change_boxes(**changes: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change fields of the boxes, each by its own function."""

    def change_detected(_: DeepAccident, __: str, detected: DetectedBoxes) -> DetectedBoxes:
        boxes = detected.boxes
        fields = {name: change(getattr(boxes, name)) for name, change in changes.items()}
        return replace(detected, boxes=replace(boxes, **fields))

    return change_detected


def change_centers(change: Callable[[np.ndarray, Any, Any], np.ndarray]) -> Change:
    """Change the centres in the world, given the agent's poses: ego and LiDAR."""

    def change_detected(
        dataset: DeepAccident, token: str, detected: DetectedBoxes
    ) -> DetectedBoxes:
        world_from_ego = dataset.world_from(token, "ego")
        world_from_lidar = dataset.world_from(token, "lidar")
        center = change(detected.boxes.center, world_from_ego, world_from_lidar)
        return replace(detected, boxes=replace(detected.boxes, center=center))

    return change_detected


def change_height(change: Callable[[Boxes], np.ndarray]) -> Change:
    def change_detected(_: DeepAccident, __: str, detected: DetectedBoxes) -> DetectedBoxes:
        center = np.column_stack([detected.boxes.center[:, :2], change(detected.boxes)])
        return replace(detected, boxes=replace(detected.boxes, center=center))

    return change_detected


def change_paths(
    change: Callable[[np.ndarray, np.ndarray, Any], tuple[np.ndarray, np.ndarray]],
) -> Change:
    """Change times and positions (…, T, 2) of plans or forecasts, given the ego's pose."""

    def change_predictions(dataset: DeepAccident, token: str, predictions: list[Any]) -> list[Any]:
        world_from_ego = dataset.world_from(token, "ego")
        changed_predictions = []
        for prediction in predictions:
            name = "path" if isinstance(prediction, Plan) else "paths"
            times, path = change(prediction.times, getattr(prediction, name), world_from_ego)
            changed_predictions.append(replace(prediction, times=times, **{name: path}))

        return changed_predictions

    return change_predictions


def paths_in_world(
    times: np.ndarray, path: np.ndarray, world_from_ego: Any
) -> tuple[np.ndarray, np.ndarray]:
    flat = path.reshape(-1, 2)
    world = world_from_ego.apply(np.column_stack([flat, np.zeros(len(flat))]))[:, :2]
    return times, world.reshape(path.shape)


def paths_one_step_late(
    times: np.ndarray, path: np.ndarray, _: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Put the present first, under the time of the first step.

    Forecasts do not start at 0: they keep their paths, at later times.
    """
    if path.ndim == 3:
        return times + 0.5, path
    return times, np.vstack([np.zeros(2), path[:-1]])


def steps_instead_of_positions(
    times: np.ndarray, path: np.ndarray, _: Any
) -> tuple[np.ndarray, np.ndarray]:
    previous = 2 * path[..., :1, :] - path[..., 1:2, :]
    return times, np.diff(path, axis=-2, prepend=previous)


def change_yaw(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, __, plans: [replace(plan, yaw=change(plan.yaw)) for plan in plans]


PATH_MISTAKES: dict[str, Change] = {
    **{
        name: change_paths(
            lambda times, path, _, matrix=matrix: (times, path @ np.transpose(matrix))
        )
        for name, matrix in AXIS_MISTAKES.items()
    },
    "world frame for ego frame": change_paths(paths_in_world),
    "steps for places": change_paths(steps_instead_of_positions),
    "one step late": change_paths(paths_one_step_late),
    "times in frames": change_paths(lambda times, path, _: (10 * times, path)),
    "times in milliseconds": change_paths(lambda times, path, _: (1000 * times, path)),
}
"""Mistakes that both plans and forecasts can have."""
CURVE_MISTAKES: dict[str, Change] = {
    **{
        name: PATH_MISTAKES[name]
        for name in AXIS_MISTAKES
        if name not in ("x mirrored", "turned left", "turned right")
    },
    "yaw in degrees": change_yaw(np.rad2deg),
    "yaw clockwise": change_yaw(np.negative),
    "yaw clockwise from y": change_yaw(lambda yaw: np.pi / 2 - yaw),
}
"""Mistakes of plans that do not show, or look like another one, on a straight path."""


def change_axes_in_ego(matrix: list[list[int]]) -> Change:
    rotation = np.eye(3)
    rotation[:2, :2] = matrix
    return change_centers(
        lambda center, ego, _: ego.apply(ego.inverse().apply(center) @ rotation.T)
    )


def yaw_in_degrees(_: DeepAccident, __: str, detected: DetectedBoxes) -> DetectedBoxes:
    boxes = detected.boxes
    return DetectedBoxes.from_arrays(
        boxes.center,
        boxes.size,
        np.rad2deg(boxes.yaw),
        detected.scores,
        category=boxes.category,
        frame="world",
    )


def boxes_one_step_late(dataset: DeepAccident, token: str, _: DetectedBoxes) -> DetectedBoxes:
    recording, frame = token.rsplit("/", 1)
    boxes = dataset.boxes(f"{recording}/{int(frame) - 5:03d}", "world")
    return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 0.9, len(boxes)))


def change_accidents(**changes: Callable[[Any], Any]) -> Change:
    """Change fields of the accidents, each by its own function."""

    def change_accident(accident: Accident) -> Accident:
        fields = {name: change(getattr(accident, name)) for name, change in changes.items()}
        return replace(accident, **fields)

    return lambda _, __, accidents: [change_accident(accident) for accident in accidents]


def accidents_in_world(
    dataset: DeepAccident, token: str, accidents: list[Accident]
) -> list[Accident]:
    world_from_ego = dataset.world_from(token, "ego")
    moved_accidents = []
    for accident in accidents:
        positions = np.column_stack([accident.positions, np.zeros(2)])
        moved_accidents.append(replace(accident, positions=world_from_ego.apply(positions)[:, :2]))

    return moved_accidents


def reorder_sizes(names: Sequence[str]) -> Change:
    columns = [("length", "width", "height").index(name) for name in names]
    return change_boxes(size=lambda size: size[:, columns])


PLANTED_MISTAKES: dict[tuple[str, str], Change] = {
    **{("maps", name): turn_maps(matrix) for name, matrix in AXIS_MISTAKES.items()},
    ("maps", "frames reversed"): change_maps(lambda maps: maps[::-1]),
    ("maps", "one step late"): change_maps(lambda maps: maps[[0, 0, 1, 2, 3]]),
    ("maps", "all 14 examined predictions are empty"): change_maps(np.zeros_like),
    ("heads", "all values of the heads' segmentation are between 0 and 1"): change_segmentation(
        lambda logits: 1 / (1 + np.exp(5 - logits))
    ),
    **{
        ("accidents", name): change_accidents(
            positions=lambda positions, matrix=matrix: positions @ np.transpose(matrix)
        )
        for name, matrix in AXIS_MISTAKES.items()
    },
    ("accidents", "world frame for ego frame"): accidents_in_world,
    ("accidents", "frames reversed"): change_accidents(time=lambda time: 2 - time),
    ("accidents", "one step late"): change_accidents(time=lambda time: time + 0.5),
    ("accidents", "all 20 scores are 1"): change_accidents(score=lambda _: 1.0),
    ("accidents", "all 40 examined predictions are empty"): lambda _, __, ___: [],
    **{("boxes", name): change_axes_in_ego(matrix) for name, matrix in AXIS_MISTAKES.items()},
    ("boxes", "ego frame for world frame"): change_centers(
        lambda center, ego, _: ego.inverse().apply(center)
    ),
    ("boxes", "LiDAR frame for world frame"): change_centers(
        lambda center, _, lidar: lidar.inverse().apply(center)
    ),
    ("boxes", "LiDAR frame for ego frame"): change_centers(
        lambda center, ego, lidar: ego.apply(lidar.inverse().apply(center))
    ),
    ("boxes", "ego frame for LiDAR frame"): change_centers(
        lambda center, ego, lidar: lidar.apply(ego.inverse().apply(center))
    ),
    ("boxes", "all 14 examined predictions are empty"): lambda _, __, detected: DetectedBoxes(
        boxes=detected.boxes.select(np.arange(0)), scores=detected.scores[:0]
    ),
    ("boxes", "one step late"): boxes_one_step_late,
    **{
        ("boxes", f"sizes in the order {', '.join(names)}"): reorder_sizes(names)
        for names in list(permutations(("length", "width", "height")))[1:]
    },
    ("boxes", "half sizes"): change_boxes(size=lambda size: size / 2),
    ("boxes", "double sizes"): change_boxes(size=lambda size: 2 * size),
    ("boxes", "sizes do not fit"): change_boxes(size=lambda size: 100 * size),
    ("boxes", "z of the lower face"): change_height(
        lambda boxes: boxes.center[:, 2] - boxes.size[:, 2] / 2
    ),
    ("boxes", "z of the upper face"): change_height(
        lambda boxes: boxes.center[:, 2] + boxes.size[:, 2] / 2
    ),
    ("boxes", "heights do not fit"): change_height(lambda boxes: boxes.center[:, 2] - 5),
    ("boxes", "velocities per frame"): change_boxes(velocity=lambda velocity: velocity / 10),
    ("boxes", "velocities per step"): change_boxes(velocity=lambda velocity: velocity / 2),
    ("boxes", "headings look random"): yaw_in_degrees,
    ("boxes", "classes swapped"): change_boxes(
        category=lambda category: np.array([1, 2, 3, 4, 5, 0])[category]
    ),
    **{("forecasts", name): change for name, change in PATH_MISTAKES.items()},
    **{
        ("plans", name): change
        for name, change in PATH_MISTAKES.items()
        if name not in CURVE_MISTAKES
    },
    ("plans", "one step early"): change_paths(
        lambda times, path, _: (times, np.vstack([path[1:], 2 * path[-1] - path[-2]]))
    ),
    ("plans", "yaw from y"): change_yaw(lambda yaw: yaw - np.pi / 2),
    ("plans", "yaw backwards"): change_yaw(lambda yaw: yaw - np.pi),
    ("plans", "headings look random"): change_yaw(lambda yaw: yaw + np.pi / 3),
    ("forecasts", "all 8 examined predictions are empty"): lambda _, __, ___: [],
}


@dataclass(frozen=True)
class FixedLoader:
    """A loader that gives the same plans and scene for each sample."""

    dataset: Any
    results: Any
    plans: list[Plan]
    scene: PlanningScene
    places: None = None

    def __call__(self, _: str) -> tuple[Any, ...]:
        return self.plans, self.scene


@pytest.mark.parametrize(("kind", "mistake"), PLANTED_MISTAKES)
def test_each_mistake_is_named_as_exactly_that_one(
    da_motion: DeepAccident,
    right_predictions: dict[str, dict[str, Any]],
    kind: str,
    mistake: str,
) -> None:
    change = PLANTED_MISTAKES[kind, mistake]
    predictions = {
        token: change(da_motion, token, prediction)
        for token, prediction in right_predictions[kind].items()
    }
    report = check_predictions(da_motion, kind, predictions)

    (warning,) = report.warnings
    assert warning.startswith(mistake)
    assert f"\nwarning: {warning}" in report.to_text()
    assert report.to_text().endswith("there is too little to compare.") == (not report.sought)


@pytest.mark.parametrize(
    "mistake", ["", *PATH_MISTAKES, *CURVE_MISTAKES, "yaw from y", "yaw backwards"]
)
def test_mistakes_of_plans_on_curves(monkeypatch: pytest.MonkeyPatch, mistake: str) -> None:
    """Plan for an ego that turns left at 8 m/s, by 23° a second, 50 m beside the world's origin."""
    times = np.arange(61) / 10
    yaw = 0.4 * times
    recorded = np.column_stack([20 * np.sin(yaw), 20 * (1 - np.cos(yaw)), yaw])
    scene = replace(blocked_ego_scene(8), recorded=recorded)
    ego = SE3.from_yaw(0.7, (50.0, 30.0, 0.0))
    dataset: Any = SimpleNamespace(world_from=lambda _, __: ego, places=())

    plans = [Plan(times=times[5:31:5], path=recorded[5:31:5, :2], yaw=yaw[5:31:5])]
    if mistake:
        changes = {**PATH_MISTAKES, **CURVE_MISTAKES}
        for name in ("yaw from y", "yaw backwards"):
            changes[name] = PLANTED_MISTAKES["plans", name]
        plans = changes[mistake](dataset, "", plans)
    results: Any = MemoryResults("planning", {f"{number}": plans for number in range(20)})
    loader = FixedLoader(dataset, results, plans, scene)
    monkeypatch.setattr(sanity_module, "SampleLoader", lambda *_: loader)

    setup = EvaluationSetup(task="planning", protocol="clean")
    report = check_sanity(dataset, results, setup, list(results.predictions))
    named_mistakes = [warning.partition(":")[0] for warning in report.warnings]
    assert named_mistakes == ([mistake] if mistake else [])
    assert report.samples == 20


@pytest.mark.parametrize("kind", TASKS_BY_KIND)
def test_right_predictions_raise_no_suspicion(
    da_motion: DeepAccident, right_predictions: dict[str, dict[str, Any]], kind: str
) -> None:
    report = check_predictions(da_motion, kind, right_predictions[kind])

    assert report.warnings == ()
    assert "\nNo mistake found. Checked: x mirrored, " in report.to_text()
    assert report.sought
    assert json.loads(json.dumps(report.as_dict(), allow_nan=False))["warnings"] == []


def test_the_last_of_several_heads_counts(
    da_motion: DeepAccident, right_predictions: dict[str, dict[str, Any]]
) -> None:
    mirror = change_segmentation(
        lambda logits: np.ascontiguousarray(1 / (1 + np.exp(5 - logits[..., ::-1])))
    )
    predictions = {}
    for token, output in right_predictions["heads"].items():
        mirrored = mirror(da_motion, token, output)
        predictions[token] = replace(output, heads=(*mirrored.heads, *output.heads))

    assert check_predictions(da_motion, "heads", predictions).warnings == ()


def predict_changed_labels(
    change: Callable[[np.ndarray], np.ndarray],
) -> Callable[[DeepAccident, str], MotionOutput]:
    """Return a predictor of perfect maps that are changed."""

    def predict(dataset: DeepAccident, token: str) -> MotionOutput:
        label = dataset.motion_labels(token)
        changed_maps = change(label.to_present("bilinear").instance)
        return instances_of(changed_maps, label.config.grid)

    return predict


def change_speed(plan: Plan, factor: float) -> Plan:
    return replace(plan, path=plan.poses(factor * plan.times)[:, :2])


def move_boxes(detected: DetectedBoxes) -> DetectedBoxes:
    center = detected.boxes.center + np.array([30, 0, 0])
    return replace(detected, boxes=replace(detected.boxes, center=center))


HONEST_PREDICTIONS: dict[str, tuple[str, Callable[[DeepAccident, str], Any]]] = {
    "baseline's maps": ("maps", predict_motion),
    "baseline's maps, turning": (
        "maps",
        lambda da, token: predict_motion(da, token, model="constant_turn_rate"),
    ),
    "nobody moves": ("maps", predict_changed_labels(lambda maps: maps[[0, 0, 0, 0, 0]])),
    "half as fast": ("maps", predict_changed_labels(lambda maps: maps[[0, 0, 1, 1, 2]])),
    "slow at first": ("maps", predict_changed_labels(lambda maps: maps[[0, 0, 1, 2, 2]])),
    "twice as fast": ("maps", predict_changed_labels(lambda maps: maps[[0, 2, 4, 4, 4]])),
    "elsewhere": ("maps", predict_changed_labels(lambda maps: np.roll(maps, (37, 61), (1, 2)))),
    "baseline's accidents": ("accidents", predict_accidents),
    "baseline's accidents, all agents": (
        "accidents",
        lambda da, token: predict_accidents(da, token, agents=None),
    ),
    "the same accident always": (
        "accidents",
        lambda _, token: [
            Accident(positions=np.array([[10, 0], [13, 1]]), time=1.0, score=len(token))
        ],
    ),
    "baseline's plans": ("plans", lambda da, token: [predict_plan(da, token)]),
    "standing": ("plans", lambda da, token: [predict_plan(da, token, model="standing")]),
    "slow plans": ("plans", lambda da, token: [change_speed(recorded_plan(da, token), 0.8)]),
    "fast plans": ("plans", lambda da, token: [change_speed(recorded_plan(da, token), 1.2)]),
    "baseline's forecasts": ("forecasts", predict_forecasts),
    "standing actors": (
        "forecasts",
        lambda da, token: predict_forecasts(da, token, model="standing"),
    ),
    "boxes elsewhere": (
        "boxes",
        lambda da, token: move_boxes(predict_detections(da, token, agents=None)),
    ),
    "baseline's boxes": ("boxes", predict_detections),
    "baseline's boxes, all agents": (
        "boxes",
        lambda da, token: predict_detections(da, token, agents=None),
    ),
}


@pytest.mark.parametrize("name", HONEST_PREDICTIONS)
def test_baselines_and_bad_predictions_raise_no_suspicion(
    da_motion: DeepAccident, tokens: list[str], name: str
) -> None:
    kind, predict = HONEST_PREDICTIONS[name]
    if kind in ("plans", "forecasts"):
        step = 7 if kind == "forecasts" else 1
        tokens = samples_of_vehicles(da_motion)[::step]
    predictions = {token: predict(da_motion, token) for token in tokens}

    report = check_predictions(da_motion, kind, predictions)
    assert [warning for warning in report.warnings if "scores" not in warning] == []


def test_too_few_samples_give_no_verdict(
    da_motion: DeepAccident, right_predictions: dict[str, dict[str, Any]]
) -> None:
    token = max(right_predictions["plans"])  # at the end of the recording
    predictions = {token: right_predictions["plans"][token]}
    report = check_predictions(da_motion, "plans", predictions)

    assert (report.sought, report.warnings) == ((), ())
    assert report.to_text().endswith("No verdict: there is too little to compare.")


def test_no_samples_are_refused(
    da_motion: DeepAccident, right_predictions: dict[str, dict[str, Any]]
) -> None:
    results = MemoryResults("motion", right_predictions["maps"])
    setup = EvaluationSetup(task="motion")

    assert_raises(
        (
            lambda: check_sanity(da_motion, results, setup, []),
            EvaluationError,
            "there is no sample to compare",
        ),
    )


@pytest.mark.parametrize(
    ("name", "task", "undone", "predicted", "total", "suspected"),
    [
        ("x mirrored", "motion", 100, 0, 500, True),
        ("x mirrored", "motion", 99, 0, 400, False),  # too few cells
        ("x mirrored", "motion", 100, 0, 501, False),  # too small a share
        ("x mirrored", "motion", 200, 100, 500, True),
        ("x mirrored", "motion", 200, 101, 500, False),  # not twice as many
        ("x mirrored", "accident", 4, 0, 20, True),
        ("x mirrored", "accident", 3, 0, 3, False),
        ("x mirrored", "detection", 10, 0, 10, True),
        ("x mirrored", "detection", 9, 0, 9, False),
        ("one step late", "detection", 40, 20, 100, True),
        ("one step late", "detection", 39, 0, 100, False),
        ("sizes in the order width, length, height", "detection", 50, 25, 100, True),
        ("sizes in the order width, length, height", "detection", 49, 0, 100, False),
    ],
)
def test_a_mistake_is_suspected_from_a_share_of_hits_on(
    name: str, task: str, undone: int, predicted: int, total: int, *, suspected: bool
) -> None:
    half = {name: tally_of(undone / 2, predicted / 2, total / 2)}
    warnings = list(suspect_mistakes(sum_tallies([half, half]), task))

    assert len(warnings) == suspected

    end = (
        f"({undone / total * 100:.0f} % of the truth matches when corrected, "
        f"{predicted / total * 100:.0f} % as given)"
    )
    for warning in warnings:
        assert warning.startswith(f"{name}: ")
        assert warning.endswith(end)


def test_the_worst_measurement_counts_and_the_best_mistake_of_a_group() -> None:
    x_mirrored = np.array([[80.0, 20.0], [100.0, 100.0], [0.0, 0.0], [100.0, 100.0]])
    y_mirrored = np.array([[80.0, 30.0], [100.0, 100.0], [0.0, 0.0], [100.0, 100.0]])
    late = tally_of(90, 0, 100)
    tallies = {"x mirrored": x_mirrored, "y mirrored": y_mirrored, "one step late": late}
    (warning,) = suspect_mistakes(tallies, "motion")  # and no mistake of time beside it
    assert warning.startswith("y mirrored: ")
    assert "(30 % of the truth" in warning

    one_missed = np.array([[100.0, 0.0], [100.0, 1.0], [0.0, 0.0], [100.0, 1.0]])
    assert list(suspect_mistakes({"x mirrored": one_missed}, "motion")) == []


@pytest.mark.parametrize(
    ("right", "total", "suspected"), [(4, 10, True), (5, 10, False), (0, 9, False)]
)
def test_when_headings_look_random(right: int, total: int, *, suspected: bool) -> None:
    heading = tally_of(0, right, total)
    tallies = {"heading": heading, "place": tally_of(0, total, 5 * total)}
    warnings = list(suspect_mistakes(tallies, "detection"))

    messages = [f"headings look random: {right} of {total} are right"] if suspected else []
    assert [warning.split(" (")[0] for warning in warnings] == messages

    places_by_chance = tally_of(0, total, 6 * total)
    tallies = {"heading": heading, "place": places_by_chance}
    assert list(suspect_mistakes(tallies, "detection")) == []


@pytest.mark.parametrize(
    ("evidence", "ranked", "messages"),
    [
        ([{"scores": (1.0, 1.0)}], True, ["all 2 scores are 1"]),
        ([{"scores": (0.5,)}, {"scores": (0.5,)}], True, ["all 2 scores are 0.5"]),
        ([{"scores": (1.0, 1.0)}], False, []),
        ([{"scores": (1.0,)}], True, []),
        ([{"scores": (1.0, 0.5)}], True, []),
        ([{"empty": True}, {"empty": True}], True, ["all 2 examined predictions are empty"]),
        ([{"empty": True}, {}], True, []),
        (
            [{"empty": True}, {"probabilities": True}],
            True,
            ["all values of the heads' segmentation are between 0 and"],
        ),
        ([{"probabilities": False}, {"probabilities": True}], True, []),
    ],
)
def test_mistakes_that_show_without_labels(
    evidence: list[dict[str, Any]], *, ranked: bool, messages: list[str]
) -> None:
    samples = [SampleEvidence(tallies={}, **fields) for fields in evidence]
    facts = list(label_free_facts(samples, ranked=ranked))
    for fact, message in zip(facts, messages, strict=True):
        assert fact.startswith(message)


@pytest.mark.parametrize(
    ("numbers", "swapped"),
    [
        ({(0, 1): 5, (1, 0): 5}, [5, 5]),
        # a class with four boxes shows nothing, and only one class is too few
        (
            {(0, 1): 4, (1, 0): 5, (2, 2): 2},
            [],
        ),
        ({(0, 1): 5, (2, 2): 5}, [5]),
        ({(0, 1): 5, (2, 2): 6}, []),
        ({(0, 2): 9, (1, 2): 9}, []),  # both classes are taken for the same one
        ({(0, 1): 6, (0, 0): 3, (1, 0): 7}, [6, 7]),
    ],
)
def test_classes_that_are_swapped(numbers: dict[tuple[int, int], int], swapped: list[int]) -> None:
    confusion = np.zeros((6, 6))
    for classes, number in numbers.items():
        confusion[classes] = number

    tally = class_tally(confusion)

    assert tally[0].tolist() == swapped

    rows = [row for row, column in numbers if row != column][: len(swapped)]
    assert tally[1].tolist() == tally[3].tolist() == [confusion[row].sum() for row in rows]
    assert tally[2].tolist() == [confusion[row, row] for row in rows]


@pytest.mark.parametrize(
    ("undone", "predicted", "true", "hits"),
    [
        (1.0, 3.1, 0.0, [1, 1, 0, 1]),
        (-1.1, 0.9, 0.0, [0, 0, 0, 0]),  # both may be right
        (-1.2, 0.9, 0.0, [0, 1, 1, 1]),
        (1.0, 3.1, np.nan, [0, 0, 0, 0]),
        (np.nan, 0.0, 0.0, [0, 0, 0, 0]),
    ],
)
def test_only_predictions_that_cannot_be_right_in_both_ways_count(
    undone: float, predicted: float, true: float, hits: list[int]
) -> None:
    tallies = tallies_of(
        "time", {"late": np.array([undone])}, np.array([predicted]), np.array([true]), 1.0
    )

    assert tallies["late"][:, 0].tolist() == hits
    assert tallies["time"][2:, 0].tolist() == [predicted - true <= 1, np.isfinite(true)]
