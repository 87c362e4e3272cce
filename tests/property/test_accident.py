"""Laws of the accident metrics `paper` and `boxes`, and of the hulls they stand on."""

import math
from dataclasses import replace

import numpy as np
from accident_scenes import FRAMES, as_heads, as_maps, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from shapely import MultiPoint, get_coordinates

from deepaccident_devkit.evaluation.accident import AccidentEvaluator
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
def crowds(draw: st.DrawFn, most: int = 6) -> dict[int, list[tuple[float, float]]]:
    """Cars by actor id that drive straight, so near to one another that many meet, some of them
    beyond the grid.
    """
    places = st.tuples(st.integers(-24, 24), st.integers(-24, 24))
    cars = {}
    for actor in range(1, 1 + draw(st.integers(0, most))):
        (x, y), (dx, dy) = draw(places), draw(st.tuples(st.integers(-6, 6), st.integers(-6, 6)))
        cars[actor] = [(x / 2 + 38 + dx / 2 * t, y / 2 + dy / 2 * t) for t in range(FRAMES)]
    return cars


@st.composite
def maps(draw: st.DrawFn) -> np.ndarray:
    """Small instance maps (T, H, W) of any shapes, instances in pieces among them."""
    shape = draw(st.tuples(st.integers(1, 4), st.integers(3, 9), st.integers(3, 9)))
    cells = hnp.arrays(np.int32, shape, elements=st.integers(0, 4), fill=st.just(0))
    return draw(cells)


@given(point_sets())
def test_hulls_are_shapelys(sets) -> None:
    points = np.concatenate(sets)
    group = np.repeat(np.arange(len(sets)), [len(each) for each in sets])
    mixed = np.random.default_rng(len(points)).permutation(len(points))
    hulls = convex_hulls(points[mixed], group[mixed])
    expected = [MultiPoint(each).convex_hull for each in sets]
    for hull, shape in zip(hulls, expected, strict=True):
        assert_array_equal(np.unique(hull, axis=0), np.unique(get_coordinates(shape), axis=0))
    first, second = np.triu_indices(len(sets), 1)
    distances = hull_distances(hulls[first], hulls[second])
    for found, one, other in zip(distances, first, second, strict=True):
        exact = expected[one].distance(expected[other])
        assert_allclose(found, exact, atol=1e-12)
        assert (found == 0) == (exact == 0)
    assert_array_equal(hull_distances(hulls[second], hulls[first]), distances)


@given(maps())
def test_the_contact_is_the_least_of_all_pairs_and_frames(instance) -> None:
    """Against shapely, pair by pair."""
    shape = instance.shape[1:]
    grid = BevGrid(x=(0, shape[1] / 2, 0.5), y=(0, shape[0] / 2, 0.5))
    reading = AccidentReading(danger_distance=1.25)
    found = map_accident(instance, grid, NO_SHIFT, reading)
    candidates = []
    for frame in range(len(instance)):
        ids = np.unique(instance[frame][instance[frame] > 0]).tolist()
        cells = {one: np.argwhere(instance[frame] == one) for one in ids}
        hulls = {one: MultiPoint(at / 2).convex_hull for one, at in cells.items()}
        for place, one in enumerate(ids):
            for other in ids[place + 1 :]:
                between = np.linalg.norm(cells[one].mean(axis=0) - cells[other].mean(axis=0)) / 2
                distance = hulls[one].distance(hulls[other])
                candidates.append((round(distance, 9), frame, round(between, 9), one, other))
    near = [each for each in candidates if each[0] < 1.25]
    if not near:
        assert found.contact is None
        return
    distance, frame, _, one, other = min(near)
    assert (found.contact.frame, found.contact.ids) == (frame, (one, other))
    assert_allclose(found.contact.distance, distance, atol=1e-9)
    y, x = (np.argwhere(instance[frame] == one).mean(axis=0) + 0.5) / 2
    assert_allclose(found.positions[0], [x, y])


@given(maps(), st.sampled_from(ORIENTATIONS))
def test_orientations_do_not_matter(instance, orientation) -> None:
    grid = BevGrid(x=(0, instance.shape[2] / 2, 0.5), y=(0, instance.shape[1] / 2, 0.5))
    turned = grid.reorient(instance, orientation)
    for rules in LABEL_PROTOCOLS.values():
        here = map_accident(instance, grid, rules, PAPER.reading)
        there = map_accident(turned, grid.with_orientation(orientation), rules, PAPER.reading)
        assert here.contact == there.contact
        assert_array_equal(here.tracks.center, there.tracks.center)


@settings(max_examples=25)
@given(crowds(), st.permutations(range(10, 16)))
def test_perfect_maps_are_perfect_whatever_their_ids(cars, names) -> None:
    label = scene(cars)
    renamed = np.array([0, *names])[label.instance]
    output = MotionOutput(grid=label.config.grid, instances=np.stack([renamed, label.instance]))
    made = PAPER.result([PAPER.counts(output, label, UNKNOWN)])
    for each in (made, made.beside["sample_choice=mean_first"]):
        assert each.apa == 1 if each.positives else math.isnan(each.apa)
        assert (each.position_error, each.time_error) == (
            (0, 0) if each.positives else (None, None)
        )
    # of equally near pairs that with the lower ids is taken, and the names of the first prediction
    # order otherwise
    assert made.beside["sample_choice=mean_first"].id_error == (0 if made.positives else None)


@settings(max_examples=15)
@given(crowds())
def test_perfect_heads_are_perfect(cars) -> None:
    label = scene(cars)
    made = PAPER.result([PAPER.counts(as_heads(label, label), label, UNKNOWN)])
    assert made.apa == 1 if made.positives else math.isnan(made.apa)
    assert (made.id_error, made.position_error, made.time_error) == (
        (0, 0, 0) if made.positives else (None,) * 3
    )


@settings(max_examples=15)
@given(st.lists(st.tuples(crowds(4), crowds(4)), min_size=1, max_size=4), st.integers(0, 3))
def test_any_order_and_any_split_give_the_same_bits(pairs, cut) -> None:
    whole, left, right = (AccidentEvaluator(protocol=PAPER) for _ in range(3))
    samples = [
        (f"s{number}", as_maps(scene(told)), scene(true))
        for number, (told, true) in enumerate(pairs)
    ]
    for sample in samples:
        whole.update(*sample)
    for number, sample in enumerate(reversed(samples)):
        (left if number < cut else right).update(*sample)
    expected, found = whole.compute(), right.merge(left).compute()
    assert repr(expected.as_dict()) == repr(found.as_dict())


@given(
    hnp.arrays(np.float64, (3, 5, 2), elements=st.floats(-20, 20)),
    st.permutations(range(5)),
    st.floats(0.1, 30),
)
def test_a_match_is_one_to_one_within_the_gate_and_finds_the_same(center, order, gate) -> None:
    truth = InstanceTracks(identity=np.arange(5) + 7, center=center)
    same = InstanceTracks(identity=np.arange(5), center=center[:, list(order)])
    assert_allclose(
        center[:, [match - 7 for match in match_tracks(same, truth, gate).values()]],
        same.center,
        atol=1e-9,
    )
    apart = replace(same, center=same.center + np.array([100.0, 0.0]))
    assert match_tracks(apart, truth, gate) == {}
    absent = replace(same, center=np.full_like(center, np.nan))
    assert match_tracks(absent, truth, gate) == {}
    nobody = InstanceTracks(identity=np.zeros(0, dtype=np.int64), center=np.zeros((3, 0, 2)))
    assert match_tracks(nobody, truth, gate) == {}
