"""Helpers of all packages: arrays, texts, files, reports, pages, bulk work, plug-ins."""
