"""The stage of a scenario: all that stands still around a junction."""

from deepaccident_devkit.synth.stage.props import LAMP_COLORS, LANTERN_COLOR, STOREY, SignalHead
from deepaccident_devkit.synth.stage.world import World, random_world

__all__ = ["LAMP_COLORS", "LANTERN_COLOR", "STOREY", "SignalHead", "World", "random_world"]
