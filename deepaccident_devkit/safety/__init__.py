"""Accidents looked into: who saw the danger first, when it was too late, what a warning would have prevented."""

from deepaccident_devkit.safety.accidents import Accident, Skipped, accident_of, accidents_of
from deepaccident_devkit.safety.lead_times import COALITIONS, PARTNERS, LeadTimes, lead_times
from deepaccident_devkit.safety.leads import coalition_leads, shapley_values
from deepaccident_devkit.safety.ledger import lead_time_ledger
from deepaccident_devkit.safety.ledger_report import LeadTimeLedger, MeanTime
from deepaccident_devkit.safety.observation import ObservationRule, observed_actors

__all__ = [
    "COALITIONS",
    "PARTNERS",
    "Accident",
    "LeadTimeLedger",
    "LeadTimes",
    "MeanTime",
    "ObservationRule",
    "Skipped",
    "accident_of",
    "accidents_of",
    "coalition_leads",
    "lead_time_ledger",
    "lead_times",
    "observed_actors",
    "shapley_values",
]
