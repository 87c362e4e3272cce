"""Which pairs are interactions, and their least and most: hand-made motions, and against all pairs
one by one.
"""

import math
import pickle
from functools import partial
from itertools import combinations

import numpy as np
import pytest
from interaction_scenes import BIKE, PEDESTRIAN, straight, tracks_of
from refusals import assert_refused

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
    Measured,
    actor_motion,
    measured_pairs,
    pair_summaries,
)
from deepaccident_devkit.v2x.tracks import scenario_tracks

DEFAULT = InteractionConfig()


def of_scene(
    paths, sizes=None, unknown=(), config=DEFAULT
) -> tuple[ActorMotion, Measured, dict[str, np.ndarray]]:
    motion = actor_motion(
        tracks_of(paths, sizes or {}, unknown),
        max((len(path) for path in paths.values()), default=0),
        config,
    )
    measured = measured_pairs(motion, config)
    return motion, measured, pair_summaries(motion, measured, config)


def pairs_in(paths, **options) -> list[tuple[int, int]]:
    motion, measured, _ = of_scene(paths, **options)
    return [tuple(pair) for pair in motion.ids[measured.pairs].tolist()]


def test_one_that_drives_up_to_another() -> None:
    motion, measured, found = of_scene({7: straight(11, 0, 0, 10), 3: straight(11, 30, 0, 0)})
    assert motion.ids.tolist() == [3, 7]
    gaps = 26 - np.arange(11.0)
    np.testing.assert_allclose(measured.values["gap"][0], gaps)
    for name in ("ttc", "ttc_1d", "mttc"):
        np.testing.assert_allclose(measured.values[name][0], gaps / 10, err_msg=name)
    np.testing.assert_allclose(measured.values["drac"][0], 100 / (2 * gaps))
    np.testing.assert_allclose(measured.values["closing_speed"][0], 10)
    assert (found["num_frames"].tolist(), found["moving"].tolist()) == ([11], [False])
    assert (found["min_ttc"].item(), found["min_gap"].item()) == (
        pytest.approx(1.6),
        pytest.approx(16),
    )
    assert found["min_ttc_frame"].item() == found["min_gap_frame"].item() == 10
    assert (found["max_drac"].item(), found["tet"].tolist()) == (
        pytest.approx(100 / 32),
        [[0, pytest.approx(1.1)]],
    )
    assert found["tit"].item(1) == pytest.approx(0.1 * sum(3 - gap / 10 for gap in gaps))


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
    assert (
        pairs_in(
            {1: straight(5, 0, 0, 10), 2: straight(5, 30, 0, 0), 3: straight(5, 0, 5.5, 10)},
            config=config,
        )
        == expected
    )


def test_one_dimension_is_that_of_the_one_who_drives_up() -> None:
    for driver, turned in ((1, 2), (2, 1)):
        _, measured, _ = of_scene(
            {driver: straight(5, 0, 0, 10), turned: straight(5, 30, 0, 0, 90)}
        )
        np.testing.assert_allclose(measured.values["ttc_1d"][0], (27 - np.arange(5)) / 10)


def test_side_by_side_there_is_a_gap_and_no_time() -> None:
    _, measured, found = of_scene({1: straight(4, 0, 0, 10), 2: straight(4, 1, 4, 10)})
    assert measured.rows.all()
    assert (found["min_ttc"].item(), found["min_ttc_frame"].item()) == (math.inf, -1)
    assert (found["min_gap"].item(), found["min_gap_frame"].item()) == (pytest.approx(2), 0)
    assert (found["max_drac"].item(), found["tet"].sum(), found["tit"].sum()) == (0, 0, 0)
    assert found["pet"].item() == math.inf


def test_two_that_stand_are_none_and_frames_at_which_both_stand_do_not_count() -> None:
    assert pairs_in({1: straight(4, 0, 0, 0), 2: straight(4, 3, 0, 0.4)}) == []  # one in the other
    _, measured, found = of_scene(
        {1: [*straight(4, 0, 0, 10), *[(3.0, 0.0, 0.0)] * 4], 2: straight(8, 9, 0, 0)}
    )
    assert (measured.counts[0].tolist(), found["num_frames"].tolist()) == (
        [True] * 4 + [False] * 4,
        [4],
    )


def test_what_rides_on_another_is_no_pair_and_one_that_is_hit_is() -> None:
    sizes, ride = {2: BIKE, 3: PEDESTRIAN}, {2: straight(6, 0, 0, 6), 3: straight(6, 0.2, 0, 6)}
    assert pairs_in(ride, sizes=sizes) == []
    assert pairs_in(
        {**ride, 3: [*straight(3, 0.2, 0, 6), *straight(3, 1.9, 3, 0)]}, sizes=sizes
    ) == [(2, 3)]
    assert pairs_in({2: straight(6, 0, 0, 6), 3: straight(6, 0.2, 0, 0)}, sizes=sizes) == [(2, 3)]


def test_who_is_not_there_and_nobody_at_all() -> None:
    motion, measured, found = of_scene(
        {1: straight(6, 0, 0, 10), 2: [None, None, (15.0, 0.0, 0.0), None, None, None]}
    )
    assert measured.counts.sum() == found["num_frames"].item() == 1
    assert (found["min_ttc"].item(), found["min_ttc_frame"].item()) == (pytest.approx(0.9), 2)
    assert motion.acceleration[1].tolist() == [0] * 6
    for paths in ({}, {5: straight(3, 0, 0, 5)}, {1: [None, (0, 0, 0)], 2: [(0, 0, 0), None]}):
        _, measured, found = of_scene(paths)
        assert len(measured.pairs) == len(found["min_ttc"]) == len(found["tet"]) == 0


def test_an_unknown_velocity_is_the_displacement_or_makes_no_numbers() -> None:
    motion, measured, _ = of_scene(
        {1: straight(5, 0, 0, 10), 2: straight(5, 30, 0, 0)}, unknown=(1,)
    )
    np.testing.assert_allclose(motion.velocity[0], np.tile([10, 0], (5, 1)))
    np.testing.assert_allclose(measured.values["ttc"][0], (26 - np.arange(5)) / 10)
    _, measured, found = of_scene(
        {1: [(6.0, 0.0, 0.0), *[None] * 4], 2: straight(5, 0, 0, 5)}, unknown=(1,)
    )
    for name in ("ttc", "ttc_1d", "drac", "mttc", "closing_speed", "delta_v"):
        assert np.isnan(measured.values[name][0, 0]).all(), name
    assert measured.values["gap"][0, 0] == pytest.approx(2)
    assert (found["min_ttc"].item(), found["max_drac"].item(), found["min_mttc"].item()) == (
        math.inf,
        0,
        math.inf,
    )


def test_braking_is_in_the_time_with_accelerations_alone() -> None:
    braking = [(way, 0.0, 0.0) for way in (10 * t - 4 * t * t for t in np.arange(10) / 10)]
    _, measured, _ = of_scene({1: braking, 2: straight(10, 12, 0, 0)})
    assert measured.values["ttc"][0, 4] == pytest.approx((12 - 4 - braking[4][0]) / (10 - 8 * 0.4))
    assert measured.values["mttc"][0, 4] == math.inf  # it needs 6.25 m


@pytest.mark.parametrize(
    "config", [DEFAULT, InteractionConfig(max_ttc=2, max_gap=1, radius=40)], ids=["wide", "narrow"]
)
def test_nothing_is_left_out_and_least_is_over_all_frames(
    da_motion: DeepAccident, config: InteractionConfig
) -> None:
    """Against every pair at every frame, without circles around boxes."""
    scenario = da_motion.find(collision=True)[0]
    motion = actor_motion(scenario_tracks(da_motion, scenario), scenario["num_frames"], config)
    measured = measured_pairs(motion, config)
    found = pair_summaries(motion, measured, config)
    pairs = np.array(list(combinations(range(len(motion.ids)), 2)))
    first, second = pairs.T
    ttc = time_to_collision(
        motion.boxes[first], motion.boxes[second], motion.velocity[first], motion.velocity[second]
    )
    ttc = np.where(ttc > config.horizon, np.inf, ttc)
    gap = gaps_of_pairs(motion.boxes[first], motion.boxes[second])
    apart = np.linalg.norm(motion.boxes[first, :, :2] - motion.boxes[second, :, :2], axis=-1)
    counts = ~np.isnan(gap) & (motion.moves[first] | motion.moves[second])
    under = counts & (apart <= config.radius) & ((ttc <= config.max_ttc) | (gap <= config.max_gap))
    listed = under.any(axis=1)
    assert 3 < listed.sum() < len(pairs)
    np.testing.assert_array_equal(measured.pairs, pairs[listed])
    np.testing.assert_array_equal(measured.rows, under[listed])
    np.testing.assert_array_equal(
        found["min_ttc"], np.where(counts, ttc, np.inf).min(axis=1)[listed]
    )
    np.testing.assert_array_equal(
        found["min_gap"], np.where(counts, gap, np.inf).min(axis=1)[listed]
    )


def test_a_config_is_checked_and_travels() -> None:
    config = InteractionConfig(max_ttc=3, class_masses={**CLASS_MASSES, "car": 1400})
    assert pickle.loads(pickle.dumps(config)) == config != DEFAULT
    assert_refused(
        *[
            (partial(InteractionConfig, **wrong), ConfigError, told)
            for wrong, told in (
                ({"radius": -1}, "radius: expected a number from 0, found -1"),
                ({"max_ttc": math.nan}, "max_ttc: expected a number from 0, found nan"),
                ({"max_gap": "far"}, "max_gap: expected a number, found 'far'"),
                ({"taus": (1.5,)}, "taus: expected two thresholds in seconds, found 1"),
                ({"horizon": 2}, "horizon: expected at least max_ttc, 10.0 s, found 2.0 s"),
            )
        ],
    )
