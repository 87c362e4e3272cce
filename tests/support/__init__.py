"""Helpers of the tests: inputs that they share, and readers of what the devkit writes."""
