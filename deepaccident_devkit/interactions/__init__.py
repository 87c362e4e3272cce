"""Pairs of road users: how near they come to each other, how fast, and how soon they would touch."""

from deepaccident_devkit.interactions.masses import CLASS_MASSES, masses_of

__all__ = [
    "CLASS_MASSES",
    "masses_of",
]
