"""Accidents looked into: who saw the danger first, when it was too late, what a warning would have prevented."""

from deepaccident_devkit.interactions import (
    CLASS_MASSES,
    InteractionConfig,
    InteractionPairs,
    Interactions,
    closing_speed,
    closing_speed_of_boxes,
    conflict_area_pet,
    delta_v,
    drac,
    drac_1d,
    drac_of,
    gaps_of_pairs,
    impact_direction,
    impact_heading,
    interactions,
    interactions_of,
    masses_of,
    modified_ttc,
    modified_ttc_1d,
    nearest_approach,
    post_encroachment_time,
    relative_speed,
    time_exposed,
    time_integrated,
    time_to_collision,
    time_to_collision_1d,
)
from deepaccident_devkit.safety.accidents import Accident, Skipped, accident_of, accidents_of
from deepaccident_devkit.safety.avoidability import Avoidability, avoidability, avoidability_of
from deepaccident_devkit.safety.avoidability_report import AvoidabilityReport, avoidability_report
from deepaccident_devkit.safety.avoidability_shares import OutcomeShares, outcome_shares
from deepaccident_devkit.safety.lead_times import COALITIONS, PARTNERS, LeadTimes, lead_times
from deepaccident_devkit.safety.leads import coalition_leads, shapley_values
from deepaccident_devkit.safety.ledger import lead_time_ledger
from deepaccident_devkit.safety.ledger_report import LeadTimeLedger, MeanTime
from deepaccident_devkit.safety.observation import ObservationRule, observed_actors
from deepaccident_devkit.safety.outcomes import (
    BRAKINGS,
    OUTCOMES,
    Braking,
    Outcomes,
    ReplayCheck,
    outcomes_of,
    undisturbed,
)
from deepaccident_devkit.safety.overall_report import SafetyReport, safety_report
from deepaccident_devkit.safety.report_rows import AccidentRow, PairMeasures
from deepaccident_devkit.safety.stories import Story, describe, scenario_facts, stories
from deepaccident_devkit.safety.story_text import story_text
from deepaccident_devkit.safety.twin_comparison import twin_diff
from deepaccident_devkit.safety.twin_diff import Parting, TwinDiff
from deepaccident_devkit.safety.twin_report import TwinReport, twin_report
from deepaccident_devkit.safety.twins import TornTwins, torn_twins, twin_of

__all__ = [
    "BRAKINGS",
    "CLASS_MASSES",
    "COALITIONS",
    "OUTCOMES",
    "PARTNERS",
    "Accident",
    "AccidentRow",
    "Avoidability",
    "AvoidabilityReport",
    "Braking",
    "InteractionConfig",
    "InteractionPairs",
    "Interactions",
    "LeadTimeLedger",
    "LeadTimes",
    "MeanTime",
    "ObservationRule",
    "OutcomeShares",
    "Outcomes",
    "PairMeasures",
    "Parting",
    "ReplayCheck",
    "SafetyReport",
    "Skipped",
    "Story",
    "TornTwins",
    "TwinDiff",
    "TwinReport",
    "accident_of",
    "accidents_of",
    "avoidability",
    "avoidability_of",
    "avoidability_report",
    "closing_speed",
    "closing_speed_of_boxes",
    "coalition_leads",
    "conflict_area_pet",
    "delta_v",
    "describe",
    "drac",
    "drac_1d",
    "drac_of",
    "gaps_of_pairs",
    "impact_direction",
    "impact_heading",
    "interactions",
    "interactions_of",
    "lead_time_ledger",
    "lead_times",
    "masses_of",
    "modified_ttc",
    "modified_ttc_1d",
    "nearest_approach",
    "observed_actors",
    "outcome_shares",
    "outcomes_of",
    "post_encroachment_time",
    "relative_speed",
    "safety_report",
    "scenario_facts",
    "shapley_values",
    "stories",
    "story_text",
    "time_exposed",
    "time_integrated",
    "time_to_collision",
    "time_to_collision_1d",
    "torn_twins",
    "twin_diff",
    "twin_of",
    "twin_report",
    "undisturbed",
]
