"""Who is red, who has an agent's hue, and who a category's shade."""

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.boxes import recorder_ids, role_colors
from deepaccident_devkit.render.styles import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import cooperative_boxes


def test_the_pair_is_red_other_recorders_have_hues_and_the_rest_shades(da: DeepAccident, approach: str) -> None:
    boxes = da.boxes(approach, "ego")
    colors = dict(zip(boxes.actor_id.tolist(), role_colors(da, approach, boxes), strict=True))
    scenario = da.get("scenario", approach.rsplit("/", 2)[0])
    agents = {name: da.get("agent", f"{scenario['token']}/{name}")["actor_id"] for name in AGENTS[:4]}
    assert colors[OWN_ACTOR_ID] == COLLIDER_COLOR
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == {
        OWN_ACTOR_ID,
        agents["other_vehicle"],
    }
    labels = {**agents, "ego_vehicle": OWN_ACTOR_ID}
    assert recorder_ids(da, approach) == {actor: agent for agent, actor in labels.items()}
    for agent in ("ego_vehicle_behind", "other_vehicle_behind"):
        assert colors.get(agents[agent], AGENT_COLORS[agent]) == AGENT_COLORS[agent]
    assert colors.keys() & {agents["ego_vehicle_behind"], agents["other_vehicle_behind"]}
    for actor, category, color in zip(
        boxes.actor_id.tolist(), boxes.category_names, role_colors(da, approach, boxes), strict=True
    ):
        if actor not in {OWN_ACTOR_ID, *agents.values()}:
            assert color == CATEGORY_COLORS[category]


def test_an_agent_has_its_part_s_colour_in_its_own_label_and_in_the_union(da: DeepAccident, approach: str) -> None:
    sample = approach.replace("ego_vehicle/", "ego_vehicle_behind/")
    own = da.boxes(sample, "ego")
    own = own.select(own.actor_id == OWN_ACTOR_ID)
    assert role_colors(da, sample, own) == [AGENT_COLORS["ego_vehicle_behind"]]
    union = cooperative_boxes(da, approach, frame="ego")
    colors = dict(zip(union.actor_id.tolist(), role_colors(da, approach, union), strict=True))
    pair = set(da.get("scenario", approach.rsplit("/", 2)[0])["collision"]["ids"])
    assert {actor for actor, color in colors.items() if color == COLLIDER_COLOR} == pair
