"""A scenario as one HTML file that plays in a browser, without a server or a network."""

from deepaccident_devkit.render.replay.replay import render_replay

__all__ = ["render_replay"]
