"""Whose sight counts: configurations of agents, and who of them sees an accident."""

import itertools
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
from numpy.testing import assert_array_equal
from refusals import assert_refused

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
    assert {name: config.agents_for(EGO) for name, config in AGENT_CONFIGS.items()} == {
        "single": (EGO,),
        "+behind": (EGO, EGO_BEHIND),
        "+other": (EGO, OTHER),
        "+infrastructure": (EGO, POLE),
        "+behind+other": (EGO, EGO_BEHIND, OTHER),
        "vehicles": (EGO, EGO_BEHIND, OTHER, OTHER_BEHIND),
        "all": AGENTS,
    }
    assert ((*AGENT_CONFIGS, "available"), AgentConfig("alone").agents_for(POLE)) == (
        AGENT_SETS,
        (POLE,),
    )


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
    everyone = AGENT_CONFIGS["all"].agents_for(ego, side=side)
    assert (everyone, set(everyone)) == ((ego, *expected), set(AGENTS))


def test_what_an_agents_argument_means(da_b: DeepAccident) -> None:
    sample = f"{da_b.scenario[0]['token']}/{OTHER}/002"
    assert cooperating_agents(da_b, sample) == (OTHER, EGO, EGO_BEHIND, OTHER_BEHIND, POLE)
    assert cooperating_agents(da_b, da_b.get("sample", sample), "+behind") == (OTHER, OTHER_BEHIND)
    assert cooperating_agents(da_b, sample, AGENT_CONFIGS["+other"]) == (OTHER, EGO)
    assert cooperating_agents(da_b, sample, [POLE, OTHER, POLE]) == (OTHER, POLE)
    assert cooperating_agents(da_b, sample, [POLE]) == (POLE,)
    assert cooperating_agents(da_b, sample, "Available") == cooperating_agents(da_b, sample, None)
    assert_refused(
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
    ("make", "several", "single"),
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
    make: Callable[[Any], object], several: object, single: str
) -> None:
    assert make(single) == make(several)


def test_an_agent_that_was_not_downloaded_is_named(tmp_path: Path) -> None:
    da = DeepAccident(dataroot=tiny.write_tiny_release(tmp_path, agents=(EGO, POLE)), verbose=False)
    sample = f"{tiny.TOKEN}/{EGO}/001"
    assert cooperating_agents(da, sample) == (EGO, POLE)
    assert_refused(
        *[
            (
                partial(call, sample, agents="+other"),
                NotAvailableError,
                r"other_vehicle is not in .* which has ego_vehicle, infrastructure",
            )
            for call in (
                da.cooperative_boxes,
                da.visible_instances,
                da.aggregate_point_cloud,
                da.message_sizes,
            )
        ],
    )
    assert len(da.cooperative_boxes(sample)) > 0
    assert_refused(
        (
            lambda: cooperating_agents(da, sample, "all"),
            NotAvailableError,
            (
                "; unpack its archive",
                "name the agents that are there",
                "agents='available' (--agents available)",
            ),
        ),
    )
    assert cooperating_agents(da, sample, "available") == (EGO, POLE)
    assert len(da.cooperative_boxes(sample, agents="available")) == len(
        da.cooperative_boxes(sample)
    )
    assert MotionLabelConfig(agents="available").digest == MotionLabelConfig().digest


def test_names_roles_sides_and_views_that_are_none(da_b: DeepAccident) -> None:
    sample, everyone, agents = (
        da_b.sample[0],
        AGENT_CONFIGS["all"],
        np.array(["infrastructure", "ego_vehicle"]),
    )
    assert cooperating_agents(da_b, sample, agents) == ("ego_vehicle", "infrastructure")
    assert AgentConfig("mine", ["behind"]) == AgentConfig("mine", ("behind",))
    assert_refused(
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
                partial(da_b.cooperative_boxes, sample, agents=wrong),
                ChoiceError,
                ("agents: expected some of ego_vehicle",),
            )
            for wrong in (3, 2.5, object())
        ],
        *[
            (
                partial(cooperating_agents, da_b, sample, wrong),
                ChoiceError,
                ("agents: expected one of ego_vehicle",),
            )
            for wrong in ([None], [3], [np.zeros(2)])
        ],
        *[
            (
                partial(AgentConfig, "mine", wrong),
                ChoiceError,
                ("partners: expected some of behind",),
            )
            for wrong in (3, None)
        ],
        *[
            (partial(accident_visible_mask, views), GeometryError, ("in_view: expected",))
            for views in ([True], np.zeros((3, 2)), True, "abc", None)
        ],
    )


VIEWS = np.array(list(itertools.product([False, True], repeat=3)))
SEEN = [False, True, False, True, False, True, True, True]


def test_unseen_is_not_in_view_now_and_at_one_moment_before() -> None:
    assert_array_equal(accident_visible_mask(VIEWS), SEEN)
    assert_array_equal(accident_visible_mask(VIEWS.reshape(2, 4, 3)), np.reshape(SEEN, (2, 4)))
    assert (accident_visible_mask([1, 0, 0]), accident_visible_mask(np.zeros((0, 3))).shape) == (
        np.array(False),
        (0,),
    )


def test_without_a_collision_and_behind_sheer_curtains_all_is_seen() -> None:
    assert accident_visible_mask(VIEWS, collision=False).all()
    assert accident_visible_mask(VIEWS, exempt=True).all()
    assert_array_equal(accident_visible_mask(VIEWS, exempt=[True] + [False] * 7), [True, *SEEN[1:]])


def test_a_pair_is_in_view_if_all_but_the_agent_itself_are() -> None:
    ids, mask = [5, 6, -1, -100, 5], [True, False, True, True, True]
    assert pair_in_view(mask, ids, (5, 7), own_id=7)
    assert not pair_in_view(mask, ids, (5, 7))
    assert not pair_in_view(mask, ids, (5, 6), own_id=7)
    assert not pair_in_view(mask, ids, (-1, -1), own_id=7)
    assert pair_in_view(mask, ids, np.array([5, 7]), own_id=7)


def watched(
    root: Path, seen: Collection[int], frames: int = 21, agent: str = "ego_vehicle", **release
) -> DeepAccident:
    """One agent alone, which sees 1212 at the frames `seen`, and 1223 (the ego) always."""

    def lines(_: str, frame: int) -> list[str]:
        there = frame in seen
        return [
            "0 0",
            f"car 20.0 0.0 0.0 4.0 2.0 1.5 0 0 0 1212 {9 * there} {there}",
            "car 9.0 5.0 0.0 4.0 2.0 1.5 0 0 0 1223 9 True",
        ]

    tiny.write_tiny_release(root, frames=frames, agents=(agent,), lines_of=lines, **release)
    return DeepAccident(dataroot=root, verbose=False, workers=1)


@pytest.mark.parametrize(
    ("frames", "seen", "expected"),
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
    tmp_path: Path, frames: int, seen: Collection[int], expected: str | None
) -> None:
    da = watched(tmp_path, seen, frames)
    assert accident_visibility(da, tiny.TOKEN) == expected
    for index in range(1, frames + 1):
        now, missed = (
            index in seen,
            sum(moment not in seen for moment in (index, index - 5, index - 10)),
        )
        assert accident_visible(da, f"{tiny.TOKEN}/ego_vehicle/{index:03d}") == (
            now or missed < 2
        ), index


@pytest.mark.parametrize(
    ("frames", "seen", "expected"),
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
    tmp_path: Path, frames: int, seen: Collection[int], expected: bool | None
) -> None:
    assert hidden_collider(watched(tmp_path, seen, frames), tiny.TOKEN) is expected


def test_whether_a_collider_is_hidden_may_be_unknown(tmp_path: Path, da: DeepAccident) -> None:
    for place, release in (
        ("silent", {"meta": None}),
        ("unlabelled", {"labelled": False}),
        ("nameless", {"meta": tiny.META.replace(" agents id: 1223 1236 1212 1237\n", "")}),
        ("pole", {"agent": "infrastructure"}),
    ):
        assert hidden_collider(watched(tmp_path / place, (), **release), tiny.TOKEN) is None, place
    bystander = tiny.META.replace("id: 1223 1236", "id: 1300 1236")
    assert hidden_collider(
        watched(tmp_path / "one", (), meta=bystander), tiny.TOKEN
    )  # of two, one is seen
    assert (
        hidden_collider(
            da, next(scenario for scenario in da.scenario if scenario["collision"] is None)
        )
        is None
    )
    [curtain, *_] = SHEER_CURTAINS
    assert (
        hidden_collider(watched(tmp_path / "curtain", (), name=curtain), f"{tiny.TYPE}/{curtain}")
        is False
    )


def test_what_cannot_be_judged_and_what_always_counts_as_seen(
    tmp_path: Path, da: DeepAccident
) -> None:
    for place, told, release in (
        ("silent", None, {"meta": None}),
        ("unlabelled", None, {"labelled": False}),
        ("nameless", None, {"meta": tiny.META.replace(" agents id: 1223 1236 1212 1237\n", "")}),
    ):
        other = watched(tmp_path / place, (), 6, **release)
        assert accident_visible(other, f"{tiny.TOKEN}/ego_vehicle/006") is told, place
        assert accident_visibility(other, tiny.TOKEN) is told, place
    pole = watched(tmp_path / "pole", {6}, 6, "infrastructure")
    assert accident_visibility(pole, tiny.TOKEN) is None
    assert [
        accident_visible(pole, f"{tiny.TOKEN}/infrastructure/{frame:03d}") for frame in (5, 6)
    ] == [False, True]
    for number, name in enumerate(SHEER_CURTAINS):
        assert (
            accident_visibility(
                watched(tmp_path / f"{number}", (), 6, name=name), f"{tiny.TYPE}/{name}"
            )
            == "visible"
        )
    [calm] = [scenario for scenario in da.scenario if scenario["collision"] is None][:1]
    assert (
        accident_visibility(da, calm),
        accident_visible(da, f"{calm['token']}/infrastructure/001"),
    ) == (None, True)
