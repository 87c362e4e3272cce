"""Fault injection: seeded mutations of a synthetic release, and what `validate` says of them."""
