"""Pictures of what `deepaccident_devkit.safety` computes, which has them, under the names that they had here."""

from deepaccident_devkit.rooms import names_of

__all__ = ["render_avoidability", "render_lead_times", "save_safety_report"]  # noqa: F822 - of the room

__getattr__, __dir__ = names_of(__name__, __all__)
