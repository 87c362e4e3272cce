"""Seeded mutations of a healthy release: `validate` must find each fault that they plant."""
