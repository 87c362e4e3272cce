"""The golden visibility (tests/data/golden: f_visibility, and a_labels for the accident's): exactly
the same objects count as seen.

The released functions made it under numpy 1.23.5 (tests/data/golden/README.md); the rules are in
docs/released_code.md, Visibility and attributes.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, UNTRACKED_ID, VEHICLE_AGENTS
from deepaccident_devkit.v2x import accident_visible_mask, pair_in_view

pytestmark = pytest.mark.golden_cases("f_visibility", "cases")


def compute_masks(golden, *, flipped: bool = False) -> list[np.ndarray]:
    """Return a mask of the objects that each agent's LiDAR and cameras see."""
    return [
        visible_mask(
            golden["xy", a] * (1, -1) if flipped else golden["xy", a],
            golden["cls", a],
            golden["pts", a],
            golden["cam", a],
            infrastructure=agent == INFRASTRUCTURE,
        )
        for a, agent in enumerate(AGENTS)
    ]


def test_the_union_of_the_agents_equals_the_released_codes(golden) -> None:
    ids = [golden["ids", a] for a in range(5)]
    union = visible_ids(compute_masks(golden), ids)
    assert_array_equal(union, np.unique(union))
    for a in range(5):
        valid = np.isin(ids[a], union)
        assert_array_equal(valid, golden["out_valid", a])
        assert_array_equal(3 * valid + 1, golden["out_vis", a])


def test_one_agents_mask_equals_the_single_agent_variants(golden) -> None:
    for a, mask in enumerate(compute_masks(golden)):
        ids = golden["ids", a]
        is_tracked = (ids != UNTRACKED_ID) & (ids < 2_000_000)
        assert_array_equal(mask, golden["out_single_valid", a])
        assert_array_equal(3 * (mask & is_tracked) + 1, golden["out_single_vis", a])


def test_whether_each_agent_itself_sees_the_others_of_the_accident(golden) -> None:
    pair = golden.entry["accident_ids"]
    own_ids = dict(zip(VEHICLE_AGENTS, golden.entry["agent_ids"], strict=True))
    masks = compute_masks(golden)
    is_seen = {}
    for a, agent in enumerate(AGENTS):
        is_seen[agent] = pair_in_view(masks[a], golden["ids", a], pair, own_ids.get(agent))
    assert is_seen == golden.entry["check_accident_vehicles_visibility"]


def test_another_handedness_sees_the_same(golden) -> None:
    masks = compute_masks(golden)
    for mask, flipped_mask in zip(masks, compute_masks(golden, flipped=True), strict=True):
        assert_array_equal(flipped_mask, mask)


@pytest.mark.golden_cases("a_labels", "scenes")
def test_accident_visibility_equals_the_released_codes(golden) -> None:
    """Apply the rule over three moments.

    The last moment, frame 0, is also computed from what the scene's agent sees.
    """
    scene = golden.entry
    number = AGENTS.index(scene["agent"])
    is_infrastructure = scene["agent"] == INFRASTRUCTURE
    _, first, _, second, _ = scene["meta"][0].split()
    with np.load(golden.folder / f"a_labels_{golden.index:02d}.npz") as archive:
        arrays = dict(archive)
    in_view = arrays["check_accident_visibility"]
    expected = arrays["accident_visibility"]

    fields = [arrays[f"vis_{name}_0_{number}"] for name in ("xy", "cls", "pts", "cam")]
    mask = visible_mask(*fields, infrastructure=is_infrastructure)
    own_id = scene["agent_ids"].get(scene["agent"])
    ids = arrays[f"vis_ids_0_{number}"]
    in_view_now = pair_in_view(mask, ids, (int(first), int(second)), own_id)
    assert_array_equal(in_view_now, in_view[-1])

    moments = [*in_view[:-1], in_view_now]
    assert_array_equal(accident_visible_mask(moments, collision=first != "-1"), expected)
    assert str(bool(expected)) == scene["accident_visibility"]
