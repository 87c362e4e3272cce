"""Replays: one HTML file per scenario, which plays in a browser without a network connection.

Other pages of the devkit use parts of replays.
"""

from deepaccident_devkit.render.replay.entries import recording_of
from deepaccident_devkit.render.replay.page import (
    render_replay,
    replay_script,
    replay_style,
    script_json,
    served_replay,
    tried_replay,
)
from deepaccident_devkit.render.replay.sensors import cloud_text

__all__ = [
    "cloud_text",
    "recording_of",
    "render_replay",
    "replay_script",
    "replay_style",
    "script_json",
    "served_replay",
    "tried_replay",
]
