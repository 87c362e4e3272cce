from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_CONFIGS, AGENT_SETS, AgentConfig, cooperating_agents

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
    assert ((*AGENT_CONFIGS, "available"), AgentConfig("alone").agents_for(POLE)) == (AGENT_SETS, (POLE,))


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
def test_partners_are_renamed_as_in_the_released_code(ego: str, side: str, expected: tuple[str, ...]) -> None:
    """The released V2X dataset's name_mapping, written out (docs/released_code.md, Poses)."""
    everyone = AGENT_CONFIGS["all"].agents_for(ego, side=side)
    assert (everyone, set(everyone)) == ((ego, *expected), set(AGENTS))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: AgentConfig("mine", ("front",)), r"partners: expected one of behind, .*found 'front'"),
        (lambda: AGENT_CONFIGS["all"].agents_for("bus"), r"agent: expected one of ego_vehicle, .*found 'bus'"),
        (
            lambda: AGENT_CONFIGS["all"].agents_for(POLE, side="left"),
            "side: expected one of ego_vehicle, other_vehicle, found 'left'",
        ),
    ],
)
def test_wrong_roles_agents_and_sides(make: Callable[[], object], sentence: str) -> None:
    assert_refused(
        (make, ChoiceError, sentence),
    )


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
            lambda: cooperating_agents(da_b, sample, POLE),
            ChoiceError,
            r"expected one of single, .*found 'infrastructure'; .*\['infrastructure'\]",
        ),
        (lambda: cooperating_agents(da_b, sample, []), ChoiceError, "at least one agent"),
        (lambda: cooperating_agents(da_b, sample + "9"), TokenError, "table 'sample' has no token"),
    )


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
            for call in (da.cooperative_boxes, da.visible_instances, da.aggregate_point_cloud, da.message_sizes)
        ],
    )
    assert len(da.cooperative_boxes(sample)) > 0
    assert_refused(
        (
            lambda: cooperating_agents(da, sample, "all"),
            NotAvailableError,
            ("; unpack its archive", "name the agents that are there", "agents='available' (--agents available)"),
        ),
    )
    assert cooperating_agents(da, sample, "available") == (EGO, POLE)
    assert len(da.cooperative_boxes(sample, agents="available")) == len(da.cooperative_boxes(sample))
    assert MotionLabelConfig(agents="available").digest == MotionLabelConfig().digest


@pytest.mark.parametrize("agents", [3, 2.5, object()])
def test_what_names_no_agents_is_refused(da_b: DeepAccident, agents: object) -> None:
    assert_refused(
        (
            lambda: da_b.cooperative_boxes(da_b.sample[0], agents=agents),
            ChoiceError,
            "agents: expected agents' names or a configuration, found",
        ),
    )


def test_names_of_another_kind(da_b: DeepAccident) -> None:
    assert_refused(
        *[
            (
                partial(cooperating_agents, da_b, da_b.sample[0], wrong),
                ChoiceError,
                r"agent: expected one of ego_vehicle, .* found",
            )
            for wrong in ([None], [3], [np.zeros(2)])
        ],
    )
    named = cooperating_agents(da_b, da_b.sample[0], np.array(["infrastructure", "ego_vehicle"]))
    assert named == ("ego_vehicle", "infrastructure")
    assert_refused(
        *[
            (partial(AgentConfig, "mine", wrong), ChoiceError, "partners: expected roles, found")
            for wrong in (3, "behind", None)
        ],
    )
    assert AgentConfig("mine", ["behind"]) == AgentConfig("mine", ("behind",))
