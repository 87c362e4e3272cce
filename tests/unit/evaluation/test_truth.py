"""The truth of a sample, reference alarms by constant velocities, and the alarms of predictions
with their actors.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.accident_scenes import (
    motion_labels_of,
    parked_path,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.evaluation.accident import AccidentReading
from deepaccident_devkit.evaluation.alarms import (
    foreseen_accident,
    named_alarms,
    nearest_two,
    position_difference,
)
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.truth import (
    REFERENCES,
    BoxTruth,
    accident_context,
    box_truth,
    constant_velocity_alarms,
)
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.taxonomy import AGENTS

UNSEEN_POINT = (math.nan, math.nan)
FAR_POINT = (90.0, 90.0)
OTHER_FAR_POINT = (-90.0, 90.0)
MOVING_PATH = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
Path = list[tuple[float, float]]


def truth_of(*paths: Path, **columns: Any) -> BoxTruth:
    """Make the truth of cars of 4 m × 2 m that look ahead; their ids are 10, 20, …

    A path is the car's x and y at each tenth of a second.
    """
    center = np.array(paths, dtype=np.float64).swapaxes(0, 1)
    size_and_yaw = np.broadcast_to([4.0, 2.0, 0.0], (*center.shape[:2], 3))
    return BoxTruth(
        time=np.arange(len(center)) / 10,
        footprint=np.concatenate([center, size_and_yaw], axis=2),
        accident=None,
        actor_id=np.arange(1, len(paths) + 1) * 10,
        **columns,
    )


@pytest.mark.parametrize(
    ("paths", "pair"),
    [
        # both stand still, but for less than half a metre
        (
            [[(0, 0)] * 3, [(0, 2), (0, 2.49), (0, 2)]],
            None,
        ),
        ([[(0, 0)] * 3, [(0, 2), (0, 2.5), (0, 2)]], (10, 20)),
        ([MOVING_PATH, [(0, 3), (1, 3), (2, 3)]], None),  # exactly a metre is not near
        ([MOVING_PATH, [(0, 3), (1, 2.9), (2, 3)]], (10, 20)),
        ([MOVING_PATH, [(4.99, 0), (5.99, 0), (6.99, 0)]], (10, 20)),  # one behind the other
        ([MOVING_PATH, [(5, 0), (6, 0), (7, 0)]], None),
        # the nearest of two
        (
            [
                MOVING_PATH,
                [(0, 2.9), FAR_POINT, FAR_POINT],
                [OTHER_FAR_POINT, OTHER_FAR_POINT, (2, 2.2)],
            ],
            (10, 30),
        ),
        # the earlier of two that are equally near
        (
            [
                MOVING_PATH,
                [FAR_POINT, FAR_POINT, (2, 2.5)],
                [OTHER_FAR_POINT, (1, 2.5), OTHER_FAR_POINT],
            ],
            (10, 30),
        ),
        # the first of two that are equally near and early
        (
            [
                MOVING_PATH,
                [FAR_POINT, (1, 2.5), FAR_POINT],
                [OTHER_FAR_POINT, (1, -2.5), OTHER_FAR_POINT],
            ],
            (10, 20),
        ),
        # two parked cars, which are nearer, do not count
        (
            [MOVING_PATH, [(40, 30)] * 3, [(40, 32.1)] * 3, [FAR_POINT, (1, 2.5), FAR_POINT]],
            (10, 40),
        ),
        ([MOVING_PATH, [UNSEEN_POINT, (1, 2.5), UNSEEN_POINT]], (10, 20)),
        ([MOVING_PATH], None),
    ],
)
def test_the_nearest_pair(paths: list[Path], pair: tuple[int, int] | None) -> None:
    assert truth_of(*paths).nearest_pair(1.0) == pair


@pytest.mark.parametrize(("window_s", "x"), [(0.25, [0, 2, 5]), (0.3, [0, 3, math.nan])])
def test_tracks_end_with_the_window(window_s: float, x: list[float]) -> None:
    truth = truth_of([(float(frame), 0.0) for frame in range(6)])
    tracks = truth.tracks(window_s, 3)

    assert_array_equal(tracks.center[:, 0, 0], x)
    assert tracks.identity.tolist() == [10]


@pytest.mark.parametrize(
    ("unplaced", "is_unplaced"), [(None, False), (2.05, True), (2.06, False), (0.0, True)]
)
def test_an_unplaced_accident_comes_within_half_a_frame_of_the_horizon(
    unplaced: float | None, is_unplaced: bool
) -> None:
    truth = truth_of(MOVING_PATH, horizon=2.0, unplaced=unplaced)
    assert truth.is_unplaced is is_unplaced
    assert truth_of(MOVING_PATH).horizon == math.inf


TWO_PAIRS_OF_CARS = [(0, 0, 2), (8, 0, 0), (0, 50, 1), (5, 50, 0)]


@pytest.mark.parametrize(
    ("rows", "names", "own_id", "alarms"),
    [
        ([(0, 0, 2), (9.8, 0, 0)], {}, None, [(2.9, (1, 2), (5.8, 9.8))]),
        ([(0, 0, 2), (10, 0, 0)], {}, None, []),  # a contact in 3 s is too late
        ([(0, 0, 0.1), (4.1, 0, 0)], {}, None, [(1, (1, 2), (0.1, 4.1))]),
        ([(0, 0, 0.09), (4.1, 0, 0)], {}, None, []),  # too slow
        ([(0, 0, math.nan), (4.1, 0, -1)], {}, None, [(0.1, (1, 2), (0, 4))]),
        (TWO_PAIRS_OF_CARS, {4: 44, 3: None}, None, [(1, None, (1, 5)), (2, (1, 2), (4, 8))]),
        (TWO_PAIRS_OF_CARS, {}, 4, [(1, (3, 4), (1, 5))]),
        (TWO_PAIRS_OF_CARS, {2: 99}, 99, [(2, (1, 99), (4, 8))]),
        (TWO_PAIRS_OF_CARS, {}, 5, []),
    ],
)
def test_alarms_of_constant_velocities(
    rows: Path,
    names: dict[int, int | None],
    own_id: int | None,
    alarms: list[tuple[float, Any, Any]],
) -> None:
    """Cars have a row of x, y and speed ahead each, and the ids 1, 2, …"""
    x, y, speed = np.array(rows, dtype=np.float64).T
    zeros = np.zeros(len(x))
    boxes = Boxes.from_arrays(
        np.column_stack([x, y, zeros]),
        np.tile([4.0, 2.0, 1.5], (len(x), 1)),
        zeros,
        frame="ego",
        velocity=np.column_stack([speed, zeros, zeros]),
        actor_id=np.arange(1, len(x) + 1),
    )
    result = constant_velocity_alarms(boxes, names, own_id)

    for alarm, (time, ids, position_x) in zip(result, alarms, strict=True):
        assert alarm.time == pytest.approx(time)
        assert alarm.ids == ids
        assert alarm.positions[:, 0] == pytest.approx(position_x)
        assert alarm.score == pytest.approx(1 - time / 3)


def crash_and_twin(dataset: DeepAccident) -> list[Mapping[str, Any]]:
    return sorted(dataset.scenario, key=lambda scenario: scenario["collision"] is None)


def test_the_truth_is_where_the_labels_have_the_actors(da_motion: DeepAccident) -> None:
    scenario = crash_and_twin(da_motion)[0]
    token = f"{scenario['token']}/other_vehicle/{scenario['num_frames'] - 15:03d}"
    truth = box_truth(da_motion, token)
    contact = da_motion.collision(scenario)

    assert truth.accident.time == pytest.approx(1.5)
    assert truth.accident.ids == contact.actor_ids
    assert truth.horizon == 2.0
    assert_allclose(truth.time, np.arange(16) / 10)
    for actor, position in zip(contact.actor_ids, truth.accident.positions, strict=True):
        path = da_motion.trajectory(f"{scenario['token']}/actor/{actor}", token, "ego")
        (index,) = np.flatnonzero(truth.actor_id == actor)
        assert_allclose(truth.footprint[:, index, :2], path.center[-16:, :2], atol=1e-9)
        assert_allclose(position, path.center[-1, :2], atol=1e-9)

    boxes = da_motion.boxes(token, "ego")
    footprints = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    indices = truth.actor_id.searchsorted(boxes.actor_id[1:])
    assert_allclose(truth.footprint[0, indices], footprints[1:], atol=1e-4)
    assert truth.nearest_pair(1.0) == contact.actor_ids


@pytest.mark.parametrize(
    ("horizon", "frames", "has_accident"),
    [(2.0, 16, True), (1.46, 16, True), (1.44, 15, False), (1.0, 11, False), (3.0, 16, True)],
)
def test_the_window_ends_with_the_horizon_or_the_recording(
    da_motion: DeepAccident, horizon: float, frames: int, has_accident: bool
) -> None:
    """The accident has half a recorded frame of tolerance, and is known at any time ahead."""
    scenario = crash_and_twin(da_motion)[0]
    token = f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 15:03d}"
    truth = box_truth(da_motion, token, horizon)

    assert len(truth.time) == frames
    assert (truth.accident is not None) == has_accident
    assert truth.impact.time == pytest.approx(1.5)
    assert truth.accident in (None, truth.impact)


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("frame", [1, 25, 35])
def test_the_context_of_a_sample(da_motion: DeepAccident, agent: str, frame: int) -> None:
    """The twin would come to the same impact; both recordings have 35 frames."""
    crash, twin = crash_and_twin(da_motion)
    involvements = {
        "ego_vehicle": "ego_involved",
        "other_vehicle": "ego_involved",
        "infrastructure": "infrastructure",
    }
    time_to_end = pytest.approx((35 - frame) / 10)
    expected = {
        "known": True,
        "own_actor_id": da_motion.get("agent", f"{crash['token']}/{agent}")["actor_id"],
        "time_to_end": time_to_end,
        "involvement": involvements.get(agent, "bystander"),
        "truth": None,
        "references": {},
    }

    token = f"{crash['token']}/{agent}/{frame:03d}"
    assert asdict(accident_context(da_motion, token)) == expected | {
        "pair": tuple(crash["collision"]["ids"]),
        "time_to_impact": time_to_end,
        "twin": False,
        "time_to_twin_impact": None,
    }

    truth = accident_context(da_motion, token, 2.0).truth
    assert (len(truth.time), truth.horizon) == (min(21, 36 - frame), 2.0)
    assert (truth.accident is None) == (frame == 1)
    assert truth.impact is not None

    token = f"{twin['token']}/{agent}/{frame:03d}"
    assert asdict(accident_context(da_motion, token)) == expected | {
        "pair": None,
        "time_to_impact": None,
        "twin": True,
        "time_to_twin_impact": time_to_end,
    }

    truth = accident_context(da_motion, token, 2.0).truth
    assert (len(truth.time), truth.horizon) == (min(21, 36 - frame), 2.0)
    assert truth.accident is None
    assert truth.impact is None


def pairs_of(alarms: Iterable[Accident]) -> set[frozenset[int]]:
    return {frozenset(alarm.ids) for alarm in alarms}


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("frame", [1, 25])
def test_references_are_of_all_actors_or_only_of_own_pairs(
    da_motion: DeepAccident, agent: str, frame: int
) -> None:
    """An agent in the accident is warned only of its own pairs, and no agent sees other pairs than
    the true ones.
    """
    crash = crash_and_twin(da_motion)[0]
    context_of = partial(accident_context, da_motion, references=True)
    context = context_of(f"{crash['token']}/{agent}/{frame:03d}")
    assert tuple(context.references) == REFERENCES

    true_pairs, seen_pairs = map(pairs_of, context.references.values())

    pole_context = context_of(f"{crash['token']}/infrastructure/{frame:03d}")
    expected_pairs = pairs_of(pole_context.references[REFERENCES[0]])
    if context.involvement == "ego_involved":
        expected_pairs = {pair for pair in expected_pairs if context.own_actor_id in pair}
    assert true_pairs == expected_pairs
    assert seen_pairs <= true_pairs
    assert (frozenset(crash["collision"]["ids"]) in true_pairs) == (frame == 25)


@pytest.mark.parametrize(
    ("agents", "weather", "twin", "involvement"),
    [
        (["other_vehicle", "ego_vehicle"], "Cloudy", True, "ego_involved"),
        (["other_vehicle", "ego_vehicle_behind"], "Cloudy", True, "bystander"),
        (None, "Cloudy", True, "ego_involved"),  # unknown agents: the designed pair
        ([], "Cloudy", False, "ego_involved"),  # nobody collides
        (["other_vehicle", "ego_vehicle_behind"], None, None, "ego_involved"),  # no meta file
    ],
)
def test_the_context_of_a_normal_twin(
    da_motion: DeepAccident,
    monkeypatch: pytest.MonkeyPatch,
    agents: Any,
    weather: Any,
    twin: Any,
    involvement: str,
) -> None:
    accident, normal = crash_and_twin(da_motion)
    collision = None if agents == [] else {**accident["collision"], "agents": agents}
    changed_accident = {**accident, "collision": collision, "weather": weather}
    table = {accident["token"]: changed_accident}
    monkeypatch.setattr(type(da_motion), "scenario", table, raising=False)

    context = accident_context(da_motion, f"{normal['token']}/ego_vehicle/005")
    assert (context.twin, context.involvement) == (twin, involvement)


def change_records(
    monkeypatch: pytest.MonkeyPatch, dataset: DeepAccident, table: str, **changes: Any
) -> None:
    """Give all records of a table other values."""
    get_record = dataset.get

    def get_changed(name: str, token: str) -> Mapping[str, Any]:
        record = get_record(name, token)
        return record | changes if name == table else record

    monkeypatch.setattr(dataset, "get", get_changed)


def test_an_accident_of_a_pair_that_no_label_shows_is_unplaced(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = crash_and_twin(da_motion)[0]
    collision = {**scenario["collision"], "ids": [999_999, 999_998]}
    change_records(monkeypatch, da_motion, "scenario", collision=collision)

    token = f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 10:03d}"
    truth = box_truth(da_motion, token)
    assert (truth.accident, truth.impact, truth.unplaced) == (None, None, pytest.approx(1.0))


@pytest.mark.parametrize(
    ("table", "changes", "make_truth", "message"),
    [
        ("sample", {"labelled": False}, box_truth, ("no label", "choose a labelled sample")),
        ("sample", {"labelled": False}, accident_context, ("no label", "choose a labelled sample")),
        ("scenario", {"weather": None}, box_truth, ("no meta file", "unpack meta")),
        (
            "scenario",
            {"weather": None},
            partial(accident_context, horizon=2.0),
            ("no meta file", "unpack meta"),
        ),
    ],
)
def test_samples_without_labels_or_meta_have_no_truth(
    da_motion: DeepAccident,
    monkeypatch: pytest.MonkeyPatch,
    table: str,
    changes: Any,
    make_truth: Any,
    message: Any,
) -> None:
    token = da_motion.samples("train", "evaluate")[0]
    scenario = token.rsplit("/", 2)[0]
    change_records(monkeypatch, da_motion, table, **changes)

    assert_raises((lambda: make_truth(da_motion, token), NotAvailableError, (scenario, *message)))


PARKED_CARS = {5: parked_path(20, 10), 9: parked_path(10, 10)}
EARLY_ACCIDENT = {5: parked_path(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 0, 3, 5, 7)]}
LATE_ACCIDENT = {5: parked_path(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 1)]}
EMPTY_TRUTH = replace(
    truth_of(*[[(0.0, 0.0)] * 21]), actor_id=np.zeros(0, np.int64), footprint=np.zeros((21, 0, 5))
)


@pytest.mark.parametrize(
    ("cars", "score", "frame"),
    [
        ([LATE_ACCIDENT], 1.0, 3),
        ([EARLY_ACCIDENT, PARKED_CARS, LATE_ACCIDENT], 2 / 3, 3),
        ([PARKED_CARS, EARLY_ACCIDENT, LATE_ACCIDENT, PARKED_CARS], 0.5, 1),
        ([LATE_ACCIDENT, EARLY_ACCIDENT, PARKED_CARS], 2 / 3, 3),
        ([PARKED_CARS, PARKED_CARS], None, 0),
    ],
)
@pytest.mark.parametrize("make_output", [to_instance_output, to_heads_output])
@pytest.mark.parametrize("config", [{}, {"protocol": "clean"}, {"orientation": "released"}])
def test_a_foreseen_accident_is_the_alarm_of_the_protocol_boxes(
    cars, score, frame, make_output, config
) -> None:
    """It is the mean's accident, or otherwise the first one: the same place, time and score."""
    labels = [motion_labels_of(paths, **config) for paths in cars]
    output = make_output(*labels)
    protocol = labels[0].config.protocol
    accident = foreseen_accident(output, labels=protocol)
    alarms = named_alarms(output, labels[0], EMPTY_TRUTH, AccidentReading())
    if score is None:
        assert accident is None
        assert alarms == []
        return

    ((alarm, names),) = alarms
    assert_array_equal(accident.positions, alarm.positions)
    assert (accident.time, accident.score) == (alarm.time, alarm.score)
    assert (accident.ids, names) == (None, (None, None))
    assert accident.score == pytest.approx(score)
    assert accident.time == pytest.approx(0.5 * frame)

    in_short_steps = foreseen_accident(output, labels=protocol, step=0.1)
    assert in_short_steps.time == pytest.approx(0.1 * frame)


def test_a_foreseen_accident_follows_the_labels() -> None:
    output = to_instance_output(motion_labels_of(LATE_ACCIDENT))
    accident = foreseen_accident(output)
    difference = foreseen_accident(output, labels=None).positions - accident.positions
    assert_allclose(np.abs(difference), 0.25)

    alarm, _ = named_alarms(output, None, EMPTY_TRUTH, AccidentReading())[0]
    assert_array_equal(alarm.positions, accident.positions)
    assert_raises(
        (lambda: foreseen_accident(output, labels="none"), ChoiceError, ("labels", "none"))
    )


def make_alarm(x: float = 0.0, time: float = 1.0, **columns: Any) -> Accident:
    positions = np.array([[x, 0.0], [x + 4, 0.0]])
    return Accident(positions=positions, time=time, **columns)


def test_explicit_alarms_are_sorted_and_left_out_below_score_0() -> None:
    """They are sorted by score, time, position and ids."""
    expected = [
        make_alarm(3, score=0.9, time=2.0),
        make_alarm(9, score=0.5, time=0.5),
        make_alarm(-1, score=0.5),
        make_alarm(1, score=0.5, ids=(1, 2)),
        make_alarm(1, score=0.5, ids=(1, 3)),
        make_alarm(0, score=0.0),
    ]
    for mixed in (expected, expected[::-1]):
        predictions = [*mixed, make_alarm(score=-0.001), make_alarm(score=-0.5)]
        alarms = named_alarms(predictions, None, EMPTY_TRUTH, AccidentReading())
        assert [alarm for alarm, _ in alarms] == expected


@pytest.mark.parametrize(
    ("time", "names"),
    [(0.3, (4, 7)), (0.26, (4, 7)), (0.34, (4, 7)), (0.24, (None, 4)), (9.9, (7, 4))],
)
def test_an_alarm_names_the_actors_at_the_nearest_recorded_frame(
    time: float, names: tuple[int, ...]
) -> None:
    """Both are where the alarm is only at the third frame; at the last one they have swapped."""
    first_path = [(x, 0.0) for x in (4, 4, 4, 0, 4, 4)]
    second_path = [(x, 0.0) for x in (90, 90, 90, 4, 90, 0)]
    truth = replace(truth_of(first_path, second_path), actor_id=np.array([4, 7]))

    alarms = named_alarms([make_alarm(time=time)], None, truth, AccidentReading())
    assert [alarm_names for _, alarm_names in alarms] == [names]


def test_two_positions_are_compared_in_the_order_that_fits_better() -> None:
    positions = np.array([[0.0, 0.0], [4.0, 3.0]])
    assert position_difference(positions, positions[::-1]) == 0
    assert position_difference(positions, positions + np.array([3, 4])) == 10

    ids = np.array([5, 6, 8])
    centers = np.array([[0.0, 4.0], [4.0, 7.01], [math.nan, 0.0]])
    assert nearest_two(positions, ids, centers, 4.0) == (5, None)
    assert nearest_two(positions, ids, centers, 4.02) == (5, 6)
