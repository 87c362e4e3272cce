"""Recorded collisions: pair, contact, impact, effect of braking, and twins without a collision."""

from deepaccident_devkit.collisions.outcomes import (
    BRAKINGS,
    OUTCOMES,
    Braking,
    Outcomes,
    ReplayCheck,
    outcomes_of,
    undisturbed,
)
from deepaccident_devkit.collisions.recorded import Accident, Skipped, accident_of, accidents_of
from deepaccident_devkit.collisions.twins import TornTwins, torn_twins, twin_of

__all__ = [
    "BRAKINGS",
    "OUTCOMES",
    "Accident",
    "Braking",
    "Outcomes",
    "ReplayCheck",
    "Skipped",
    "TornTwins",
    "accident_of",
    "accidents_of",
    "outcomes_of",
    "torn_twins",
    "twin_of",
    "undisturbed",
]
