"""Alarms of accidents and what really happens, for the metrics of accidents and of warnings."""
