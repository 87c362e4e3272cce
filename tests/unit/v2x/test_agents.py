"""Configurations of cooperating agents, and which of them see an accident."""

import itertools
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release import META_TEXT, SCENARIO_TOKEN, SCENARIO_TYPE

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, GeometryError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation.runs.setups import (
    EvaluationSetup,
    SampleSelection,
    default_selection,
)
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.mcap import McapConfig
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines import Baseline
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.testing import SmallRelease
from deepaccident_devkit.v2x import (
    AGENT_CONFIGS,
    AGENT_SETS,
    AgentConfig,
    accident_visibility,
    accident_visible,
    accident_visible_mask,
    cooperating_agents,
    hidden_collider,
    pair_in_view,
)
from deepaccident_devkit.v2x.agents import SHEER_CURTAINS

EGO, EGO_BEHIND, OTHER, OTHER_BEHIND, POLE = AGENTS


def test_the_papers_seven_as_seen_from_the_ego_vehicle() -> None:
    agents_by_config = {name: config.agents_for(EGO) for name, config in AGENT_CONFIGS.items()}
    assert agents_by_config == {
        "single": (EGO,),
        "+behind": (EGO, EGO_BEHIND),
        "+other": (EGO, OTHER),
        "+infrastructure": (EGO, POLE),
        "+behind+other": (EGO, EGO_BEHIND, OTHER),
        "vehicles": (EGO, EGO_BEHIND, OTHER, OTHER_BEHIND),
        "all": AGENTS,
    }
    assert (*AGENT_CONFIGS, "available") == AGENT_SETS
    assert AgentConfig("alone").agents_for(POLE) == (POLE,)


@pytest.mark.parametrize(
    ("ego", "side", "expected"),
    [
        (EGO, EGO, (EGO_BEHIND, OTHER, OTHER_BEHIND, POLE)),
        (EGO_BEHIND, EGO, (EGO, OTHER, OTHER_BEHIND, POLE)),
        (OTHER, EGO, (OTHER_BEHIND, EGO, EGO_BEHIND, POLE)),
        (OTHER_BEHIND, EGO, (OTHER, EGO, EGO_BEHIND, POLE)),
        (POLE, EGO, (EGO_BEHIND, OTHER, OTHER_BEHIND, EGO)),
        (POLE, OTHER, (OTHER_BEHIND, EGO, EGO_BEHIND, OTHER)),
    ],
)
def test_partners_are_renamed_as_in_the_released_code(
    ego: str, side: str, expected: tuple[str, ...]
) -> None:
    """The released V2X dataset's name_mapping, written out (docs/released_code.md, Poses)."""
    agents = AGENT_CONFIGS["all"].agents_for(ego, side=side)
    assert agents == (ego, *expected)
    assert set(agents) == set(AGENTS)


def test_agents_are_given_by_a_configuration_or_names(da_b: DeepAccident) -> None:
    sample = f"{da_b.scenario[0]['token']}/{OTHER}/002"
    assert cooperating_agents(da_b, sample) == (OTHER, EGO, EGO_BEHIND, OTHER_BEHIND, POLE)
    assert cooperating_agents(da_b, da_b.get("sample", sample), "+behind") == (OTHER, OTHER_BEHIND)
    assert cooperating_agents(da_b, sample, AGENT_CONFIGS["+other"]) == (OTHER, EGO)
    assert cooperating_agents(da_b, sample, [POLE, OTHER, POLE]) == (OTHER, POLE)
    assert cooperating_agents(da_b, sample, [POLE]) == (POLE,)
    assert cooperating_agents(da_b, sample, "Available") == cooperating_agents(da_b, sample, None)
    assert_raises(
        (
            lambda: cooperating_agents(da_b, sample, "bus"),
            ChoiceError,
            "one of single, .*infrastructure, found 'bus'",
        ),
        (
            lambda: cooperating_agents(da_b, sample, []),
            ChoiceError,
            "expected some of ego_vehicle, .*found none",
        ),
        (lambda: cooperating_agents(da_b, sample + "9"), TokenError, "table 'sample' has no token"),
    )


@pytest.mark.parametrize(
    ("make_config", "names", "name"),
    [
        (lambda names: AgentConfig("mine", names), ("behind",), "Behind"),
        (lambda names: MotionLabelConfig(agents=names), [POLE], POLE),
        (lambda names: ImageConfig(cameras=names), ("Camera_Front",), "camera_front"),
        (lambda names: McapConfig(channels=names), ["lidar01"], "LIDAR01"),
        (lambda names: OpenCood(classes=names), ("van",), "van"),
        (lambda names: OpenCood(agents=names), (EGO,), EGO),
        (lambda names: SampleSelection(split="val", agents=names), (POLE,), POLE),
        (
            lambda names: default_selection(EvaluationSetup(task="accident"), "val", agents=names),
            (POLE,),
            POLE,
        ),
        (lambda names: SmallRelease(splits=names), ["val"], "val"),
        (lambda names: Baseline(agents=names).meta(), [POLE], "Infrastructure"),
    ],
)
def test_a_single_name_is_a_list_of_one(
    make_config: Callable[[Any], object], names: object, name: str
) -> None:
    assert make_config(name) == make_config(names)


def test_an_agent_that_was_not_downloaded_is_named(tmp_path: Path) -> None:
    tiny_release.write_tiny_release(tmp_path, agents=(EGO, POLE))
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    sample = f"{SCENARIO_TOKEN}/{EGO}/001"
    calls = (
        da.cooperative_boxes,
        da.visible_instances,
        da.aggregate_point_cloud,
        da.message_sizes,
    )
    message = r"other_vehicle is not in .* which has ego_vehicle, infrastructure"
    advice = (
        "; unpack its archive",
        "name agents that the release has",
        "agents='available' (--agents available)",
    )

    assert cooperating_agents(da, sample) == (EGO, POLE)
    assert_raises(
        *[(partial(call, sample, agents="+other"), NotAvailableError, message) for call in calls],
    )
    assert len(da.cooperative_boxes(sample)) > 0
    assert_raises((lambda: cooperating_agents(da, sample, "all"), NotAvailableError, advice))

    assert cooperating_agents(da, sample, "available") == (EGO, POLE)
    available_boxes = da.cooperative_boxes(sample, agents="available")
    assert len(available_boxes) == len(da.cooperative_boxes(sample))
    assert MotionLabelConfig(agents="available").digest == MotionLabelConfig().digest


def test_agents_partners_sides_and_views_that_do_not_exist(da_b: DeepAccident) -> None:
    sample = da_b.sample[0]
    everyone = AGENT_CONFIGS["all"]
    names = np.array(["infrastructure", "ego_vehicle"])

    assert cooperating_agents(da_b, sample, names) == ("ego_vehicle", "infrastructure")
    assert AgentConfig("mine", ["behind"]) == AgentConfig("mine", ("behind",))
    assert_raises(
        (
            lambda: AgentConfig("mine", ("front",)),
            ChoiceError,
            ("partners: expected one of behind", "'front'"),
        ),
        (
            lambda: everyone.agents_for("bus"),
            ChoiceError,
            ("agent: expected one of ego_vehicle", "'bus'"),
        ),
        (
            lambda: everyone.agents_for(POLE, side="left"),
            ChoiceError,
            ("side: expected one of ego_vehicle, other_vehicle", "'left'"),
        ),
        *[
            (
                partial(da_b.cooperative_boxes, sample, agents=agents),
                ChoiceError,
                ("agents: expected some of ego_vehicle",),
            )
            for agents in (3, 2.5, object())
        ],
        *[
            (
                partial(cooperating_agents, da_b, sample, agents),
                ChoiceError,
                ("agents: expected one of ego_vehicle",),
            )
            for agents in ([None], [3], [np.zeros(2)])
        ],
        *[
            (
                partial(AgentConfig, "mine", partners),
                ChoiceError,
                ("partners: expected some of behind",),
            )
            for partners in (3, None)
        ],
        *[
            (partial(accident_visible_mask, in_view), GeometryError, ("in_view: expected",))
            for in_view in ([True], np.zeros((3, 2)), True, "abc", None)
        ],
    )


IN_VIEW = np.array(list(itertools.product([False, True], repeat=3)))
ACCIDENT_VISIBLE = [False, True, False, True, False, True, True, True]


def test_unseen_is_not_in_view_now_and_at_one_moment_before() -> None:
    assert_array_equal(accident_visible_mask(IN_VIEW), ACCIDENT_VISIBLE)
    two_rows = np.reshape(ACCIDENT_VISIBLE, (2, 4))
    assert_array_equal(accident_visible_mask(IN_VIEW.reshape(2, 4, 3)), two_rows)
    assert accident_visible_mask([1, 0, 0]) == np.array(False)
    assert accident_visible_mask(np.zeros((0, 3))).shape == (0,)


def test_without_a_collision_and_behind_sheer_curtains_all_is_seen() -> None:
    first_is_exempt = [True] + [False] * 7
    visible = accident_visible_mask(IN_VIEW, exempt=first_is_exempt)
    assert accident_visible_mask(IN_VIEW, collision=False).all()
    assert accident_visible_mask(IN_VIEW, exempt=True).all()
    assert_array_equal(visible, [True, *ACCIDENT_VISIBLE[1:]])


def test_a_pair_is_in_view_if_all_but_the_agent_itself_are() -> None:
    ids = [5, 6, -1, -100, 5]
    mask = [True, False, True, True, True]

    assert pair_in_view(mask, ids, (5, 7), own_id=7)
    assert not pair_in_view(mask, ids, (5, 7))
    assert not pair_in_view(mask, ids, (5, 6), own_id=7)
    assert not pair_in_view(mask, ids, (-1, -1), own_id=7)
    assert pair_in_view(mask, ids, np.array([5, 7]), own_id=7)


UNJUDGED_RELEASES = {
    "silent": {"meta": None},
    "unlabelled": {"labelled": False},
    "nameless": {"meta": META_TEXT.replace(" agents id: 1223 1236 1212 1237\n", "")},
}
"""Options of releases that lack what a judgement needs: meta, labels or the agents' ids."""


def make_watched_release(
    root: Path,
    visible_frames: Collection[int],
    frames: int = 21,
    agent: str = "ego_vehicle",
    **release,
) -> DeepAccident:
    """Write a release of one agent, which sees 1212 at some frames, and 1223 (the ego) always."""

    def make_lines(_: str, frame: int) -> list[str]:
        visible = frame in visible_frames
        return [
            "0 0",
            f"car 20.0 0.0 0.0 4.0 2.0 1.5 0 0 0 1212 {9 * visible} {visible}",
            "car 9.0 5.0 0.0 4.0 2.0 1.5 0 0 0 1223 9 True",
        ]

    tiny_release.write_tiny_release(
        root, frames=frames, agents=(agent,), lines_of=make_lines, **release
    )
    return DeepAccident(dataroot=root, verbose=False, workers=1)


@pytest.mark.parametrize(
    ("frames", "visible_frames", "expected"),
    [
        (21, range(1, 22), "visible"),
        (21, {1, 6, 11, 16}, "visible"),
        (21, {21}, "invisible"),
        (21, {2, 3, 4, 5, 7, 8, 9, 10, 12, 17}, "invisible"),
        (21, {16}, "partial"),
        (21, {1}, "partial"),
        (10, {5}, "visible"),
        (10, {10}, "invisible"),
        (5, {5}, None),
    ],
)
def test_an_accident_is_seen_at_the_four_moments_or_at_some(
    tmp_path: Path, frames: int, visible_frames: Collection[int], expected: str | None
) -> None:
    da = make_watched_release(tmp_path, visible_frames, frames)
    assert accident_visibility(da, SCENARIO_TOKEN) == expected
    for frame in range(1, frames + 1):
        moments = (frame, frame - 5, frame - 10)
        unseen_moments = sum(moment not in visible_frames for moment in moments)
        expected_visible = frame in visible_frames or unseen_moments < 2
        sample = f"{SCENARIO_TOKEN}/ego_vehicle/{frame:03d}"
        assert accident_visible(da, sample) == expected_visible, frame


@pytest.mark.parametrize(
    ("frames", "visible_frames", "expected"),
    [
        (30, (), True),
        (30, {*range(1, 10), *range(21, 31)}, True),  # 2.1 s before the last frame, and 0.9 s
        (30, {10}, False),
        (30, {20}, False),
        (30, {15}, False),
        (12, {3}, True),
        (12, {1}, False),
        (10, (), None),
    ],
)
def test_a_collider_is_hidden_if_ego_sees_it_at_no_frame_from_2_to_1_s_before_the_last(
    tmp_path: Path, frames: int, visible_frames: Collection[int], expected: bool | None
) -> None:
    da = make_watched_release(tmp_path, visible_frames, frames)
    assert hidden_collider(da, SCENARIO_TOKEN) is expected


def test_whether_a_collider_is_hidden_may_be_unknown(tmp_path: Path, da: DeepAccident) -> None:
    scenario = SCENARIO_TOKEN
    releases = {**UNJUDGED_RELEASES, "pole": {"agent": "infrastructure"}}
    for name, release in releases.items():
        da_unknown = make_watched_release(tmp_path / name, (), **release)
        assert hidden_collider(da_unknown, scenario) is None, name

    # the labels show one of the pair; the other is a bystander
    bystander = META_TEXT.replace("id: 1223 1236", "id: 1300 1236")
    da_one_seen = make_watched_release(tmp_path / "one", (), meta=bystander)
    assert hidden_collider(da_one_seen, scenario)

    without_collision = next(scenario for scenario in da.scenario if scenario["collision"] is None)
    assert hidden_collider(da, without_collision) is None

    [curtain, *_] = SHEER_CURTAINS
    da_curtained = make_watched_release(tmp_path / "curtain", (), name=curtain)
    assert hidden_collider(da_curtained, f"{SCENARIO_TYPE}/{curtain}") is False


def test_accidents_without_facts_are_unknown_and_sheer_curtains_hide_nothing(
    tmp_path: Path, da: DeepAccident
) -> None:
    scenario = SCENARIO_TOKEN
    for name, release in UNJUDGED_RELEASES.items():
        da_unknown = make_watched_release(tmp_path / name, (), 6, **release)
        assert accident_visible(da_unknown, f"{scenario}/ego_vehicle/006") is None, name
        assert accident_visibility(da_unknown, scenario) is None, name

    da_pole = make_watched_release(tmp_path / "pole", {6}, 6, "infrastructure")
    assert accident_visibility(da_pole, scenario) is None
    assert accident_visible(da_pole, f"{scenario}/infrastructure/005") is False
    assert accident_visible(da_pole, f"{scenario}/infrastructure/006") is True

    for number, name in enumerate(SHEER_CURTAINS):
        da_curtained = make_watched_release(tmp_path / f"{number}", (), 6, name=name)
        assert accident_visibility(da_curtained, f"{SCENARIO_TYPE}/{name}") == "visible"

    calm_scenario = next(scenario for scenario in da.scenario if scenario["collision"] is None)
    assert accident_visibility(da, calm_scenario) is None
    assert accident_visible(da, f"{calm_scenario['token']}/infrastructure/001") is True
