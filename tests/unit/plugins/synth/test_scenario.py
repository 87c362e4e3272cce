from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_refused

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


def gaps(scenario, first, second, times):
    """Separation of two actors, by id, at times."""
    rows = [scenario.actors.row_of(actor) for actor in (first, second)]
    poses = [scenario.actors.all[row].motion.poses(times) for row in rows]
    size = scenario.actors.size[:, :2]
    return separation(poses[0], size[rows[0]], poses[1], size[rows[1]])


def test_each_design_is_told_by_its_meta(built):
    accidents = [scenario for scenario in built if scenario.plan.accident]
    types = [
        accident_type(each.meta, signalized=each.plan.traits.subtype == 1) for each in accidents
    ]
    assert sorted(types) == list(DESIGN_NUMBERS)
    assert types == [each.plan.design for each in accidents]


def test_clean_accidents_are_those_of_older_releases(built):
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
            apart = gaps(
                scenario, *scenario.meta.collision.ids, [*np.arange(0, end - 0.01, 0.02), end]
            )
            assert -0.3 < apart[-1] <= 1e-9
            assert (apart[:-1] > 0).all()


def test_recordings_are_of_natural_length(built):
    frames = [scenario.frames for scenario in built]
    assert (min(frames) >= 40, max(frames) <= 100, len({*frames}) > 5) == (True, True, True)
    assert [scenario.meta.simulated_frames - 10 for scenario in built] == frames


def test_ids_are_unique_and_of_their_kind(built):
    for scenario in built:
        ids = scenario.actors.actor_id
        assert len(set(ids.tolist())) == len(set(scenario.actors.object_id.tolist())) == len(ids)
        assert list(scenario.agents) == list(VEHICLE_AGENTS)
        np.testing.assert_array_equal(
            np.hypot(*scenario.actors.at(1.0).velocities.T)[ids >= 20000], 0
        )
        assert ids[ids < 20000].max() < 3000


@pytest.mark.parametrize("frames", [1, 4, 60, 130])
def test_so_many_frames_are_recorded(frames):
    config = replace(CONFIG, scenarios=2, frames=frames)
    for scenario in (build_scenario(config, plan) for plan in plan_scenarios(config)):
        first = min(actor.motion.start for actor in scenario.actors.all if not actor.parked)
        assert (scenario.frames, first <= 0.0) == (frames, True)


def test_unplanned_accidents_are_with_someone_who_records_nothing():
    config = replace(CONFIG, scenarios=8, unplanned=1.0)
    for plan in plan_scenarios(config)[::2]:
        meta = build_scenario(config, plan).meta
        assert accident_type(meta, signalized=plan.traits.subtype == 1) is None
        assert (None in meta.collision.agents, {*meta.collision.ids} <= {*meta.agent_ids}) == (
            True,
            False,
        )


LATE = """\
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
    """A function: text of a scenario file → its first scenario, or the twin of it."""

    def build(text, *, twin=False):
        path = tmp_path / "own.yaml"
        path.write_text(text, encoding="utf-8")
        config = SynthConfig(scenarios=2, spec=path, frames=None)
        return build_scenario(config, plan_scenarios(config)[int(twin)])

    return build


def test_a_scenario_in_which_nobody_meets_is_given_up(build_own, monkeypatch):
    """The message names the line, says how near the two came, and what to change."""
    monkeypatch.setattr("deepaccident_devkit.plugins.synth.scenario.MAX_DRAWS", 2)
    walker = "  - {role: pedestrian, from: north}\nmeet: {actors: [ego, pedestrian]"
    crossing = LATE.replace("meet: {actors: [ego, other]", walker)
    told = (
        r"own.yaml:6: meet: the two did not collide in 2 draws; the least "
        r"distance was 1\d\.\d m; choose"
    )
    assert_refused(
        (lambda: build_own(LATE), ConfigError, told),
        (
            lambda: build_own(crossing),
            ConfigError,
            ("own.yaml:7: meet: ", "their paths do not cross, ", "change"),
        ),
    )


def test_a_twin_that_cannot_be_made_is_named_by_its_file(build_own, monkeypatch):
    monkeypatch.setattr("deepaccident_devkit.plugins.synth.scenario.perform_twin", lambda *_: None)
    told, alone, timed = (
        "own.yaml:3: actors: the road users collide",
        LATE.partition("meet:")[0],
        LATE.replace("offset: 3", "offset: 0"),
    )
    assert_refused(
        (lambda: build_own(alone), ConfigError, (f"{told} although all obey the rules",)),
        (
            lambda: build_own(timed, twin=True),
            ConfigError,
            (f"{told} in the normal twin too, even if",),
        ),
    )


def test_a_slow_cyclist_is_hit(build_own):
    """It needs more than 24 s from its usual start to the crossing, and once never came there."""
    cyclist = (
        "  - {role: background, category: cyclist, from: west, max_speed: 3}\nmeet: "
        "{actors: [background, ego]"
    )
    text = LATE.replace("ego, from: west", "ego, from: south, turn: right").replace(
        "other, from: south", "other, from: east"
    )
    scenario = build_own(
        text.replace("meet: {actors: [ego, other], offset: 3", f"{cyclist}, offset: 0.5")
    )
    assert (scenario.draws, scenario.meta.collision.classes) == (1, ("cyclist", "car"))
