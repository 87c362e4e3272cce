"""Which pairs are interactions, and their extreme values, by hand and against every pair."""

import math
import pickle
from functools import partial
from itertools import combinations

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.interaction_scenes import BIKE_SIZE, PEDESTRIAN_SIZE, make_tracks, straight_path

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.interactions import (
    CLASS_MASSES,
    InteractionConfig,
    gaps_of_pairs,
    time_to_collision,
)
from deepaccident_devkit.interactions.compute import (
    ActorMotion,
    MeasuredPairs,
    actor_motion,
    measured_pairs,
    pair_summaries,
)
from deepaccident_devkit.v2x.tracks import scenario_tracks

DEFAULT = InteractionConfig()


def measure_scene(
    paths, sizes=None, unknown=(), config=DEFAULT
) -> tuple[ActorMotion, MeasuredPairs, dict[str, np.ndarray]]:
    num_frames = max((len(path) for path in paths.values()), default=0)
    motion = actor_motion(make_tracks(paths, sizes or {}, unknown), num_frames, config)
    measured = measured_pairs(motion, config)
    return motion, measured, pair_summaries(motion, measured, config)


def find_pairs(paths, **options) -> list[tuple[int, int]]:
    motion, measured, _ = measure_scene(paths, **options)
    return [tuple(pair) for pair in motion.ids[measured.pairs].tolist()]


def test_one_that_drives_up_to_another() -> None:
    motion, measured, summaries = measure_scene(
        {7: straight_path(11, 0, 0, 10), 3: straight_path(11, 30, 0, 0)}
    )
    assert motion.ids.tolist() == [3, 7]
    gaps = 26 - np.arange(11.0)
    np.testing.assert_allclose(measured.values["gap"][0], gaps)
    for name in ("ttc", "ttc_1d", "mttc"):
        np.testing.assert_allclose(measured.values[name][0], gaps / 10, err_msg=name)
    np.testing.assert_allclose(measured.values["drac"][0], 100 / (2 * gaps))
    np.testing.assert_allclose(measured.values["closing_speed"][0], 10)

    assert summaries["num_frames"].tolist() == [11]
    assert summaries["moving"].tolist() == [False]
    assert summaries["min_ttc"].item() == pytest.approx(1.6)
    assert summaries["min_gap"].item() == pytest.approx(16)
    assert summaries["min_ttc_frame"].item() == summaries["min_gap_frame"].item() == 10
    assert summaries["max_drac"].item() == pytest.approx(100 / 32)
    assert summaries["tet"].tolist() == [[0, pytest.approx(1.1)]]
    assert summaries["tit"].item(1) == pytest.approx(0.1 * sum(3 - gap / 10 for gap in gaps))


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (InteractionConfig(), [(1, 2), (1, 3)]),
        (InteractionConfig(max_ttc=2.1), [(1, 3)]),  # 2.2 s at the last frame
        (InteractionConfig(max_ttc=2.2, max_gap=3.4), [(1, 2)]),
        (InteractionConfig(max_gap=3.5), [(1, 2), (1, 3)]),
        (InteractionConfig(radius=25.9), [(1, 3)]),
        (InteractionConfig(radius=26.1), [(1, 2), (1, 3)]),
    ],
)
def test_thresholds_decide_and_so_does_the_radius(
    config: InteractionConfig, expected: list[tuple[int, int]]
) -> None:
    paths = {
        1: straight_path(5, 0, 0, 10),
        2: straight_path(5, 30, 0, 0),
        3: straight_path(5, 0, 5.5, 10),
    }
    assert find_pairs(paths, config=config) == expected


def test_one_dimension_is_that_of_the_one_who_drives_up() -> None:
    for moving_id, standing_id in ((1, 2), (2, 1)):
        _, measured, _ = measure_scene(
            {moving_id: straight_path(5, 0, 0, 10), standing_id: straight_path(5, 30, 0, 0, 90)}
        )
        np.testing.assert_allclose(measured.values["ttc_1d"][0], (27 - np.arange(5)) / 10)


def test_side_by_side_there_is_a_gap_and_no_time() -> None:
    _, measured, summaries = measure_scene(
        {1: straight_path(4, 0, 0, 10), 2: straight_path(4, 1, 4, 10)}
    )
    assert measured.rows.all()
    assert summaries["min_ttc"].item() == math.inf
    assert summaries["min_ttc_frame"].item() == -1
    assert summaries["min_gap"].item() == pytest.approx(2)
    assert summaries["min_gap_frame"].item() == 0
    assert summaries["max_drac"].item() == 0
    assert summaries["tet"].sum() == 0
    assert summaries["tit"].sum() == 0
    assert summaries["pet"].item() == math.inf


def test_two_that_stand_are_none_and_frames_at_which_both_stand_do_not_count() -> None:
    overlapping = {1: straight_path(4, 0, 0, 0), 2: straight_path(4, 3, 0, 0.4)}
    assert find_pairs(overlapping) == []

    stopping_path = [*straight_path(4, 0, 0, 10), *[(3.0, 0.0, 0.0)] * 4]
    _, measured, summaries = measure_scene({1: stopping_path, 2: straight_path(8, 9, 0, 0)})
    assert measured.counts[0].tolist() == [True] * 4 + [False] * 4
    assert summaries["num_frames"].tolist() == [4]


def test_what_rides_on_another_is_no_pair_and_one_that_is_hit_is() -> None:
    sizes = {2: BIKE_SIZE, 3: PEDESTRIAN_SIZE}
    bike = straight_path(6, 0, 0, 6)
    assert find_pairs({2: bike, 3: straight_path(6, 0.2, 0, 6)}, sizes=sizes) == []

    falling_rider = [*straight_path(3, 0.2, 0, 6), *straight_path(3, 1.9, 3, 0)]
    assert find_pairs({2: bike, 3: falling_rider}, sizes=sizes) == [(2, 3)]

    standing_pedestrian = straight_path(6, 0.2, 0, 0)
    assert find_pairs({2: bike, 3: standing_pedestrian}, sizes=sizes) == [(2, 3)]


def test_an_actor_that_is_seen_once_counts_once_and_without_pairs_all_is_empty() -> None:
    motion, measured, summaries = measure_scene(
        {1: straight_path(6, 0, 0, 10), 2: [None, None, (15.0, 0.0, 0.0), None, None, None]}
    )
    assert measured.counts.sum() == summaries["num_frames"].item() == 1
    assert summaries["min_ttc"].item() == pytest.approx(0.9)
    assert summaries["min_ttc_frame"].item() == 2
    assert motion.acceleration[1].tolist() == [0] * 6

    for paths in ({}, {5: straight_path(3, 0, 0, 5)}, {1: [None, (0, 0, 0)], 2: [(0, 0, 0), None]}):
        _, measured, summaries = measure_scene(paths)
        assert len(measured.pairs) == len(summaries["min_ttc"]) == len(summaries["tet"]) == 0


def test_an_unknown_velocity_is_the_displacement_or_makes_no_numbers() -> None:
    motion, measured, _ = measure_scene(
        {1: straight_path(5, 0, 0, 10), 2: straight_path(5, 30, 0, 0)}, unknown=(1,)
    )
    np.testing.assert_allclose(motion.velocity[0], np.tile([10, 0], (5, 1)))
    np.testing.assert_allclose(measured.values["ttc"][0], (26 - np.arange(5)) / 10)

    _, measured, summaries = measure_scene(
        {1: [(6.0, 0.0, 0.0), *[None] * 4], 2: straight_path(5, 0, 0, 5)}, unknown=(1,)
    )
    for name in ("ttc", "ttc_1d", "drac", "mttc", "closing_speed", "delta_v"):
        assert np.isnan(measured.values[name][0, 0]).all(), name
    assert measured.values["gap"][0, 0] == pytest.approx(2)
    assert summaries["min_ttc"].item() == math.inf
    assert summaries["max_drac"].item() == 0
    assert summaries["min_mttc"].item() == math.inf


def test_only_the_time_with_accelerations_includes_braking() -> None:
    braking_path = [(10 * t - 4 * t * t, 0.0, 0.0) for t in np.arange(10) / 10]
    _, measured, _ = measure_scene({1: braking_path, 2: straight_path(10, 12, 0, 0)})
    gap_m = 12 - 4 - braking_path[4][0]
    assert measured.values["ttc"][0, 4] == pytest.approx(gap_m / (10 - 8 * 0.4))
    assert measured.values["mttc"][0, 4] == math.inf  # it needs 6.25 m


@pytest.mark.parametrize(
    "config", [DEFAULT, InteractionConfig(max_ttc=2, max_gap=1, radius=40)], ids=["wide", "narrow"]
)
def test_nothing_is_left_out_and_least_is_over_all_frames(
    da_motion: DeepAccident, config: InteractionConfig
) -> None:
    """Compares with every pair at every frame, which uses no circles around boxes."""
    scenario = da_motion.find(collision=True)[0]
    motion = actor_motion(scenario_tracks(da_motion, scenario), scenario["num_frames"], config)
    measured = measured_pairs(motion, config)
    summaries = pair_summaries(motion, measured, config)

    pairs = np.array(list(combinations(range(len(motion.ids)), 2)))
    first, second = pairs.T
    ttc = time_to_collision(
        motion.boxes[first], motion.boxes[second], motion.velocity[first], motion.velocity[second]
    )
    ttc = np.where(ttc > config.horizon, np.inf, ttc)
    gap = gaps_of_pairs(motion.boxes[first], motion.boxes[second])
    offsets = motion.boxes[first, :, :2] - motion.boxes[second, :, :2]
    is_in_radius = np.linalg.norm(offsets, axis=-1) <= config.radius
    counts = ~np.isnan(gap) & (motion.moves[first] | motion.moves[second])
    is_critical = (ttc <= config.max_ttc) | (gap <= config.max_gap)
    rows = counts & is_in_radius & is_critical
    is_listed = rows.any(axis=1)
    min_ttc = np.where(counts, ttc, np.inf).min(axis=1)
    min_gap = np.where(counts, gap, np.inf).min(axis=1)

    assert 3 < is_listed.sum() < len(pairs)
    np.testing.assert_array_equal(measured.pairs, pairs[is_listed])
    np.testing.assert_array_equal(measured.rows, rows[is_listed])
    np.testing.assert_array_equal(summaries["min_ttc"], min_ttc[is_listed])
    np.testing.assert_array_equal(summaries["min_gap"], min_gap[is_listed])


def test_a_config_is_checked_and_travels() -> None:
    config = InteractionConfig(max_ttc=3, class_masses={**CLASS_MASSES, "car": 1400})
    assert pickle.loads(pickle.dumps(config)) == config != DEFAULT
    assert_raises(
        *[
            (partial(InteractionConfig, **options), ConfigError, message)
            for options, message in (
                ({"radius": -1}, "radius: expected a number from 0, found -1"),
                ({"max_ttc": math.nan}, "max_ttc: expected a number from 0, found nan"),
                ({"max_gap": "far"}, "max_gap: expected a number, found 'far'"),
                ({"taus": (1.5,)}, "taus: expected two thresholds in seconds, found 1"),
                ({"horizon": 2}, "horizon: expected at least max_ttc, 10.0 s, found 2.0 s"),
            )
        ],
    )
