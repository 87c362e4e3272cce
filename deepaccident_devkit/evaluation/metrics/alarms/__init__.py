"""Alarms of accidents and what really happens: what the metrics of accidents and of warnings share."""
