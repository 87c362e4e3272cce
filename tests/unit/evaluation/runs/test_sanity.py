"""`check_sanity`: each classic mistake is named as exactly that; right predictions and baselines
raise no suspicion.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from memory_results import MemoryResults
from planning_scenes import scene
from refusals import assert_refused

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
AXES = {
    "x mirrored": [[-1, 0], [0, 1]],
    "y mirrored": [[1, 0], [0, -1]],
    "x and y mirrored": [[-1, 0], [0, -1]],
    "x and y swapped": [[0, 1], [1, 0]],
    "x and y swapped and mirrored": [[0, -1], [-1, 0]],
    "turned left": [[0, -1], [1, 0]],
    "turned right": [[0, 1], [-1, 0]],
}
"""Name → matrix from true to given."""


KINDS = {
    "maps": "motion",
    "heads": "motion",
    "accidents": "accident",
    "boxes": "detection",
    "plans": "planning",
    "forecasts": "forecasting",
}


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Of the accident and its twin, all agents, some of the last 2 s."""
    return da_motion.samples("train", "evaluate", "paper", scope="all")[::3]


@pytest.fixture(scope="module")
def right(da_motion: DeepAccident, tokens: list[str]) -> dict[str, dict[str, Any]]:
    """Kind of prediction → perfect ones, by token, with scores as they come."""
    labels = {token: da_motion.motion_labels(token).to_present("bilinear") for token in tokens}
    accidents: dict[str, list[Accident]] = {}
    detections = {}
    for number, token in enumerate(da_motion.samples("train", "evaluate", "paper", scope="all")):
        truth = accident_context(da_motion, token, 2.0).truth
        known = [] if truth is None or truth.accident is None else [truth.accident]
        accidents[token] = [replace(each, score=1 / (1 + number)) for each in known]
    for token in tokens:
        boxes = da_motion.boxes(token, "world")
        boxes = boxes.select(boxes.actor_id >= 0)
        detections[token] = DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 0.9, len(boxes)))
    return {
        "maps": {
            token: instances_of(each.instance, each.config.grid) for token, each in labels.items()
        },
        "heads": {
            token: MotionOutput(grid=each.config.grid, heads=(MotionHeads.from_labels(each),))
            for token, each in labels.items()
        },
        "accidents": accidents,
        "boxes": detections,
        "plans": {
            token: [recorded_plan(da_motion, token)] for token in samples_of_vehicles(da_motion)
        },
        "forecasts": {
            token: recorded_forecasts(da_motion, token)
            for token in samples_of_vehicles(da_motion)[::7]
        },
    }


def samples_of_vehicles(dataset: DeepAccident) -> list[str]:
    return default_selection(EvaluationSetup(task="planning", protocol="clean"), "train").tokens(
        dataset
    )


def recorded_plan(dataset: DeepAccident, token: str) -> Plan:
    recorded = trivial_plans(planning_scene(dataset, token))["recorded"]
    return replace(
        recorded, times=recorded.times[4::5], path=recorded.path[4::5], yaw=recorded.yaw[4::5]
    )


def recorded_forecasts(dataset: DeepAccident, token: str) -> list[Forecast]:
    truth = forecasting_truth(dataset, token)
    forecasts = []
    for actor, path in zip(truth.actor_id.tolist(), truth.path[:, 4:30:5], strict=True):
        known = np.isfinite(path[:, 0])
        known = known & (np.cumsum(~known) == 0)
        times = np.arange(1, 7)[known] / 2
        if known.any():
            forecasts.append(
                Forecast(actor_id=actor, times=times, paths=path[None, known], probabilities=[1.0])
            )
    return forecasts


def sanity(
    dataset: DeepAccident, kind: str, predictions: dict[str, Any], **how: Any
) -> SanityReport:
    task: Any = KINDS[kind]
    protocols = {"accident": "boxes", "planning": "clean", "forecasting": "clean"}
    setup = EvaluationSetup(task=task, protocol=protocols.get(task, "released"))
    return check_sanity(dataset, MemoryResults(task, predictions), setup, list(predictions), **how)


def of_maps(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, __, given: instances_of(
        np.ascontiguousarray(change(given.instances[-1])), given.grid
    )


def turned_maps(matrix: list[list[int]]) -> Change:
    """The cell at x, y is found where the matrix takes them; rows are y, columns x, both rising."""
    (x, _), (_, y) = matrix
    if x and y:
        return of_maps(lambda maps: maps[:, ::y, ::x])
    (_, x), (y, _) = matrix
    return of_maps(lambda maps: maps.swapaxes(1, 2)[:, ::y, ::x])


def of_segmentation(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(_: DeepAccident, __: str, given: MotionOutput) -> MotionOutput:
        (heads,) = given.heads or ()
        return replace(given, heads=(replace(heads, segmentation=change(heads.segmentation)),))

    return changed


def of_boxes(**changes: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(_: DeepAccident, __: str, given: DetectedBoxes) -> DetectedBoxes:
        boxes = given.boxes
        return replace(
            given,
            boxes=replace(
                boxes, **{each: by(getattr(boxes, each)) for each, by in changes.items()}
            ),
        )

    return changed


def of_centers(change: Callable[[np.ndarray, Any, Any], np.ndarray]) -> Change:
    """By the centres in the world and the agent's poses, ego and LiDAR."""

    def changed(dataset: DeepAccident, token: str, given: DetectedBoxes) -> DetectedBoxes:
        poses = (dataset.world_from(token, frame) for frame in ("ego", "lidar"))
        return replace(given, boxes=replace(given.boxes, center=change(given.boxes.center, *poses)))

    return changed


def of_height(change: Callable[[Boxes], np.ndarray]) -> Change:
    def changed(_: DeepAccident, __: str, given: DetectedBoxes) -> DetectedBoxes:
        center = np.column_stack([given.boxes.center[:, :2], change(given.boxes)])
        return replace(given, boxes=replace(given.boxes, center=center))

    return changed


def of_paths(
    change: Callable[[np.ndarray, np.ndarray, Any], tuple[np.ndarray, np.ndarray]],
) -> Change:
    """By times and places (…, T, 2) of plans or forecasts, and the ego's pose."""

    def changed(dataset: DeepAccident, token: str, given: list[Any]) -> list[Any]:
        paths = []
        for each in given:
            name = "path" if isinstance(each, Plan) else "paths"
            times, places = change(
                each.times, getattr(each, name), dataset.world_from(token, "ego")
            )
            paths.append(replace(each, times=times, **{name: places}))
        return paths

    return changed


def in_the_world(times: np.ndarray, places: np.ndarray, ego: Any) -> tuple[np.ndarray, np.ndarray]:
    flat = places.reshape(-1, 2)
    moved = ego.apply(np.column_stack([flat, np.zeros(len(flat))]))[:, :2]
    return times, moved.reshape(places.shape)


def late(times: np.ndarray, places: np.ndarray, _: Any) -> tuple[np.ndarray, np.ndarray]:
    """The present first, under the time of the first step; of forecasts, whose present is not 0,
    without it.
    """
    if places.ndim == 3:
        return times + 0.5, places
    return times, np.vstack([np.zeros(2), places[:-1]])


def of_yaw(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, __, given: [replace(each, yaw=change(each.yaw)) for each in given]


PATHS: dict[str, Change] = {
    **{
        name: of_paths(lambda times, at, _, by=by: (times, at @ np.transpose(by)))
        for name, by in AXES.items()
    },
    "world frame for ego frame": of_paths(in_the_world),
    "steps for places": of_paths(
        lambda times, at, _: (
            times,
            np.diff(at, axis=-2, prepend=2 * at[..., :1, :] - at[..., 1:2, :]),
        )
    ),
    "one step late": of_paths(late),
    "times in frames": of_paths(lambda times, at, _: (10 * times, at)),
    "times in milliseconds": of_paths(lambda times, at, _: (1000 * times, at)),
}
"""Mistakes of plans and forecasts alike."""
ON_CURVES: dict[str, Change] = {
    **{
        name: PATHS[name]
        for name in AXES
        if name not in ("x mirrored", "turned left", "turned right")
    },
    "yaw in degrees": of_yaw(np.rad2deg),
    "yaw clockwise": of_yaw(np.negative),
    "yaw clockwise from y": of_yaw(lambda yaw: np.pi / 2 - yaw),
}
"""Mistakes of plans that do not show, or not which one it is, on a straight way."""


def in_ego(matrix: list[list[int]]) -> Change:
    whole = np.eye(3)
    whole[:2, :2] = matrix
    return of_centers(lambda center, ego, _: ego.apply(ego.inverse().apply(center) @ whole.T))


def in_degrees(_: DeepAccident, __: str, given: DetectedBoxes) -> DetectedBoxes:
    boxes = given.boxes
    return DetectedBoxes.from_arrays(
        *(boxes.center, boxes.size, np.rad2deg(boxes.yaw), given.scores),
        category=boxes.category,
        frame="world",
    )


def of_earlier(dataset: DeepAccident, token: str, _: DetectedBoxes) -> DetectedBoxes:
    recording, frame = token.rsplit("/", 1)
    boxes = dataset.boxes(f"{recording}/{int(frame) - 5:03d}", "world")
    return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 0.9, len(boxes)))


def of_accidents(**changes: Callable[[Any], Any]) -> Change:
    return lambda _, __, given: [
        replace(each, **{name: by(getattr(each, name)) for name, by in changes.items()})
        for each in given
    ]


def in_world(dataset: DeepAccident, token: str, given: list[Accident]) -> list[Accident]:
    def moved(positions: np.ndarray) -> np.ndarray:
        return dataset.world_from(token, "ego").apply(np.column_stack([positions, np.zeros(2)]))[
            :, :2
        ]

    return [replace(each, positions=moved(each.positions)) for each in given]


PLANTED: dict[tuple[str, str], Change] = {
    **{("maps", name): turned_maps(matrix) for name, matrix in AXES.items()},
    ("maps", "frames reversed"): of_maps(lambda maps: maps[::-1]),
    ("maps", "one step late"): of_maps(lambda maps: maps[[0, 0, 1, 2, 3]]),
    ("maps", "all 14 predictions looked at are empty"): of_maps(np.zeros_like),
    ("heads", "all values of the heads' segmentation are between 0 and 1"): of_segmentation(
        lambda logits: 1 / (1 + np.exp(5 - logits))
    ),
    **{
        ("accidents", name): of_accidents(positions=lambda at, by=by: at @ np.transpose(by))
        for name, by in AXES.items()
    },
    ("accidents", "world frame for ego frame"): in_world,
    ("accidents", "frames reversed"): of_accidents(time=lambda time: 2 - time),
    ("accidents", "one step late"): of_accidents(time=lambda time: time + 0.5),
    ("accidents", "all 20 scores are 1"): of_accidents(score=lambda _: 1.0),
    ("accidents", "all 40 predictions looked at are empty"): lambda _, __, ___: [],
    **{("boxes", name): in_ego(matrix) for name, matrix in AXES.items()},
    ("boxes", "ego frame for world frame"): of_centers(
        lambda center, ego, _: ego.inverse().apply(center)
    ),
    ("boxes", "LiDAR frame for world frame"): of_centers(
        lambda center, _, lidar: lidar.inverse().apply(center)
    ),
    ("boxes", "LiDAR frame for ego frame"): of_centers(
        lambda center, ego, lidar: ego.apply(lidar.inverse().apply(center))
    ),
    ("boxes", "ego frame for LiDAR frame"): of_centers(
        lambda center, ego, lidar: lidar.apply(ego.inverse().apply(center))
    ),
    ("boxes", "all 14 predictions looked at are empty"): lambda _, __, given: DetectedBoxes(
        boxes=given.boxes.select(np.arange(0)), scores=given.scores[:0]
    ),
    ("boxes", "one step late"): of_earlier,
    **{
        ("boxes", f"sizes in the order {', '.join(names)}"): of_boxes(
            size=lambda size, names=names: size[
                :, [("length", "width", "height").index(each) for each in names]
            ]
        )
        for names in list(permutations(("length", "width", "height")))[1:]
    },
    ("boxes", "half sizes"): of_boxes(size=lambda size: size / 2),
    ("boxes", "double sizes"): of_boxes(size=lambda size: 2 * size),
    ("boxes", "sizes do not fit"): of_boxes(size=lambda size: 100 * size),
    ("boxes", "z of the lower face"): of_height(
        lambda boxes: boxes.center[:, 2] - boxes.size[:, 2] / 2
    ),
    ("boxes", "z of the upper face"): of_height(
        lambda boxes: boxes.center[:, 2] + boxes.size[:, 2] / 2
    ),
    ("boxes", "heights do not fit"): of_height(lambda boxes: boxes.center[:, 2] - 5),
    ("boxes", "velocities per frame"): of_boxes(velocity=lambda velocity: velocity / 10),
    ("boxes", "velocities per step"): of_boxes(velocity=lambda velocity: velocity / 2),
    ("boxes", "headings look random"): in_degrees,
    ("boxes", "classes swapped"): of_boxes(
        category=lambda category: np.array([1, 2, 3, 4, 5, 0])[category]
    ),
    **{("forecasts", name): change for name, change in PATHS.items()},
    **{("plans", name): change for name, change in PATHS.items() if name not in ON_CURVES},
    ("plans", "one step early"): of_paths(
        lambda times, at, _: (times, np.vstack([at[1:], 2 * at[-1] - at[-2]]))
    ),
    ("plans", "yaw from y"): of_yaw(lambda yaw: yaw - np.pi / 2),
    ("plans", "yaw backwards"): of_yaw(lambda yaw: yaw - np.pi),
    ("plans", "headings look random"): of_yaw(lambda yaw: yaw + np.pi / 3),
    ("forecasts", "all 8 predictions looked at are empty"): lambda _, __, ___: [],
}


@dataclass(frozen=True)
class Loaded:
    """A loader of always the same plans and scene."""

    dataset: Any
    results: Any
    plans: list[Plan]
    scene: PlanningScene
    places: None = None

    def __call__(self, _: str) -> tuple[Any, ...]:
        return self.plans, self.scene


@pytest.mark.parametrize(("kind", "mistake"), PLANTED)
def test_each_mistake_is_named_as_exactly_that(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]], kind: str, mistake: str
) -> None:
    planted = {
        token: PLANTED[kind, mistake](da_motion, token, given)
        for token, given in right[kind].items()
    }
    report = sanity(da_motion, kind, planted)
    (warning,) = report.warnings
    assert warning.startswith(mistake)
    assert f"\nWARNING: {warning}" in report.to_text()
    assert report.to_text().endswith("there is too little to compare.") == (not report.sought)


@pytest.mark.parametrize("mistake", ["", *PATHS, *ON_CURVES, "yaw from y", "yaw backwards"])
def test_mistakes_of_plans_on_curves(monkeypatch: pytest.MonkeyPatch, mistake: str) -> None:
    """Of an ego that turns left at 8 m/s, by 23° a second, and stands 50 m beside the world's
    origin.
    """
    seconds = np.arange(61) / 10
    yaw = 0.4 * seconds
    recorded = np.column_stack([20 * np.sin(yaw), 20 * (1 - np.cos(yaw)), yaw])
    driven = replace(scene(8), recorded=recorded)
    ego = SE3.from_yaw(0.7, (50.0, 30.0, 0.0))
    dataset: Any = SimpleNamespace(world_from=lambda _, __: ego, places=())
    plan = Plan(times=seconds[5:31:5], path=recorded[5:31:5, :2], yaw=yaw[5:31:5])
    change = {
        **PATHS,
        **ON_CURVES,
        **{name: PLANTED["plans", name] for name in ("yaw from y", "yaw backwards")},
    }
    plans = change[mistake](dataset, "", [plan]) if mistake else [plan]
    results: Any = MemoryResults("planning", {f"{number}": plans for number in range(20)})
    monkeypatch.setattr(
        sanity_module, "SampleLoader", lambda *_: Loaded(dataset, results, plans, driven)
    )
    report = check_sanity(
        dataset,
        results,
        EvaluationSetup(task="planning", protocol="clean"),
        list(results.predictions),
    )
    assert [each.partition(":")[0] for each in report.warnings] == [mistake] * bool(mistake)
    assert report.samples == 20


@pytest.mark.parametrize("kind", KINDS)
def test_right_predictions_raise_no_suspicion(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]], kind: str
) -> None:
    report = sanity(da_motion, kind, right[kind])
    assert report.warnings == ()
    assert "\nNone of these mistakes was found: x mirrored, " in report.to_text()
    assert report.sought
    assert json.loads(json.dumps(report.as_dict(), allow_nan=False))["warnings"] == []


def test_the_last_of_several_heads_counts(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]]
) -> None:
    mirrored = of_segmentation(
        lambda logits: np.ascontiguousarray(1 / (1 + np.exp(5 - logits[..., ::-1])))
    )
    predictions = {
        token: replace(each, heads=(*mirrored(da_motion, token, each).heads, *each.heads))
        for token, each in right["heads"].items()
    }
    assert sanity(da_motion, "heads", predictions).warnings == ()


def shown(
    change: Callable[[np.ndarray], np.ndarray],
) -> Callable[[DeepAccident, str], MotionOutput]:
    """Perfect maps, changed."""
    return lambda dataset, token: instances_of(
        change(dataset.motion_labels(token).to_present("bilinear").instance),
        dataset.motion_labels(token).config.grid,
    )


def at_another_speed(plan: Plan, factor: float) -> Plan:
    return replace(plan, path=plan.poses(factor * plan.times)[:, :2])


def moved_boxes(detected: DetectedBoxes) -> DetectedBoxes:
    return replace(
        detected, boxes=replace(detected.boxes, center=detected.boxes.center + np.array([30, 0, 0]))
    )


HONEST: dict[str, tuple[str, Callable[[DeepAccident, str], Any]]] = {
    "baseline's maps": ("maps", predict_motion),
    "baseline's maps, turning": (
        "maps",
        lambda da, token: predict_motion(da, token, model="constant_turn_rate"),
    ),
    "nobody moves": ("maps", shown(lambda maps: maps[[0, 0, 0, 0, 0]])),
    "half as fast": ("maps", shown(lambda maps: maps[[0, 0, 1, 1, 2]])),
    "slow at first": ("maps", shown(lambda maps: maps[[0, 0, 1, 2, 2]])),
    "twice as fast": ("maps", shown(lambda maps: maps[[0, 2, 4, 4, 4]])),
    "elsewhere": ("maps", shown(lambda maps: np.roll(maps, (37, 61), (1, 2)))),
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
    "slow plans": ("plans", lambda da, token: [at_another_speed(recorded_plan(da, token), 0.8)]),
    "fast plans": ("plans", lambda da, token: [at_another_speed(recorded_plan(da, token), 1.2)]),
    "baseline's forecasts": ("forecasts", predict_forecasts),
    "standing actors": (
        "forecasts",
        lambda da, token: predict_forecasts(da, token, model="standing"),
    ),
    "boxes elsewhere": (
        "boxes",
        lambda da, token: moved_boxes(predict_detections(da, token, agents=None)),
    ),
    "baseline's boxes": ("boxes", predict_detections),
    "baseline's boxes, all agents": (
        "boxes",
        lambda da, token: predict_detections(da, token, agents=None),
    ),
}


@pytest.mark.parametrize("name", HONEST)
def test_baselines_and_bad_predictions_raise_no_suspicion(
    da_motion: DeepAccident, tokens: list[str], name: str
) -> None:
    kind, predict = HONEST[name]
    if kind in ("plans", "forecasts"):
        tokens = samples_of_vehicles(da_motion)[:: 7 if kind == "forecasts" else 1]
    report = sanity(da_motion, kind, {token: predict(da_motion, token) for token in tokens})
    assert [each for each in report.warnings if "scores" not in each] == []


def test_of_too_little_nothing_is_said(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]]
) -> None:
    token = max(right["plans"])  # at the end of the recording
    report = sanity(da_motion, "plans", {token: right["plans"][token]})
    assert (report.sought, report.warnings) == ((), ())
    assert report.to_text().endswith(
        "Cannot say whether a mistake was made: there is too little to compare."
    )


def test_nothing_to_look_at(da_motion: DeepAccident, right: dict[str, dict[str, Any]]) -> None:
    results, setup = MemoryResults("motion", right["maps"]), EvaluationSetup(task="motion")
    assert_refused(
        (
            lambda: check_sanity(da_motion, results, setup, []),
            EvaluationError,
            "there is no sample to look at",
        ),
    )


@pytest.mark.parametrize(
    ("name", "task", "undone", "given", "whole", "suspected"),
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
def test_from_which_shares_on_a_mistake_is_suspected(
    name: str, task: str, undone: int, given: int, whole: int, *, suspected: bool
) -> None:
    half = {name: tally_of(undone / 2, given / 2, whole / 2)}
    warnings = list(suspect_mistakes(sum_tallies([half, half]), task))
    assert len(warnings) == suspected
    told = (
        f"({undone / whole:.0%} of the truth is hit once that is undone, "
        f"{given / whole:.0%} as it is)"
    )
    assert all(each.startswith(f"{name}: ") and each.endswith(told) for each in warnings)


def test_the_worst_measurement_counts_and_the_best_mistake_of_a_group() -> None:
    two = np.array([[80.0, 20.0], [100.0, 100.0], [0.0, 0.0], [100.0, 100.0]])
    one = np.where([[0, 1], [0, 0], [0, 0], [0, 0]], 30.0, two)
    (warning,) = suspect_mistakes(
        {"x mirrored": two, "y mirrored": one, "one step late": tally_of(90, 0, 100)}, "motion"
    )
    assert warning.startswith("y mirrored: ")  # and nothing of time beside it
    assert "(30% of the truth" in warning
    one_missed = np.array([[100.0, 0.0], [100.0, 1.0], [0.0, 0.0], [100.0, 1.0]])
    assert list(suspect_mistakes({"x mirrored": one_missed}, "motion")) == []


@pytest.mark.parametrize(("right", "every", "told"), [(4, 10, True), (5, 10, False), (0, 9, False)])
def test_when_headings_look_random(right: int, every: int, *, told: bool) -> None:
    found = {"heading": tally_of(0, right, every)}
    warnings = list(
        suspect_mistakes({**found, "place": tally_of(0, every, 5 * every)}, "detection")
    )
    assert [each.split(",")[0] for each in warnings] == [
        f"headings look random: {right} of {every} are right"
    ] * told
    assert (
        list(suspect_mistakes({**found, "place": tally_of(0, every, 6 * every)}, "detection")) == []
    )  # found by chance


@pytest.mark.parametrize(
    ("seen", "ranked", "told"),
    [
        ([{"scores": (1.0, 1.0)}], True, ["all 2 scores are 1"]),
        ([{"scores": (0.5,)}, {"scores": (0.5,)}], True, ["all 2 scores are 0.5"]),
        ([{"scores": (1.0, 1.0)}], False, []),
        ([{"scores": (1.0,)}], True, []),
        ([{"scores": (1.0, 0.5)}], True, []),
        ([{"empty": True}, {"empty": True}], True, ["all 2 predictions looked at are empty"]),
        ([{"empty": True}, {}], True, []),
        (
            [{"empty": True}, {"probabilities": True}],
            True,
            ["all values of the heads' segmentation are between 0 and"],
        ),
        ([{"probabilities": False}, {"probabilities": True}], True, []),
    ],
)
def test_what_shows_without_labels(
    seen: list[dict[str, Any]], *, ranked: bool, told: list[str]
) -> None:
    found = list(
        label_free_facts([SampleEvidence(tallies={}, **each) for each in seen], ranked=ranked)
    )
    assert [each[: len(start)] for each, start in zip(found, told, strict=True)] == told


@pytest.mark.parametrize(
    ("numbers", "swapped"),
    [
        ({(0, 1): 5, (1, 0): 5}, [5, 5]),
        (
            {(0, 1): 4, (1, 0): 5, (2, 2): 2},
            [],
        ),  # a class with four boxes tells nothing, and one alone is too few
        ({(0, 1): 5, (2, 2): 5}, [5]),
        ({(0, 1): 5, (2, 2): 6}, []),
        ({(0, 2): 9, (1, 2): 9}, []),  # both for one
        ({(0, 1): 6, (0, 0): 3, (1, 0): 7}, [6, 7]),
    ],
)
def test_classes_that_are_swapped(numbers: dict[tuple[int, int], int], swapped: list[int]) -> None:
    names = np.zeros((6, 6))
    for place, number in numbers.items():
        names[place] = number
    found = class_tally(names)
    assert found[0].tolist() == swapped
    changed = [row for row, column in numbers if row != column][: len(swapped)]
    assert found[1].tolist() == found[3].tolist() == [names[row].sum() for row in changed]
    assert found[2].tolist() == [names[row, row] for row in changed]


@pytest.mark.parametrize(
    ("undone", "given", "true", "hits"),
    [
        (1.0, 3.1, 0.0, [1, 1, 0, 1]),
        (-1.1, 0.9, 0.0, [0, 0, 0, 0]),  # both may be right
        (-1.2, 0.9, 0.0, [0, 1, 1, 1]),
        (1.0, 3.1, np.nan, [0, 0, 0, 0]),
        (np.nan, 0.0, 0.0, [0, 0, 0, 0]),
    ],
)
def test_only_what_cannot_be_right_in_both_ways_tells(
    undone: float, given: float, true: float, hits: list[int]
) -> None:
    found = tallies_of(
        "time", {"late": np.array([undone])}, np.array([given]), np.array([true]), 1.0
    )
    assert found["late"][:, 0].tolist() == hits
    assert found["time"][2:, 0].tolist() == [given - true <= 1, np.isfinite(true)]
