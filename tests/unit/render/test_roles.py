"""Who is red, who is green, and who has its category's colour."""

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.colors import CATEGORY_COLORS, COLLIDER_COLOR, COMPANION_COLOR
from deepaccident_devkit.render.roles import companion_ids, role_colors
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import cooperative_boxes


def test_the_pair_is_red_their_companions_green_and_the_rest_by_category(da: DeepAccident, approach: str) -> None:
    boxes = da.boxes(approach, "ego")
    colors = dict(zip(boxes.actor_id.tolist(), role_colors(da, approach, boxes), strict=True))
    scenario = da.get("scenario", approach.rsplit("/", 2)[0])
    agents = {name: da.get("agent", f"{scenario['token']}/{name}")["actor_id"] for name in AGENTS[:4]}
    assert colors[OWN_ACTOR_ID] == COLLIDER_COLOR
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == {
        OWN_ACTOR_ID,
        agents["other_vehicle"],
    }
    behind = {agents["ego_vehicle_behind"], agents["other_vehicle_behind"]}
    assert companion_ids(da, approach) == behind
    assert {actor for actor, color in colors.items() if color == COMPANION_COLOR} == behind & set(colors)
    for actor, category, color in zip(
        boxes.actor_id.tolist(), boxes.category_names, role_colors(da, approach, boxes), strict=True
    ):
        if actor not in {OWN_ACTOR_ID, *agents.values()}:
            assert color == CATEGORY_COLORS[category]


def test_an_agent_has_its_part_s_colour_in_its_own_label_and_in_the_union(da: DeepAccident, approach: str) -> None:
    sample = approach.replace("ego_vehicle/", "ego_vehicle_behind/")
    assert OWN_ACTOR_ID in companion_ids(da, sample)
    union = cooperative_boxes(da, approach, frame="ego")
    colors = dict(zip(union.actor_id.tolist(), role_colors(da, approach, union), strict=True))
    pair = set(da.get("scenario", approach.rsplit("/", 2)[0])["collision"]["ids"])
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == pair
