"""What the rooms of the ring add to the core, named in one place.

The core imports none of them: it asks for what they add by kind and name, so that it works where a room is missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from deepaccident_devkit.errors import MissingRoomError

NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    "explore": ("interactions", "maps", "safety"),
    "safety": ("interactions",),
    "synth.demo": ("baselines",),
}
"""A room, or a module of one → the other rooms that it stands on; pyproject.toml holds all others to none."""
ADDED: Final[Mapping[str, Mapping[str, str]]] = {
    "field": dict.fromkeys(("min_ttc", "min_pet", "min_gap", "max_drac"), "interactions.scenario:each_of_moving_pairs"),
    "method": {
        "describe": "safety.stories:describe",
        "interactions": "interactions.scenario:interactions",
        "render_town_map": "maps.pictures:render_town_map",
        "town_map": "maps.making:town_map",
    },
    "picture": {
        "draw_town_map": "maps.pictures:draw_town_map",
        "ground_at": "maps.pictures:ground_at",
        "map": "maps.pictures:map_beneath",
        "render_avoidability": "safety.figures:render_avoidability",
        "render_lead_times": "safety.figures:render_lead_times",
        "render_town_map": "maps.pictures:render_town_map",
        "save_safety_report": "safety.page:save_safety_report",
    },
    "table": {"interactions": "interactions.scenario:least_times"},
    "verb": {
        "demo": "synth.demo:demo",
        "explore": "explore.cli:explore",
        "predict": "baselines.cli:predict",
        "safety": "safety.cli:safety",
        "synth": "synth.cli:synth",
        "town-maps": "maps.cli:town_maps",
        "train": "model.cli:train",
    },
}
"""Kind → name → where it is. `field`: of queries; `method`: of the facade; `picture`: of `render`; `table`: of
`statistics`; `verb`: of the command line."""


def added(kind: str, name: str) -> Any:
    """What a room adds under a name, imported now; raises MissingRoomError."""
    module, _, attribute = ADDED[kind][name].partition(":")
    room = module.partition(".")[0]
    for each in (room, *NEEDS.get(room, ()), *NEEDS.get(module, ())):
        need_room(each, name)
    return getattr(import_module(f"{__package__}.{module}"), attribute)


def need_room(room: str, what: str) -> None:
    """Raise MissingRoomError, which says what needs it, if a room is not installed."""
    spec = find_spec(f"{__package__}.{room}")
    if spec is None or spec.origin is None:  # without one: a folder that an uninstalled room left
        raise MissingRoomError(
            f"{what}: needs the room `{room}`, which this installation lacks; install the whole devkit"
        )
