"""Accidents looked into: who saw the danger first, when it was too late, what a warning would have prevented."""

from deepaccident_devkit.safety.accidents import Accident, Skipped, accident_of, accidents_of

__all__ = [
    "Accident",
    "Skipped",
    "accident_of",
    "accidents_of",
]
