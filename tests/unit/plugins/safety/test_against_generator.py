"""30 synthetic accidents: the results of safety from the labels against the generator's knowledge.

The first 21 are of all designs; three in ten of them are unplanned (with pedestrians or a third
vehicle). In the other 9 a house hides the colliders from each other. All show the last 3 s. The
generator's side is in tests/support/generator_truth.py.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support import generator_truth as generator
from support.generator_truth import STEPS_PER_FRAME, GeneratorTruth

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import Accident, accidents_of, undisturbed
from deepaccident_devkit.collisions.contact import pair_of
from deepaccident_devkit.descriptions import ObservationRule, observed_actors
from deepaccident_devkit.descriptions.avoidability import MASKS, last_moments
from deepaccident_devkit.interactions import masses_of
from deepaccident_devkit.plugins.safety import COALITIONS, lead_times
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import RecordingJob
from deepaccident_devkit.plugins.synth.traffic.driving import HARDEST_BRAKING
from deepaccident_devkit.plugins.synth.traffic.simulate import gap
from deepaccident_devkit.support.parallel import in_order, run_unordered
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, FRAME_PERIOD

pytestmark = pytest.mark.slow

OPEN_PAIRS, PAIRS = 21, 30
MAX_SPEED_LAG = HARDEST_BRAKING * FRAME_PERIOD / 2
"""m/s: largest difference between the mean speed of the last tenth of a second and the speed at its
end.
"""
SLOPE_TOLERANCE_M = 0.01
"""Largest change of a gap when boxes lean on a slope instead of being seen from straight above."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GeneratedAccidents:
    """A release, its accidents as safety reads them, and the generator's truth about each."""

    da: DeepAccident
    accidents: Sequence[Accident]
    truths: Sequence[GeneratorTruth]

    def __iter__(self) -> Iterator[tuple[Accident, GeneratorTruth]]:
        return zip(self.accidents, self.truths, strict=True)


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> GeneratedAccidents:
    root = tmp_path_factory.mktemp("accidents") / "release"
    truths = list(in_order(run_unordered(generator.record_truth, make_jobs(root), workers=2)))
    da = DeepAccident("v1", root, verbose=False)

    accidents, _ = accidents_of(da)
    accident_of = {accident.scenario: accident for accident in accidents}
    ordered = [accident_of[truth.scenario] for truth in truths]
    return GeneratedAccidents(da=da, accidents=ordered, truths=truths)


def make_jobs(root: Path) -> list[RecordingJob]:
    open_config = SynthConfig(
        scenarios=2 * PAIRS,
        frames=30,
        sensors=False,
        seed=26,
        unplanned=0.3,
        exact=True,
        designed=True,
    )
    hidden_config = replace(open_config, view="hidden")
    plans = [(open_config, plan) for plan in plan_scenarios(open_config)[: 2 * OPEN_PAIRS]]
    plans += [(hidden_config, plan) for plan in plan_scenarios(hidden_config)[2 * OPEN_PAIRS :]]
    return [RecordingJob(root, config, plan) for config, plan in plans if plan.accident]


def test_they_are_of_many_kinds(generated: GeneratedAccidents) -> None:
    assert len({truth.design for truth in generated.truths}) == 12
    assert any("pedestrian" in accident.categories for accident in generated.accidents)
    assert sum(None in accident.agents for accident in generated.accidents) >= 3


def test_the_pair_its_motion_and_its_contact(generated: GeneratedAccidents) -> None:
    for accident, truth in generated:
        collision = truth.meta.collision
        assert accident.actor_ids == collision.ids
        assert accident.agents == collision.agents
        assert accident.categories == collision.classes

        np.testing.assert_allclose(
            accident.paths[..., :2],
            truth.world_paths[..., :2],
            atol=1e-4,
        )
        yaw_errors = accident.paths[..., 2] - truth.world_paths[..., 2]
        assert np.abs(np.sin(yaw_errors)).max() < 1e-4
        np.testing.assert_allclose(accident.sizes, truth.sizes, atol=1e-6)

        check = undisturbed(accident)
        contact = generated.da.collision(truth.scenario)
        poses = truth.fine[:, -1]
        sizes = truth.sizes[:, :2]
        last_gap = float(gap(poses[0], sizes[0], poses[1], sizes[1]))
        assert check.usable is True
        assert contact.disagreements == ()
        assert check.margin == pytest.approx(last_gap, abs=SLOPE_TOLERANCE_M)
        assert contact.gap == pytest.approx(last_gap, abs=SLOPE_TOLERANCE_M)

        assert accident.duration == pytest.approx((truth.frames - 1) / 10)
        assert accident.duration - 0.01 <= check.time <= accident.duration

        turn = np.subtract(*poses[:, 2])
        angle = np.abs(np.arctan2(np.sin(turn), np.cos(turn)))
        assert contact.impact_angle == pytest.approx(angle, abs=0.01)

        flank = collision.contact_side.endswith("_side")
        expected_sides = ("left", "right") if flank else (collision.contact_side,)
        assert contact.sides[0] in expected_sides


def test_speeds_and_severity(generated: GeneratedAccidents) -> None:
    for accident, truth in generated:
        check = undisturbed(accident)
        contact = generated.da.collision(truth.scenario)
        recent = truth.velocities[:, -STEPS_PER_FRAME - 1 :]
        mean = (recent[:, 1:] + recent[:, :-1]).mean(axis=1) / 2
        categories = [CATEGORIES.index(name) for name in truth.meta.collision.classes]
        masses = masses_of(categories, truth.sizes)

        for velocities, tolerance in (
            (mean, 0.02),
            (truth.velocities[:, -1], MAX_SPEED_LAG + 0.02),
        ):
            speeds = np.hypot(*velocities.T)
            np.testing.assert_allclose([check.speeds, contact.speeds], [speeds] * 2, atol=tolerance)

            relative_velocity = velocities[0] - velocities[1]
            delta_v = np.hypot(*relative_velocity) * masses[::-1] / masses.sum()
            np.testing.assert_allclose(check.delta_v, delta_v, atol=2 * tolerance)

            closing_speed = relative_velocity @ generator.contact_direction(truth)
            assert contact.closing_speed == pytest.approx(closing_speed, abs=2 * tolerance)


def test_the_time_to_collision_of_the_last_second(generated: GeneratedAccidents) -> None:
    for accident, truth in generated:
        table = generated.da.interactions(truth.scenario)
        rows = table.of_pair(*accident.actor_ids)
        rows = rows[(table.frame[rows] > truth.frames - 10) & (table.ttc[rows] < 3)]

        steps = (table.frame[rows] - 1) * STEPS_PER_FRAME
        expected = [generator.time_to_contact(truth, step) for step in steps.tolist()]
        np.testing.assert_allclose(table.ttc[rows], expected, atol=0.005)

        pair = table.pairs.position(*accident.actor_ids)
        assert table.pairs.min_ttc[pair] == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("kind", ["points", "released"])
def test_who_was_hidden_and_how_long(generated: GeneratedAccidents, kind: str) -> None:
    da = generated.da
    rule = ObservationRule(kind=kind)
    leads = []
    for accident, truth in generated:
        expected_seen = observed_by_rays(accident, truth, kind)
        expected_leads = [lead_time(expected_seen, members) for members in COALITIONS]

        agents, seen = observed_actors(da, truth.scenario, accident.actor_ids, rule)
        times = lead_times(da, truth.scenario, rule)

        assert agents == AGENTS
        np.testing.assert_array_equal(seen, expected_seen)
        np.testing.assert_allclose(times.leads, expected_leads, atol=1e-9)
        leads.append(expected_leads)

    ego_leads, joint_leads = np.array(leads)[:, 0], np.array(leads)[:, -1]
    assert (ego_leads[OPEN_PAIRS:] < 1.5).all()
    assert (joint_leads[OPEN_PAIRS:] > 2.8).all()


def observed_by_rays(accident: Accident, truth: GeneratorTruth, kind: str) -> np.ndarray:
    """Return whether each agent observes each collider, by its rays and cameras, (5, 2, F)."""
    sights = truth.sights
    observed = np.zeros(sights.points.shape, dtype=bool)
    for agent, collider in product(range(len(AGENTS)), (0, 1)):
        points = sights.points[agent, collider]
        if kind == "points":
            seen = points >= 5
        else:
            infrastructure = AGENTS[agent] == "infrastructure"
            small = accident.categories[collider] not in ("car", "van", "truck")
            near_points = 2 if small else 5
            far_points = 1 if small else 2
            near_points = 1 if infrastructure else near_points

            near = sights.distance[agent, collider] < (15 if infrastructure else 10)
            in_camera = sights.pixels[agent, collider] > 0
            seen = np.where(
                near,
                in_camera | (points >= near_points),
                in_camera & (points >= far_points),
            )

        tracked = sights.tracked[agent, collider] > 0
        is_agent_itself = accident.agents[collider] == AGENTS[agent]
        observed[agent, collider] = (seen & tracked) | is_agent_itself
    return observed


def lead_time(observed: np.ndarray, members: Sequence[str]) -> float:
    """Return how long before the last frame the members first observe both colliders, s."""
    rows = [AGENTS.index(name) for name in members]
    both = observed[rows].any(axis=0).all(axis=0)
    if not both.any():
        return 0.0

    return (len(both) - 1 - int(np.argmax(both))) / 10


def test_the_last_moment_to_brake_in_the_exact_motion(generated: GeneratedAccidents) -> None:
    """Labels of 10 Hz move it by at most 0.04 s. Exact motions are tried every 0.02 s, motions from
    labels every 0.01 s.
    """
    for accident, truth in generated:
        pair = pair_of(accident.paths, accident.sizes)

        for brakers in MASKS:
            last_moment = last_moments(pair, brakers, [6.0]).time[0]
            expected = generator.last_braking_step(truth, brakers, 6.0)
            assert last_moment == pytest.approx(expected, abs=0.04, nan_ok=True)
