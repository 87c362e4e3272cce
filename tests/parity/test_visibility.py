"""The golden visibility (tests/data/golden: f_visibility, and a_labels for the accident's): who
counts as seen. Exact.

Made by the released functions under numpy 1.23.5 (tests/data/golden/README.md); the rules are
docs/released_code.md, Visibility and attributes.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, UNTRACKED_ID, VEHICLE_AGENTS
from deepaccident_devkit.v2x import accident_visible_mask, pair_in_view

pytestmark = pytest.mark.golden_cases("f_visibility", "cases")


def masks_of(golden) -> list[np.ndarray]:
    """What each agent's points and cameras see."""
    return [
        visible_mask(
            golden["xy", a],
            golden["cls", a],
            golden["pts", a],
            golden["cam", a],
            infrastructure=agent == INFRASTRUCTURE,
        )
        for a, agent in enumerate(AGENTS)
    ]


def test_the_union_of_the_agents_equals_the_released_codes(golden) -> None:
    ids = [golden["ids", a] for a in range(5)]
    union = visible_ids(masks_of(golden), ids)
    assert_array_equal(union, np.unique(union))
    for a in range(5):
        valid = np.isin(ids[a], union)
        assert_array_equal(valid, golden["out_valid", a])
        assert_array_equal(3 * valid + 1, golden["out_vis", a])


def test_one_agents_mask_equals_the_single_agent_variants(golden) -> None:
    for a, mask in enumerate(masks_of(golden)):
        ids = golden["ids", a]
        assert_array_equal(mask, golden["out_single_valid", a])
        assert_array_equal(
            3 * (mask & (ids != UNTRACKED_ID) & (ids < 2_000_000)) + 1, golden["out_single_vis", a]
        )


def test_whether_each_agent_itself_sees_the_others_of_the_accident(golden) -> None:
    pair, own_ids = golden.entry["accident_ids"], golden.entry["agent_ids"]
    own = dict(zip(VEHICLE_AGENTS, own_ids, strict=True))
    seen = {}
    for a, (agent, mask) in enumerate(zip(AGENTS, masks_of(golden), strict=True)):
        seen[agent] = pair_in_view(mask, golden["ids", a], pair, own.get(agent))
    assert seen == golden.entry["check_accident_vehicles_visibility"]


def test_another_handedness_sees_the_same(golden) -> None:
    for a, mask in enumerate(masks_of(golden)):
        fields = golden["cls", a], golden["pts", a], golden["cam", a]
        flipped = visible_mask(
            golden["xy", a] * (1, -1), *fields, infrastructure=AGENTS[a] == INFRASTRUCTURE
        )
        assert_array_equal(flipped, mask)


@pytest.mark.golden_cases("a_labels", "scenes")
def test_accident_visibility_equals_the_released_codes(golden) -> None:
    """The rule over three moments; the last of them also from what the scene's agent sees (frame 0
    is the present).
    """
    scene, agent = golden.entry, AGENTS.index(golden.entry["agent"])
    _, first, _, second, _ = scene["meta"][0].split()
    with np.load(golden.folder / f"a_labels_{golden.index:02d}.npz") as arrays:
        in_view, expected = arrays["check_accident_visibility"], arrays["accident_visibility"]
        xy, classes, points, camera, ids = (
            arrays[f"vis_{name}_0_{agent}"] for name in ("xy", "cls", "pts", "cam", "ids")
        )
    mask = visible_mask(xy, classes, points, camera, infrastructure=AGENTS[agent] == INFRASTRUCTURE)
    own = scene["agent_ids"].get(scene["agent"])
    now = pair_in_view(mask, ids, (int(first), int(second)), own)
    assert_array_equal(now, in_view[-1])
    assert_array_equal(
        accident_visible_mask([*in_view[:-1], now], collision=first != "-1"), expected
    )
    assert str(bool(expected)) == scene["accident_visibility"]
