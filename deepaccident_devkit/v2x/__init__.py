"""Agents and what connects them: transforms between any two of them."""

from deepaccident_devkit.v2x.transforms import transform

__all__ = ["transform"]
