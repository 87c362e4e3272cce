"""30 synthetic accidents: what safety says from the labels alone, against what the generator knows.

21 are of all designs, three in ten of them unplanned (with pedestrians or a third vehicle); a house
hides the colliders of 9 from each other. They show the last 3 s. The generator's side is in
tests/generator_truth.py.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import generator_truth as generator
import numpy as np
import pytest
from generator_truth import STEPS_A_FRAME, Truth

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
LAG = HARDEST_BRAKING * FRAME_PERIOD / 2
"""m/s: by how much a mean over the last tenth of a second may differ from the speed at its end."""
LEANING = 0.01
"""Metres by which boxes that lean on a slope are nearer or farther than those seen from straight
above.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """The release, what safety has of its accidents, and what the generator knows of these."""

    da: DeepAccident
    accidents: Sequence[Accident]
    truths: Sequence[Truth]

    def __iter__(self) -> Iterator[tuple[Accident, Truth]]:
        return zip(self.accidents, self.truths, strict=True)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    root = tmp_path_factory.mktemp("accidents") / "release"
    truths = list(in_order(run_unordered(generator.recorded, jobs(root), workers=2)))
    da = DeepAccident("v1", root, verbose=False)
    accidents, _ = accidents_of(da)
    found = {each.scenario: each for each in accidents}
    return Made(da=da, accidents=[found[truth.scenario] for truth in truths], truths=truths)


def jobs(root: Path) -> list[RecordingJob]:
    """The accidents."""
    short = SynthConfig(
        scenarios=2 * PAIRS,
        frames=30,
        sensors=False,
        seed=26,
        unplanned=0.3,
        exact=True,
        designed=True,
    )
    hidden = replace(short, view="hidden")
    plans = [(short, plan) for plan in plan_scenarios(short)[: 2 * OPEN_PAIRS]]
    plans += [(hidden, plan) for plan in plan_scenarios(hidden)[2 * OPEN_PAIRS :]]
    return [RecordingJob(root, config, plan) for config, plan in plans if plan.accident]


def test_they_are_of_many_kinds(made: Made) -> None:
    assert len({truth.design for truth in made.truths}) == 12
    assert any("pedestrian" in accident.categories for accident in made.accidents)
    assert sum(None in accident.agents for accident in made.accidents) >= 3


def test_the_pair_its_motion_and_its_contact(made: Made) -> None:
    for accident, truth in made:
        told, contact = truth.meta.collision, made.da.collision(truth.scenario)
        assert (accident.actor_ids, accident.agents, accident.categories) == (
            told.ids,
            told.agents,
            told.classes,
        )
        np.testing.assert_allclose(accident.paths[..., :2], truth.world_paths[..., :2], atol=1e-4)
        assert np.abs(np.sin(accident.paths[..., 2] - truth.world_paths[..., 2])).max() < 1e-4
        np.testing.assert_allclose(accident.sizes, truth.sizes, atol=1e-6)
        check = undisturbed(accident)
        poses, sizes = truth.fine[:, -1], truth.sizes[:, :2]
        last = gap(poses[0], sizes[0], poses[1], sizes[1])
        assert (check.usable, contact.disagreements) == (True, ())
        assert [check.margin, contact.gap] == pytest.approx([float(last)] * 2, abs=LEANING)
        assert accident.duration == pytest.approx((truth.frames - 1) / 10)
        assert accident.duration - 0.01 <= check.time <= accident.duration
        across = np.subtract(*poses[:, 2])
        turn = np.abs(np.arctan2(np.sin(across), np.cos(across)))
        assert contact.impact_angle == pytest.approx(turn, abs=0.01)
        flank = told.contact_side.endswith("_side")
        assert contact.sides[0] in (("left", "right") if flank else (told.contact_side,))


def test_speeds_and_severity(made: Made) -> None:
    for accident, truth in made:
        check, contact = undisturbed(accident), made.da.collision(truth.scenario)
        exact, lately = truth.velocities[:, -1], truth.velocities[:, -STEPS_A_FRAME - 1 :]
        mean = (lately[:, 1:] + lately[:, :-1]).mean(axis=1) / 2
        masses = masses_of(
            [CATEGORIES.index(name) for name in truth.meta.collision.classes], truth.sizes
        )
        for velocities, tolerance in ((mean, 0.02), (exact, LAG + 0.02)):
            speeds, relative = np.hypot(*velocities.T), np.hypot(*(velocities[0] - velocities[1]))
            np.testing.assert_allclose([check.speeds, contact.speeds], [speeds] * 2, atol=tolerance)
            np.testing.assert_allclose(
                check.delta_v, relative * masses[::-1] / masses.sum(), atol=2 * tolerance
            )
            closing = (velocities[0] - velocities[1]) @ generator.facing(truth)
            assert contact.closing_speed == pytest.approx(closing, abs=2 * tolerance)


def test_the_time_to_collision_of_the_last_second(made: Made) -> None:
    for accident, truth in made:
        table = made.da.interactions(truth.scenario)
        rows = table.of_pair(*accident.actor_ids)
        rows = rows[(table.frame[rows] > truth.frames - 10) & (table.ttc[rows] < 3)]
        at = (table.frame[rows] - 1) * STEPS_A_FRAME
        expected = [generator.time_to_contact(truth, step) for step in at.tolist()]
        np.testing.assert_allclose(table.ttc[rows], expected, atol=0.005)
        pair = table.pairs.position(*accident.actor_ids)
        assert table.pairs.min_ttc[pair] == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("kind", ["points", "released"])
def test_who_was_hidden_and_how_long(made: Made, kind: str) -> None:
    leads = []
    for accident, truth in made:
        observed = observed_by_rays(accident, truth, kind)
        rule, expected = (
            ObservationRule(kind=kind),
            [lead(observed, members) for members in COALITIONS],
        )
        agents, seen = observed_actors(made.da, truth.scenario, accident.actor_ids, rule)
        assert agents == AGENTS
        np.testing.assert_array_equal(seen, observed)
        np.testing.assert_allclose(
            lead_times(made.da, truth.scenario, rule).leads, expected, atol=1e-9
        )
        leads.append(expected)
    alone, together = np.array(leads)[:, 0], np.array(leads)[:, -1]
    assert (alone[OPEN_PAIRS:] < 1.5).all()
    assert (together[OPEN_PAIRS:] > 2.8).all()


def observed_by_rays(accident: Accident, truth: Truth, kind: str) -> np.ndarray:
    """(5, 2, F) whether each agent observes each collider, by what its rays and cameras meet."""
    sights = truth.sights
    observed = np.zeros(sights.points.shape, dtype=bool)
    for agent, which in product(range(len(AGENTS)), (0, 1)):
        points, camera = sights.points[agent, which], sights.pixels[agent, which] > 0
        pole, small = (
            AGENTS[agent] == "infrastructure",
            accident.categories[which] not in ("car", "van", "truck"),
        )
        enough_near, enough_far = (1 if pole else 2 if small else 5), (1 if small else 2)
        near = sights.distance[agent, which] < (15 if pole else 10)
        released = np.where(near, camera | (points >= enough_near), camera & (points >= enough_far))
        seen = points >= 5 if kind == "points" else released
        observed[agent, which] = (seen & (sights.tracked[agent, which] > 0)) | (
            accident.agents[which] == AGENTS[agent]
        )
    return observed


def lead(observed: np.ndarray, members: Sequence[str]) -> float:
    """Seconds before the last frame at which the members, together, first observe both."""
    both = observed[[AGENTS.index(name) for name in members]].any(axis=0).all(axis=0)
    return (len(both) - 1 - int(np.argmax(both))) / 10 if both.any() else 0.0


def test_the_last_moment_to_brake_in_the_exact_motion(made: Made) -> None:
    """Labels of 10 Hz move it by 0.04 s at most. Exact motions are tried every 0.02 s, those of
    labels every 0.01 s.
    """
    for accident, truth in made:
        pair = pair_of(accident.paths, accident.sizes)
        for brakers in MASKS:
            found = last_moments(pair, brakers, [6.0]).time[0]
            expected = generator.last_moment(truth, brakers, 6.0)
            assert found == pytest.approx(expected, abs=0.04, nan_ok=True)
