"""Analyses of accidents: which agent saw them first, and what warnings would have prevented."""

from deepaccident_devkit.plugins.safety.avoidability_report import (
    AvoidabilityReport,
    OutcomeShares,
    avoidability_report,
    outcome_shares,
)
from deepaccident_devkit.plugins.safety.lead_times import (
    COALITIONS,
    PARTNERS,
    LeadTimeLedger,
    LeadTimes,
    MeanTime,
    lead_time_ledger,
    lead_times,
)
from deepaccident_devkit.plugins.safety.report import (
    AccidentRow,
    PairMeasures,
    SafetyReport,
    safety_report,
)
from deepaccident_devkit.plugins.safety.twins import (
    Parting,
    TwinDiff,
    TwinReport,
    twin_diff,
    twin_report,
)

__all__ = [
    "COALITIONS",
    "PARTNERS",
    "AccidentRow",
    "AvoidabilityReport",
    "LeadTimeLedger",
    "LeadTimes",
    "MeanTime",
    "OutcomeShares",
    "PairMeasures",
    "Parting",
    "SafetyReport",
    "TwinDiff",
    "TwinReport",
    "avoidability_report",
    "lead_time_ledger",
    "lead_times",
    "outcome_shares",
    "safety_report",
    "twin_diff",
    "twin_report",
]
