"""Builds the package; everything it says of itself stands in pyproject.toml."""

from setuptools import setup

setup()
