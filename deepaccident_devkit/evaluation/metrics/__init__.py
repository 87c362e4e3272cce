"""The metrics: a package for each task, and below them what the tasks share."""
