"""Laws of the accident metrics `paper` and `boxes`, and of the hulls they stand on."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from shapely import MultiPoint, get_coordinates
from support.accident_scenes import FRAMES, motion_labels_of, to_heads_output, to_instance_output

from deepaccident_devkit.evaluation.accident import AccidentEvaluator, AccidentResult
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.map_accidents import (
    AccidentReading,
    InstanceTracks,
    convex_hulls,
    hull_distances,
    map_accident,
    match_tracks,
)
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import LABEL_PROTOCOLS

PAPER = PaperAccidents()
UNKNOWN = AccidentContext()
NO_SHIFT = LABEL_PROTOCOLS["clean"]
coordinates = st.integers(-8, 8)


@st.composite
def point_sets(draw: st.DrawFn) -> list[np.ndarray]:
    """Sets of lattice points: single ones, straight lines and scattered ones."""
    sets = []
    for _ in range(draw(st.integers(1, 5))):
        points = draw(
            hnp.arrays(np.int64, st.tuples(st.integers(1, 12), st.just(2)), elements=coordinates)
        )
        if draw(st.booleans()):
            points = points[:1] + np.arange(len(points))[:, None] * points[-1:]
        sets.append(points)
    return sets


@st.composite
def crowds(draw: st.DrawFn, max_cars: int = 6) -> dict[int, list[tuple[float, float]]]:
    """Cars by actor id that drive straight, so close together that many collide.

    Some drive beyond the grid.
    """
    half_meters = st.integers(-24, 24)
    half_steps = st.integers(-6, 6)
    cars = {}
    for actor in range(1, 1 + draw(st.integers(0, max_cars))):
        x, y = draw(half_meters) / 2 + 38, draw(half_meters) / 2
        dx, dy = draw(half_steps) / 2, draw(half_steps) / 2
        cars[actor] = [(x + dx * t, y + dy * t) for t in range(FRAMES)]
    return cars


@st.composite
def maps(draw: st.DrawFn) -> np.ndarray:
    """Small instance maps (T, H, W) of any shapes, instances in pieces among them."""
    shape = draw(st.tuples(st.integers(1, 4), st.integers(3, 9), st.integers(3, 9)))
    cells = hnp.arrays(np.int32, shape, elements=st.integers(0, 4), fill=st.just(0))
    return draw(cells)


def make_grid(instance: np.ndarray) -> BevGrid:
    _, rows, columns = instance.shape
    return BevGrid(x=(0, columns / 2, 0.5), y=(0, rows / 2, 0.5))


@given(point_sets())
def test_hulls_are_shapelys(sets) -> None:
    points = np.concatenate(sets)
    group = np.repeat(np.arange(len(sets)), list(map(len, sets)))
    order = np.random.default_rng(len(points)).permutation(len(points))
    hulls = convex_hulls(points[order], group[order])
    expected = [MultiPoint(point_set).convex_hull for point_set in sets]
    for hull, shape in zip(hulls, expected, strict=True):
        assert_array_equal(np.unique(hull, axis=0), np.unique(get_coordinates(shape), axis=0))

    first, second = np.triu_indices(len(sets), 1)
    distances = hull_distances(hulls[first], hulls[second])
    for distance, i, j in zip(distances, first, second, strict=True):
        expected_distance = expected[i].distance(expected[j])
        assert_allclose(distance, expected_distance, atol=1e-12)
        assert (distance == 0) == (expected_distance == 0)
    assert_array_equal(hull_distances(hulls[second], hulls[first]), distances)


@given(maps())
def test_the_contact_is_the_least_of_all_pairs_and_frames(instance) -> None:
    """Compares with shapely, pair by pair."""
    grid = make_grid(instance)
    reading = AccidentReading(danger_distance=1.25)
    accident = map_accident(instance, grid, NO_SHIFT, reading)

    candidates = []
    for frame, frame_instance in enumerate(instance):
        ids = np.unique(frame_instance[frame_instance > 0]).tolist()
        cells = {name: np.argwhere(frame_instance == name) / 2 for name in ids}
        hulls = {name: MultiPoint(points).convex_hull for name, points in cells.items()}
        for first, second in combinations(ids, 2):
            distance = hulls[first].distance(hulls[second])
            offset = cells[first].mean(axis=0) - cells[second].mean(axis=0)
            center_distance = round(np.linalg.norm(offset), 9)
            candidates.append((round(distance, 9), frame, center_distance, first, second))
    dangerous = [candidate for candidate in candidates if candidate[0] < 1.25]
    if not dangerous:
        assert accident.contact is None
        return
    distance, frame, _, first, second = min(dangerous)
    assert accident.contact.frame == frame
    assert accident.contact.ids == (first, second)
    assert_allclose(accident.contact.distance, distance, atol=1e-9)
    y, x = (np.argwhere(instance[frame] == first).mean(axis=0) + 0.5) / 2
    assert_allclose(accident.positions[0], [x, y])


@given(maps(), st.sampled_from(ORIENTATIONS))
def test_orientations_do_not_matter(instance, orientation) -> None:
    grid = make_grid(instance)
    turned_grid = grid.with_orientation(orientation)
    turned_instance = grid.reorient(instance, orientation)
    for rules in LABEL_PROTOCOLS.values():
        accident = map_accident(instance, grid, rules, PAPER.reading)
        turned_accident = map_accident(turned_instance, turned_grid, rules, PAPER.reading)
        assert accident.contact == turned_accident.contact
        assert_array_equal(accident.tracks.center, turned_accident.tracks.center)


def assert_perfect(result: AccidentResult) -> None:
    if result.positives:
        assert result.apa == 1
        assert (result.position_error, result.time_error) == (0, 0)
    else:
        assert math.isnan(result.apa)
        assert (result.position_error, result.time_error) == (None, None)


@settings(max_examples=25)
@given(crowds(), st.permutations(range(10, 16)))
def test_perfect_maps_are_perfect_whatever_their_ids(cars, names) -> None:
    label = motion_labels_of(cars)
    renamed = np.array([0, *names])[label.instance]
    output = MotionOutput(grid=label.config.grid, instances=np.stack([renamed, label.instance]))
    result = PAPER.result([PAPER.counts(output, label, UNKNOWN)])
    mean_first = result.beside["sample_choice=mean_first"]
    assert_perfect(result)
    assert_perfect(mean_first)
    # the pair with the lower ids wins a tie; the ids of the first prediction have another order
    assert mean_first.id_error == (0 if result.positives else None)


@settings(max_examples=15)
@given(crowds())
def test_perfect_heads_are_perfect(cars) -> None:
    label = motion_labels_of(cars)
    result = PAPER.result([PAPER.counts(to_heads_output(label, label), label, UNKNOWN)])
    assert_perfect(result)
    assert result.id_error == (0 if result.positives else None)


@settings(max_examples=15)
@given(st.lists(st.tuples(crowds(4), crowds(4)), min_size=1, max_size=4), st.integers(0, 3))
def test_any_order_and_any_split_give_the_same_bits(pairs, cut) -> None:
    samples = []
    for number, (predicted_cars, true_cars) in enumerate(pairs):
        output = to_instance_output(motion_labels_of(predicted_cars))
        samples.append((f"s{number}", output, motion_labels_of(true_cars)))
    evaluator = AccidentEvaluator(protocol=PAPER)
    for sample in samples:
        evaluator.update(*sample)

    first_part = AccidentEvaluator(protocol=PAPER)
    second_part = AccidentEvaluator(protocol=PAPER)
    for number, sample in enumerate(reversed(samples)):
        part = first_part if number < cut else second_part
        part.update(*sample)
    merged = second_part.merge(first_part).compute()
    assert repr(merged.as_dict()) == repr(evaluator.compute().as_dict())


@given(
    hnp.arrays(np.float64, (3, 5, 2), elements=st.floats(-20, 20)),
    st.permutations(range(5)),
    st.floats(0.1, 30),
)
def test_a_match_is_one_to_one_within_the_gate_and_finds_the_same(center, order, gate) -> None:
    truth = InstanceTracks(identity=np.arange(5) + 7, center=center)
    tracks = InstanceTracks(identity=np.arange(5), center=center[:, list(order)])
    matches = match_tracks(tracks, truth, gate)
    matched_rows = [identity - 7 for identity in matches.values()]
    assert_allclose(center[:, matched_rows], tracks.center, atol=1e-9)

    distant = replace(tracks, center=tracks.center + np.array([100.0, 0.0]))
    assert match_tracks(distant, truth, gate) == {}
    absent = replace(tracks, center=np.full_like(center, np.nan))
    assert match_tracks(absent, truth, gate) == {}
    empty = InstanceTracks(identity=np.zeros(0, dtype=np.int64), center=np.zeros((3, 0, 2)))
    assert match_tracks(empty, truth, gate) == {}
