from dataclasses import replace

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS
from deepaccident_devkit.plugins.synth.traffic.simulate import separation
from deepaccident_devkit.tables.build import accident_type
from deepaccident_devkit.taxonomy import VEHICLE_AGENTS

pytestmark = pytest.mark.slow

CONFIG = SynthConfig(scenarios=24, frames=None, seed=2, unplanned=0.0, designed=True)


@pytest.fixture(scope="module")
def built():
    """All accidents of a round of the designs, and some twins."""
    plans = plan_scenarios(CONFIG)
    return [build_scenario(CONFIG, plan) for plan in plans if plan.accident or plan.pair < 3]


def measure_gaps(scenario, ids, times):
    """Measure the separation of two actors at times, metres."""
    first, second = (scenario.actors.row_of(actor) for actor in ids)
    actors = scenario.actors.all
    sizes = scenario.actors.size[:, :2]
    return separation(
        actors[first].motion.poses(times),
        sizes[first],
        actors[second].motion.poses(times),
        sizes[second],
    )


def test_the_meta_file_reveals_the_design(built):
    accidents = [scenario for scenario in built if scenario.plan.accident]
    types = [
        accident_type(scenario.meta, signalized=scenario.plan.traits.subtype == 1)
        for scenario in accidents
    ]

    assert sorted(types) == list(DESIGN_NUMBERS)
    assert types == [scenario.plan.design for scenario in accidents]


def test_designed_accidents_equal_the_ones_of_older_releases(built):
    """Whoever cites numbers of a designed release finds the same scenes again."""
    metas = [scenario.meta for scenario in built if scenario.plan.accident][:4]
    assert [(meta.recorded_frames, meta.agent_ids[0], meta.collision.impact) for meta in metas] == [
        (55, 1308, pytest.approx(9318.248, abs=0.01)),
        (70, 1155, pytest.approx(9226.524, abs=0.01)),
        (83, 1629, pytest.approx(3705.879, abs=0.01)),
        (66, 1501, pytest.approx(2925.796, abs=0.01)),
    ]


def test_the_last_frame_is_the_impact(built):
    for scenario in built:
        if scenario.plan.accident:
            end = (scenario.frames - 1) / 10
            times = [*np.arange(0, end - 0.01, 0.02), end]
            gaps = measure_gaps(scenario, scenario.meta.collision.ids, times)
            assert -0.3 < gaps[-1] <= 1e-9
            assert (gaps[:-1] > 0).all()


def test_recordings_are_of_natural_length(built):
    frames = [scenario.frames for scenario in built]
    assert 40 <= min(frames) <= max(frames) <= 100
    assert len({*frames}) > 5
    assert [scenario.meta.simulated_frames - 10 for scenario in built] == frames


def test_ids_are_unique_and_of_their_kind(built):
    for scenario in built:
        actors = scenario.actors
        ids = actors.actor_id
        assert len(set(ids.tolist())) == len(set(actors.object_id.tolist())) == len(ids)
        assert list(scenario.agents) == list(VEHICLE_AGENTS)

        speeds = np.hypot(*actors.at(1.0).velocities.T)
        np.testing.assert_array_equal(speeds[ids >= 20000], 0)
        assert ids[ids < 20000].max() < 3000


@pytest.mark.parametrize("frames", [1, 4, 60, 130])
def test_the_requested_number_of_frames_is_recorded(frames):
    config = replace(CONFIG, scenarios=2, frames=frames)

    for plan in plan_scenarios(config):
        scenario = build_scenario(config, plan)
        starts = [actor.motion.start for actor in scenario.actors.all if not actor.parked]
        assert scenario.frames == frames
        assert min(starts) <= 0.0


def test_unplanned_accidents_are_with_someone_who_records_nothing():
    config = replace(CONFIG, scenarios=8, unplanned=1.0)

    for plan in plan_scenarios(config)[::2]:
        meta = build_scenario(config, plan).meta
        assert accident_type(meta, signalized=plan.traits.subtype == 1) is None
        assert None in meta.collision.agents
        assert not {*meta.collision.ids} <= {*meta.agent_ids}


LATE_MEETING = """\
name: late
road: {signalized: false}
actors:
  - {role: ego, from: west, max_speed: 9}
  - {role: other, from: south, max_speed: 9}
meet: {actors: [ego, other], offset: 3}
background: {vehicles: 0, two_wheelers: 0, parked: 0, walking: 0, crossing: 0}
"""


@pytest.fixture
def build_own(tmp_path):
    """A function that builds the first scenario of a scenario file's text, or its twin."""

    def build(text, *, twin=False):
        path = tmp_path / "own.yaml"
        path.write_text(text, encoding="utf-8")
        config = SynthConfig(scenarios=2, spec=path, frames=None)
        return build_scenario(config, plan_scenarios(config)[int(twin)])

    return build


def test_a_scenario_in_which_nobody_meets_is_given_up(build_own, monkeypatch):
    """The message names the line, how near the two came, and what to change."""
    monkeypatch.setattr("deepaccident_devkit.plugins.synth.scenario.MAX_DRAWS", 2)
    pedestrian = "  - {role: pedestrian, from: north}\nmeet: {actors: [ego, pedestrian]"
    with_pedestrian = LATE_MEETING.replace("meet: {actors: [ego, other]", pedestrian)
    pattern = (
        r"own.yaml:6: meet: the two did not collide in 2 draws; the least "
        r"distance was 1\d\.\d m; choose"
    )
    assert_raises(
        (lambda: build_own(LATE_MEETING), ConfigError, pattern),
        (
            lambda: build_own(with_pedestrian),
            ConfigError,
            ("own.yaml:7: meet: ", "their paths do not cross, ", "change"),
        ),
    )


def test_a_twin_that_cannot_be_made_is_named_by_its_file(build_own, monkeypatch):
    monkeypatch.setattr("deepaccident_devkit.plugins.synth.scenario.perform_twin", lambda *_: None)
    without_meeting, _, _ = LATE_MEETING.partition("meet:")
    on_time = LATE_MEETING.replace("offset: 3", "offset: 0")
    message = "own.yaml:3: actors: the road users collide"
    assert_raises(
        (
            lambda: build_own(without_meeting),
            ConfigError,
            (f"{message} although all obey the rules",),
        ),
        (
            lambda: build_own(on_time, twin=True),
            ConfigError,
            (f"{message} in the normal twin too, even if",),
        ),
    )


def test_a_slow_cyclist_is_hit(build_own):
    """It needs more than 24 s from its usual start to the crossing, and once never arrived."""
    cyclist = "  - {role: background, category: cyclist, from: west, max_speed: 3}\n"
    text = LATE_MEETING
    for old, new in (
        ("ego, from: west", "ego, from: south, turn: right"),
        ("other, from: south", "other, from: east"),
        (
            "meet: {actors: [ego, other], offset: 3",
            f"{cyclist}meet: {{actors: [background, ego], offset: 0.5",
        ),
    ):
        text = text.replace(old, new)

    scenario = build_own(text)
    assert scenario.draws == 1
    assert scenario.meta.collision.classes == ("cyclist", "car")
