"""Helpers for all packages: arrays, texts, files, reports, pages, batch work, plug-ins."""
