"""Accidents looked into: who saw the danger first, when it was too late, what a warning would have prevented."""

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
from deepaccident_devkit.safety.twin_comparison import twin_diff
from deepaccident_devkit.safety.twin_diff import Parting, TwinDiff
from deepaccident_devkit.safety.twin_report import TwinReport, twin_report
from deepaccident_devkit.safety.twins import TornTwins, torn_twins, twin_of

__all__ = [
    "BRAKINGS",
    "COALITIONS",
    "OUTCOMES",
    "PARTNERS",
    "Accident",
    "Avoidability",
    "AvoidabilityReport",
    "Braking",
    "LeadTimeLedger",
    "LeadTimes",
    "MeanTime",
    "ObservationRule",
    "OutcomeShares",
    "Outcomes",
    "Parting",
    "ReplayCheck",
    "Skipped",
    "TornTwins",
    "TwinDiff",
    "TwinReport",
    "accident_of",
    "accidents_of",
    "avoidability",
    "avoidability_of",
    "avoidability_report",
    "coalition_leads",
    "lead_time_ledger",
    "lead_times",
    "observed_actors",
    "outcome_shares",
    "outcomes_of",
    "shapley_values",
    "torn_twins",
    "twin_diff",
    "twin_of",
    "twin_report",
    "undisturbed",
]
