"""Interactions of pairs of road users: distances, speeds, and times to contact."""

from deepaccident_devkit.collisions.recorded import CLASS_MASSES, masses_of
from deepaccident_devkit.geometry import time_to_collision
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.interactions.encroachment import conflict_area_pet, post_encroachment_time
from deepaccident_devkit.interactions.measures import (
    closing_speed,
    closing_speed_of_boxes,
    delta_v,
    drac,
    drac_1d,
    drac_of,
    impact_direction,
    impact_heading,
    modified_ttc,
    modified_ttc_1d,
    nearest_approach,
    relative_speed,
    time_exposed,
    time_integrated,
    time_to_collision_1d,
)
from deepaccident_devkit.interactions.scenario import interactions, interactions_of
from deepaccident_devkit.interactions.table import InteractionConfig, InteractionPairs, Interactions

__all__ = [
    "CLASS_MASSES",
    "InteractionConfig",
    "InteractionPairs",
    "Interactions",
    "closing_speed",
    "closing_speed_of_boxes",
    "conflict_area_pet",
    "delta_v",
    "drac",
    "drac_1d",
    "drac_of",
    "gaps_of_pairs",
    "impact_direction",
    "impact_heading",
    "interactions",
    "interactions_of",
    "masses_of",
    "modified_ttc",
    "modified_ttc_1d",
    "nearest_approach",
    "post_encroachment_time",
    "relative_speed",
    "time_exposed",
    "time_integrated",
    "time_to_collision",
    "time_to_collision_1d",
]
