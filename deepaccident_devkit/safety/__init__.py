"""Accidents looked into: who saw the danger first, when it was too late, what a warning would have prevented."""

from deepaccident_devkit.safety.accidents import Accident, Skipped, accident_of, accidents_of
from deepaccident_devkit.safety.outcomes import (
    BRAKINGS,
    OUTCOMES,
    Braking,
    Outcomes,
    ReplayCheck,
    outcomes_of,
    undisturbed,
)

__all__ = [
    "BRAKINGS",
    "OUTCOMES",
    "Accident",
    "Braking",
    "Outcomes",
    "ReplayCheck",
    "Skipped",
    "accident_of",
    "accidents_of",
    "outcomes_of",
    "undisturbed",
]
