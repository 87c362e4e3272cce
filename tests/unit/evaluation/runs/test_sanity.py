"""`check_sanity`: each classic mistake is named as exactly that; right predictions and baselines raise no suspicion."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from memory_results import MemoryResults
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import predict_accidents, predict_detections, predict_motion
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.runs import sanity as sanity_module
from deepaccident_devkit.evaluation.runs.sanity import (
    SanityReport,
    Seen,
    accident_tally,
    are_followed,
    are_near,
    are_of_one_size,
    check_sanity,
    class_tally,
    facts_of,
    mistakes_of,
    tally_of,
)
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads

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
        "maps": {token: instances_of(each.instance, each.config.grid) for token, each in labels.items()},
        "heads": {
            token: MotionOutput(grid=each.config.grid, heads=(MotionHeads.from_labels(each),))
            for token, each in labels.items()
        },
        "accidents": accidents,
        "boxes": detections,
    }


def sanity(dataset: DeepAccident, kind: str, predictions: dict[str, Any], **how: Any) -> SanityReport:
    task: Any = {"maps": "motion", "heads": "motion", "accidents": "accident", "boxes": "detection"}[kind]
    setup = EvaluationSetup(task=task, protocol="boxes" if task == "accident" else "released")
    return check_sanity(dataset, MemoryResults(task, predictions), setup, list(predictions), **how)


def of_maps(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda _, __, given: instances_of(np.ascontiguousarray(change(given.instances[-1])), given.grid)


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
        return replace(given, boxes=replace(boxes, **{each: by(getattr(boxes, each)) for each, by in changes.items()}))

    return changed


def of_centers(change: Callable[[np.ndarray, Any, Any], np.ndarray]) -> Change:
    """By the centres in the world and the agent's poses, ego and LiDAR."""

    def changed(dataset: DeepAccident, token: str, given: DetectedBoxes) -> DetectedBoxes:
        poses = (dataset.world_from(token, frame) for frame in ("ego", "lidar"))
        return replace(given, boxes=replace(given.boxes, center=change(given.boxes.center, *poses)))

    return changed


def in_ego(matrix: list[list[int]]) -> Change:
    whole = np.eye(3)
    whole[:2, :2] = matrix
    return of_centers(lambda center, ego, _: ego.apply(ego.inverse().apply(center) @ whole.T))


def in_degrees(_: DeepAccident, __: str, given: DetectedBoxes) -> DetectedBoxes:
    boxes = given.boxes
    return DetectedBoxes.from_arrays(
        *(boxes.center, boxes.size, np.rad2deg(boxes.yaw), given.scores), category=boxes.category, frame="world"
    )


def of_earlier(dataset: DeepAccident, token: str, _: DetectedBoxes) -> DetectedBoxes:
    recording, frame = token.rsplit("/", 1)
    boxes = dataset.boxes(f"{recording}/{int(frame) - 5:03d}", "world")
    return DetectedBoxes(boxes=boxes, scores=np.linspace(0.1, 0.9, len(boxes)))


def of_accidents(**changes: Callable[[Any], Any]) -> Change:
    return lambda _, __, given: [
        replace(each, **{name: by(getattr(each, name)) for name, by in changes.items()}) for each in given
    ]


def in_world(dataset: DeepAccident, token: str, given: list[Accident]) -> list[Accident]:
    def moved(positions: np.ndarray) -> np.ndarray:
        return dataset.world_from(token, "ego").apply(np.column_stack([positions, np.zeros(2)]))[:, :2]

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
    ("boxes", "ego frame for world frame"): of_centers(lambda center, ego, _: ego.inverse().apply(center)),
    ("boxes", "LiDAR frame for world frame"): of_centers(lambda center, _, lidar: lidar.inverse().apply(center)),
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
            size=lambda size, names=names: size[:, [("length", "width", "height").index(each) for each in names]]
        )
        for names in list(permutations(("length", "width", "height")))[1:]
    },
    ("boxes", "headings look random"): in_degrees,
    ("boxes", "classes swapped"): of_boxes(category=lambda category: np.array([1, 2, 3, 4, 5, 0])[category]),
}


@pytest.mark.parametrize(("kind", "mistake"), PLANTED)
def test_each_mistake_is_named_as_exactly_that(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]], kind: str, mistake: str
) -> None:
    planted = {token: PLANTED[kind, mistake](da_motion, token, given) for token, given in right[kind].items()}
    report = sanity(da_motion, kind, planted)
    (warning,) = report.warnings
    assert warning.startswith(mistake)
    assert report.to_text().endswith(f"WARNING: {warning}")


@pytest.mark.parametrize("kind", ["maps", "heads", "accidents", "boxes"])
def test_right_predictions_raise_no_suspicion(
    da_motion: DeepAccident, right: dict[str, dict[str, Any]], kind: str
) -> None:
    report = sanity(da_motion, kind, right[kind])
    assert report.warnings == ()
    assert report.to_text().endswith("\nNothing looks wrong with the predictions.")
    assert json.loads(json.dumps(report.as_dict(), allow_nan=False))["warnings"] == []


def test_the_last_of_several_heads_counts(da_motion: DeepAccident, right: dict[str, dict[str, Any]]) -> None:
    mirrored = of_segmentation(lambda logits: np.ascontiguousarray(1 / (1 + np.exp(5 - logits[..., ::-1]))))
    predictions = {
        token: replace(each, heads=(*mirrored(da_motion, token, each).heads, *each.heads))
        for token, each in right["heads"].items()
    }
    assert sanity(da_motion, "heads", predictions).warnings == ()


def shown(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[DeepAccident, str], MotionOutput]:
    """Perfect maps, changed."""
    return lambda dataset, token: instances_of(
        change(dataset.motion_labels(token).to_present("bilinear").instance), dataset.motion_labels(token).config.grid
    )


HONEST: dict[str, tuple[str, Callable[[DeepAccident, str], Any]]] = {
    "baseline's maps": ("maps", predict_motion),
    "baseline's maps, turning": ("maps", lambda da, token: predict_motion(da, token, model="constant_turn_rate")),
    "nobody moves": ("maps", shown(lambda maps: maps[[0, 0, 0, 0, 0]])),
    "half as fast": ("maps", shown(lambda maps: maps[[0, 0, 1, 1, 2]])),
    "slow at first": ("maps", shown(lambda maps: maps[[0, 0, 1, 2, 2]])),
    "twice as fast": ("maps", shown(lambda maps: maps[[0, 2, 4, 4, 4]])),
    "elsewhere": ("maps", shown(lambda maps: np.roll(maps, (37, 61), (1, 2)))),
    "baseline's accidents": ("accidents", predict_accidents),
    "baseline's accidents, all agents": ("accidents", lambda da, token: predict_accidents(da, token, agents=None)),
    "the same accident always": (
        "accidents",
        lambda _, token: [Accident(positions=np.array([[10, 0], [13, 1]]), time=1.0, score=len(token))],
    ),
    "baseline's boxes": ("boxes", predict_detections),
    "baseline's boxes, all agents": ("boxes", lambda da, token: predict_detections(da, token, agents=None)),
}


@pytest.mark.parametrize("name", HONEST)
def test_baselines_and_bad_predictions_raise_no_suspicion(
    da_motion: DeepAccident, tokens: list[str], name: str
) -> None:
    kind, predict = HONEST[name]
    report = sanity(da_motion, kind, {token: predict(da_motion, token) for token in tokens})
    assert [each for each in report.warnings if "scores" not in each] == []


def test_equal_scores_are_told_only_where_they_count(da_motion: DeepAccident, right: dict[str, dict[str, Any]]) -> None:
    equal = {token: [replace(each, score=1.0) for each in given] for token, given in right["accidents"].items()}
    setup = EvaluationSetup(task="accident", protocol="paper")
    assert check_sanity(da_motion, MemoryResults("accident", equal), setup, list(equal)).warnings == ()


def test_turned_maps_longer_than_wide_are_not_compared(da_motion: DeepAccident, tokens: list[str]) -> None:
    grid = BevGrid((-50, 50, 0.5), (-30, 30, 0.5))
    empty = {token: instances_of(np.zeros((5, *grid.shape), dtype=int), grid) for token in tokens[:2]}
    (warning,) = sanity(da_motion, "maps", empty).warnings
    assert warning.startswith("all 2 predictions looked at are empty")


def test_a_few_samples_are_looked_at_always_the_same(da_motion: DeepAccident, right: dict[str, dict[str, Any]]) -> None:
    one = sanity(da_motion, "boxes", right["boxes"])
    assert one == sanity(da_motion, "boxes", dict(reversed(right["boxes"].items())), workers=2)


def test_nothing_to_look_at(da_motion: DeepAccident, right: dict[str, dict[str, Any]]) -> None:
    results, setup = MemoryResults("motion", right["maps"]), EvaluationSetup(task="motion")
    assert_refused(
        (lambda: check_sanity(da_motion, results, setup, []), EvaluationError, "there is no sample to look at"),
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
    half = Seen(tallies={name: tally_of(undone / 2, given / 2, whole / 2)})
    warnings = list(mistakes_of([half, half], task))
    assert len(warnings) == suspected
    told = f"({undone / whole:.0%} of the truth is hit once that is undone, {given / whole:.0%} as it is)"
    assert all(each.startswith(f"{name}: ") and each.endswith(told) for each in warnings)


def test_the_worst_measurement_counts_and_the_best_mistake_of_a_group() -> None:
    two = np.array([[80.0, 20.0], [100.0, 100.0], [0.0, 0.0], [100.0, 100.0]])
    one = np.where([[0, 1], [0, 0], [0, 0], [0, 0]], 30.0, two)
    (warning,) = mistakes_of(
        [Seen(tallies={"x mirrored": two, "y mirrored": one, "one step late": tally_of(90, 0, 100)})], "motion"
    )
    assert warning.startswith("y mirrored: ")  # and nothing of time beside it
    assert "(30% of the truth" in warning
    one_missed = np.array([[100.0, 0.0], [100.0, 1.0], [0.0, 0.0], [100.0, 1.0]])
    assert list(mistakes_of([Seen(tallies={"x mirrored": one_missed})], "motion")) == []


@pytest.mark.parametrize(("right", "every", "told"), [(4, 10, True), (5, 10, False), (0, 9, False)])
def test_when_headings_look_random(right: int, every: int, *, told: bool) -> None:
    warnings = list(
        mistakes_of([Seen(tallies={}, headings=(right, every - 3)), Seen(tallies={}, headings=(0, 3))], "detection")
    )
    assert [each.split(",")[0] for each in warnings] == [f"headings look random: {right} of {every} are right"] * told


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
        ([{"empty": True}, {"probabilities": True}], True, ["all values of the heads' segmentation are between 0 and"]),
        ([{"probabilities": False}, {"probabilities": True}], True, []),
    ],
)
def test_what_shows_without_labels(seen: list[dict[str, Any]], *, ranked: bool, told: list[str]) -> None:
    found = list(facts_of([Seen(tallies={}, **each) for each in seen], ranked=ranked))
    assert [each[: len(start)] for each, start in zip(found, told, strict=True)] == told


@pytest.mark.parametrize(
    ("numbers", "swapped"),
    [
        ({(0, 1): 5, (1, 0): 5}, [5, 5]),
        ({(0, 1): 4, (1, 0): 5, (2, 2): 2}, []),  # a class with four boxes tells nothing, and one alone is too few
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


def test_what_is_near() -> None:
    true = np.array([[0.0, 0.0, 0.0]])
    found = np.array([[2.0, 0, 0], [1.99, 0, 0.69], [0, 0, 0.7], [0, 0, -0.71], [1.5, 1.5, 0], [-1.4, 1.4, -0.6]])
    assert are_near(found, true).tolist() == [[False, True, False, False, False, True]]
    way = np.array([[4.0, 0.0]])
    for off, follows in (([0.99, 0.0], True), ([1.0, 0.0], False), ([0.0, -0.9], True), ([0.8, 0.8], False)):
        assert are_followed(np.array([[9.0, 9, 0], [*off, 5]]), np.zeros((1, 2)), way).tolist() == [follows]
    size = np.array([[4.0, 2.0, 1.0]])
    sizes = np.array([[5.0, 1.5, 1.25], [5.1, 2, 1], [4, 1.4, 1], [4, 2, 1.3]])
    assert are_of_one_size(sizes, size).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("undone", "given", "change", "tally"),
    [(1.0, 3.0, 4.0, [1, 1, 0, 1]), (1.1, 0.9, 4.0, [0, 1, 1, 1]), (0.0, 0.0, 2.0, [0, 0, 0, 0]), (1, 1, 2.1, [1] * 4)],
)
def test_accidents_tell_only_where_both_cannot_be_near(
    undone: float, given: float, change: float, tally: list[int]
) -> None:
    assert accident_tally(undone, given, change, 1.0)[:, 0].tolist() == tally


def test_what_is_looked_at_and_asked_for() -> None:
    """More would take longer; less would raise suspicion of right predictions."""
    assert (sanity_module.SAMPLES, sanity_module.LISTS, sanity_module.FEWEST_FRAMES) == (20, 60, 3)
    assert (sanity_module.MOVING, sanity_module.NEAR_IN_TIME) == (4.0, 0.15)
    assert np.rad2deg(sanity_module.STRAIGHT) == pytest.approx(15)
