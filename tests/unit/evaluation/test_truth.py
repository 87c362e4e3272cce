"""What happens after a sample, what constant velocities lead to, and the alarms of predictions with
whom they name.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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

GONE, FAR, AWAY = (math.nan, math.nan), (90.0, 90.0), (-90.0, 90.0)
MOVING = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
Path = list[tuple[float, float]]


def truth_of(*paths: Path, **columns: Any) -> BoxTruth:
    """Cars of 4 m × 2 m that look ahead, by their places at each tenth of a second; ids 10, 20,
    …
    """
    center = np.array(paths, dtype=np.float64).swapaxes(0, 1)
    footprint = np.concatenate(
        [center, np.broadcast_to([4.0, 2.0, 0.0], (*center.shape[:2], 3))], axis=2
    )
    ids, time = np.arange(1, len(paths) + 1) * 10, np.arange(len(center)) / 10
    return BoxTruth(time=time, footprint=footprint, accident=None, actor_id=ids, **columns)


@pytest.mark.parametrize(
    ("paths", "pair"),
    [
        (
            [[(0, 0)] * 3, [(0, 2), (0, 2.49), (0, 2)]],
            None,
        ),  # both stand, but for less than half a metre
        ([[(0, 0)] * 3, [(0, 2), (0, 2.5), (0, 2)]], (10, 20)),
        ([MOVING, [(0, 3), (1, 3), (2, 3)]], None),  # exactly a metre
        ([MOVING, [(0, 3), (1, 2.9), (2, 3)]], (10, 20)),
        ([MOVING, [(4.99, 0), (5.99, 0), (6.99, 0)]], (10, 20)),  # one behind the other
        ([MOVING, [(5, 0), (6, 0), (7, 0)]], None),
        ([MOVING, [(0, 2.9), FAR, FAR], [AWAY, AWAY, (2, 2.2)]], (10, 30)),  # the nearest
        ([MOVING, [FAR, FAR, (2, 2.5)], [AWAY, (1, 2.5), AWAY]], (10, 30)),  # the earliest
        ([MOVING, [FAR, (1, 2.5), FAR], [AWAY, (1, -2.5), AWAY]], (10, 20)),  # the first
        (
            [MOVING, [(40, 30)] * 3, [(40, 32.1)] * 3, [FAR, (1, 2.5), FAR]],
            (10, 40),
        ),  # beside two that are parked
        ([MOVING, [GONE, (1, 2.5), GONE]], (10, 20)),
        ([MOVING], None),
    ],
)
def test_the_two_that_come_nearest(paths: list[Path], pair: tuple[int, int] | None) -> None:
    assert truth_of(*paths).nearest_pair(1.0) == pair


@pytest.mark.parametrize(("seconds", "places"), [(0.25, [0, 2, 5]), (0.3, [0, 3, math.nan])])
def test_tracks_end_with_the_window(seconds: float, places: list[float]) -> None:
    truth = truth_of([(float(frame), 0.0) for frame in range(6)])
    assert_array_equal(truth.tracks(seconds, 3).center[:, 0, 0], places)
    assert truth.tracks(seconds, 3).identity.tolist() == [10]


@pytest.mark.parametrize(
    ("unplaced", "said"), [(None, False), (2.05, True), (2.06, False), (0.0, True)]
)
def test_an_unplaced_accident_comes_within_half_a_frame_of_the_horizon(
    unplaced: float | None, said: bool
) -> None:
    assert truth_of(MOVING, horizon=2.0, unplaced=unplaced).is_unplaced is said
    assert truth_of(MOVING).horizon == math.inf


TWO_PAIRS = [(0, 0, 2), (8, 0, 0), (0, 50, 1), (5, 50, 0)]


@pytest.mark.parametrize(
    ("rows", "names", "own", "alarms"),
    [
        ([(0, 0, 2), (9.8, 0, 0)], {}, None, [(2.9, (1, 2), (5.8, 9.8))]),
        ([(0, 0, 2), (10, 0, 0)], {}, None, []),  # in 3 s
        ([(0, 0, 0.1), (4.1, 0, 0)], {}, None, [(1, (1, 2), (0.1, 4.1))]),
        ([(0, 0, 0.09), (4.1, 0, 0)], {}, None, []),  # too slow
        ([(0, 0, math.nan), (4.1, 0, -1)], {}, None, [(0.1, (1, 2), (0, 4))]),
        (TWO_PAIRS, {4: 44, 3: None}, None, [(1, None, (1, 5)), (2, (1, 2), (4, 8))]),
        (TWO_PAIRS, {}, 4, [(1, (3, 4), (1, 5))]),
        (TWO_PAIRS, {2: 99}, 99, [(2, (1, 99), (4, 8))]),
        (TWO_PAIRS, {}, 5, []),
    ],
)
def test_alarms_of_constant_velocities(
    rows: Path, names: dict[int, int | None], own: int | None, alarms: list[tuple[float, Any, Any]]
) -> None:
    """Of cars at x, y with a speed ahead each; ids 1, 2, …"""
    x, y, speed = np.array(rows, dtype=np.float64).T
    center, velocity = (
        np.stack([each, other, y * 0], axis=1) for each, other in ((x, y), (speed, y * 0))
    )
    boxes = Boxes.from_arrays(
        center,
        np.tile([4.0, 2.0, 1.5], (len(x), 1)),
        x * 0,
        frame="ego",
        velocity=velocity,
        actor_id=np.arange(1, len(x) + 1),
    )
    found = constant_velocity_alarms(boxes, names, own)
    assert [
        (pytest.approx(each.time), each.ids, pytest.approx(each.positions[:, 0])) for each in found
    ] == alarms
    assert [each.score for each in found] == pytest.approx([1 - time / 3 for time, *_ in alarms])


def crash_and_twin(dataset: DeepAccident) -> list[Mapping[str, Any]]:
    return sorted(dataset.scenario, key=lambda each: each["collision"] is None)


def test_the_truth_is_where_the_labels_have_the_actors(da_motion: DeepAccident) -> None:
    scenario = crash_and_twin(da_motion)[0]
    token = f"{scenario['token']}/other_vehicle/{scenario['num_frames'] - 15:03d}"
    truth, contact = box_truth(da_motion, token), da_motion.collision(scenario)
    assert (truth.accident.time, truth.accident.ids, truth.horizon) == (
        pytest.approx(1.5),
        contact.actor_ids,
        2.0,
    )
    assert_allclose(truth.time, np.arange(16) / 10)
    for actor, position in zip(contact.actor_ids, truth.accident.positions, strict=True):
        path = da_motion.trajectory(f"{scenario['token']}/actor/{actor}", token, "ego")
        [seen] = np.flatnonzero(truth.actor_id == actor)
        assert_allclose(truth.footprint[:, seen, :2], path.center[-16:, :2], atol=1e-9)
        assert_allclose(position, path.center[-1, :2], atol=1e-9)
    boxes = da_motion.boxes(token, "ego")
    assert_allclose(
        truth.footprint[0, truth.actor_id.searchsorted(boxes.actor_id[1:])],
        np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])[1:],
        atol=1e-4,
    )
    assert truth.nearest_pair(1.0) == contact.actor_ids


@pytest.mark.parametrize(
    ("horizon", "frames", "there"),
    [(2.0, 16, True), (1.46, 16, True), (1.44, 15, False), (1.0, 11, False), (3.0, 16, True)],
)
def test_the_window_ends_with_the_horizon_or_the_recording(
    da_motion: DeepAccident, horizon: float, frames: int, there: bool
) -> None:
    """The accident has half a recorded frame of slack, and is known at any time ahead."""
    scenario = crash_and_twin(da_motion)[0]
    truth = box_truth(
        da_motion, f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 15:03d}", horizon
    )
    assert (len(truth.time), truth.accident is not None, truth.impact.time) == (
        frames,
        there,
        pytest.approx(1.5),
    )
    assert truth.accident in (None, truth.impact)


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("frame", [1, 25, 35])
def test_what_a_release_knows_of_a_sample(da_motion: DeepAccident, agent: str, frame: int) -> None:
    """Of an accident and of its twin, which would come to the same impact; of 35 frames each."""
    crash, twin = crash_and_twin(da_motion)
    known = {
        "known": True,
        "own_actor_id": da_motion.get("agent", f"{crash['token']}/{agent}")["actor_id"],
        "time_to_end": pytest.approx((35 - frame) / 10),
        "involvement": {"ego_vehicle": "ego_involved", "other_vehicle": "ego_involved"}.get(
            agent, agent if agent == "infrastructure" else "bystander"
        ),
        "truth": None,
        "references": {},
    }
    nobody = {
        "pair": None,
        "time_to_impact": None,
        "twin": True,
        "time_to_twin_impact": known["time_to_end"],
    }
    pair = {"pair": tuple(crash["collision"]["ids"]), "time_to_impact": known["time_to_end"]}
    expected = {
        crash["token"]: pair | {"twin": False, "time_to_twin_impact": None},
        twin["token"]: nobody,
    }
    for scenario, facts in expected.items():
        assert (
            asdict(accident_context(da_motion, f"{scenario}/{agent}/{frame:03d}")) == known | facts
        )
        truth = accident_context(da_motion, f"{scenario}/{agent}/{frame:03d}", 2.0).truth
        assert (len(truth.time), truth.horizon) == (min(21, 36 - frame), 2.0)
        assert (truth.accident is None, truth.impact is None) == (
            scenario != crash["token"] or frame == 1,
            scenario != crash["token"],
        )


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("frame", [1, 25])
def test_references_are_of_all_actors_or_of_own_pairs(
    da_motion: DeepAccident, agent: str, frame: int
) -> None:
    """Who is involved is warned of its own pairs alone; nobody sees more than there is."""
    crash = crash_and_twin(da_motion)[0]
    of_agent, of_pole = (
        accident_context(da_motion, f"{crash['token']}/{each}/{frame:03d}", references=True)
        for each in (agent, "infrastructure")
    )
    assert tuple(of_agent.references) == REFERENCES
    true, seen = (
        {frozenset(each.ids) for each in alarms} for alarms in of_agent.references.values()
    )
    everyone = {frozenset(each.ids) for each in of_pole.references[REFERENCES[0]]}
    involved = of_agent.involvement == "ego_involved"
    assert true == {pair for pair in everyone if not involved or of_agent.own_actor_id in pair}
    assert seen <= true
    assert (frozenset(crash["collision"]["ids"]) in true) == (frame == 25)


@pytest.mark.parametrize(
    ("agents", "weather", "twin", "involvement"),
    [
        (["other_vehicle", "ego_vehicle"], "Cloudy", True, "ego_involved"),
        (["other_vehicle", "ego_vehicle_behind"], "Cloudy", True, "bystander"),
        (None, "Cloudy", True, "ego_involved"),  # it is not known whose: the designed pair
        ([], "Cloudy", False, "ego_involved"),  # nobody collides
        (["other_vehicle", "ego_vehicle_behind"], None, None, "ego_involved"),  # no meta file
    ],
)
def test_what_the_twin_tells(
    da_motion: DeepAccident,
    monkeypatch: pytest.MonkeyPatch,
    agents: Any,
    weather: Any,
    twin: Any,
    involvement: str,
) -> None:
    accident, normal = crash_and_twin(da_motion)
    collision = None if agents == [] else {**accident["collision"], "agents": agents}
    table = {accident["token"]: {**accident, "collision": collision, "weather": weather}}
    monkeypatch.setattr(type(da_motion), "scenario", table, raising=False)
    context = accident_context(da_motion, f"{normal['token']}/ego_vehicle/005")
    assert (context.twin, context.involvement) == (twin, involvement)


def altered(
    monkeypatch: pytest.MonkeyPatch, dataset: DeepAccident, table: str, **changes: Any
) -> None:
    """Records of a table with other values."""
    given = dataset.get
    monkeypatch.setattr(
        dataset, "get", lambda name, row: given(name, row) | (changes if name == table else {})
    )


def test_a_pair_that_no_label_shows(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = crash_and_twin(da_motion)[0]
    altered(
        monkeypatch,
        da_motion,
        "scenario",
        collision={**scenario["collision"], "ids": [999_999, 999_998]},
    )
    truth = box_truth(
        da_motion, f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 10:03d}"
    )
    assert (truth.accident, truth.impact, truth.unplaced) == (None, None, pytest.approx(1.0))


@pytest.mark.parametrize(
    ("table", "changes", "makes", "words"),
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
    makes: Any,
    words: Any,
) -> None:
    token = da_motion.samples("train", "evaluate")[0]
    altered(monkeypatch, da_motion, table, **changes)
    assert_refused(
        (lambda: makes(da_motion, token), NotAvailableError, (token.rsplit("/", 2)[0], *words))
    )


CALM = {5: standing(20, 10), 9: standing(10, 10)}
EARLY = {5: standing(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 0, 3, 5, 7)]}
LATE = {5: standing(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 1)]}
NOBODY = replace(
    truth_of(*[[(0.0, 0.0)] * 21]), actor_id=np.zeros(0, np.int64), footprint=np.zeros((21, 0, 5))
)


@pytest.mark.parametrize(
    ("cars", "score", "frame"),
    [
        ([LATE], 1.0, 3),
        ([EARLY, CALM, LATE], 2 / 3, 3),
        ([CALM, EARLY, LATE, CALM], 0.5, 1),
        ([LATE, EARLY, CALM], 2 / 3, 3),
        ([CALM, CALM], None, 0),
    ],
)
@pytest.mark.parametrize("form", [as_maps, as_heads])
@pytest.mark.parametrize("config", [{}, {"protocol": "clean"}, {"orientation": "released"}])
def test_a_foreseen_accident_is_the_alarm_of_the_protocol_boxes(
    cars, score, frame, form, config
) -> None:
    """The mean's, or else the first that there is; with the same place, moment and score."""
    labels = [scene(each, **config) for each in cars]
    output, settings = form(*labels), labels[0].config
    found = foreseen_accident(output, labels=settings.protocol)
    alarms = named_alarms(output, labels[0], NOBODY, AccidentReading())
    if score is None:
        assert (found, alarms) == (None, [])
        return
    [(alarm, named)] = alarms
    assert_array_equal(found.positions, alarm.positions)
    assert (found.time, found.score, found.ids, named) == (
        alarm.time,
        alarm.score,
        None,
        (None, None),
    )
    assert (found.score, found.time) == pytest.approx((score, 0.5 * frame))
    assert foreseen_accident(output, labels=settings.protocol, step=0.1).time == pytest.approx(
        0.1 * frame
    )


def test_a_foreseen_accident_follows_the_labels() -> None:
    output = as_maps(scene(LATE))
    apart = foreseen_accident(output, labels=None).positions - foreseen_accident(output).positions
    assert_allclose(np.abs(apart), 0.25)
    alarms = [each for each, _ in named_alarms(output, None, NOBODY, AccidentReading())]
    assert_array_equal(alarms[0].positions, foreseen_accident(output).positions)
    assert_refused(
        (lambda: foreseen_accident(output, labels="none"), ChoiceError, ("labels", "none"))
    )


def alarm(x: float = 0.0, **columns: Any) -> Accident:
    return Accident(positions=np.array([[x, 0.0], [x + 4, 0.0]]), **{"time": 1.0, **columns})


def test_explicit_alarms_are_sorted_by_sureness_time_place_and_ids_and_those_below_0_left_out() -> (
    None
):
    ordered = [
        alarm(3, score=0.9, time=2.0),
        alarm(9, score=0.5, time=0.5),
        alarm(-1, score=0.5),
        alarm(1, score=0.5, ids=(1, 2)),
        alarm(1, score=0.5, ids=(1, 3)),
        alarm(0, score=0.0),
    ]
    for mixed in (ordered, ordered[::-1]):
        given = [*mixed, alarm(score=-0.001), alarm(score=-0.5)]
        assert [each for each, _ in named_alarms(given, None, NOBODY, AccidentReading())] == ordered


@pytest.mark.parametrize(
    ("time", "names"),
    [(0.3, (4, 7)), (0.26, (4, 7)), (0.34, (4, 7)), (0.24, (None, 4)), (9.9, (7, 4))],
)
def test_an_alarm_names_who_is_there_at_the_nearest_recorded_frame(
    time: float, names: tuple[int, ...]
) -> None:
    """Only at the third frame the two are where the alarm is; at the last one they have changed
    places.
    """
    first, second = ([(x, 0.0) for x in xs] for xs in ((4, 4, 4, 0, 4, 4), (90, 90, 90, 4, 90, 0)))
    truth = replace(truth_of(first, second), actor_id=np.array([4, 7]))
    assert [
        named for _, named in named_alarms([alarm(time=time)], None, truth, AccidentReading())
    ] == [names]


def test_two_positions_are_those_of_two_in_the_order_that_fits_better() -> None:
    here = np.array([[0.0, 0.0], [4.0, 3.0]])
    assert (
        position_difference(here, here[::-1]),
        position_difference(here, here + np.array([3, 4])),
    ) == (0, 10)
    ids, center = np.array([5, 6, 8]), np.array([[0.0, 4.0], [4.0, 7.01], [math.nan, 0.0]])
    assert nearest_two(here, ids, center, 4.0) == (5, None)
    assert nearest_two(here, ids, center, 4.02) == (5, 6)
