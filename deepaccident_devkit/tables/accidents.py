"""Which of the paper's twelve designs an accident realises (docs/format.md, Accident types)."""

from deepaccident_devkit.release import Meta

PEDESTRIAN = "pedestrian"


def accident_type(meta: Meta | None, *, signalized: bool) -> int | None:
    """The design 1 to 12, or None for no accident, one with a pedestrian or a third vehicle, or of no design.

    Args:
        meta: the scenario's meta, None if it is missing.
        signalized: whether the intersection has traffic lights: designs 1 to 6, else 7 to 12.
    """
    if meta is None or meta.collision is None or PEDESTRIAN in meta.collision.classes:
        return None
    if meta.agent_ids is None or not set(meta.collision.ids) <= set(meta.agent_ids):
        return None
    design = _signalized_design(meta)
    return design if design is None or signalized else design + 6


def _signalized_design(meta: Meta) -> int | None:
    if meta.ego_direction is None or meta.other_direction is None:
        return None
    directions = frozenset({meta.ego_direction, meta.other_direction})
    road, side = meta.road_type or "", meta.spawn_side or ""
    if road.startswith("three-way"):
        return 6 if "straight" in directions else 5
    if not road.startswith("four-way"):
        return None
    if side in ("left", "right"):
        return {frozenset({"straight"}): 1, frozenset({"straight", "left"}): 2}.get(directions)
    if side.startswith("opposite"):
        designs = {frozenset({"straight", "left"}): 3, frozenset({"left", "right"}): 4}
        return designs.get(directions)
    return None
