"""What the rooms of the ring add to the core, named in one place.

The core imports none of them: it asks for what they add by kind and name, so that it works where a room is missing.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from deepaccident_devkit.errors import MissingRoomError

NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    "audit": ("testing",),
    "explore": ("interactions", "maps", "safety"),
    "safety": ("interactions",),
    "study": ("baselines", "synth"),
    "synth.demo": ("baselines",),
}
"""A room, or a module of one → the other rooms that it stands on; pyproject.toml holds all others to none."""
_RESULT: Final = "safety.prevention_result"
ADDED: Final[Mapping[str, Mapping[str, str]]] = {
    "check": {"source": "nuscenes.check:check_source"},
    "field": dict.fromkeys(("min_ttc", "min_pet", "min_gap", "max_drac"), "interactions.scenario:each_of_moving_pairs"),
    "figures": {"prevented": "safety.prevention_figures:prevention_figures"},
    "method": {
        "describe": "safety.stories:describe",
        "interactions": "interactions.scenario:interactions",
        "render_town_map": "maps.pictures:render_town_map",
        "town_map": "maps.making:town_map",
    },
    "name": {
        "evaluation.runs.prevented_accidents": "safety.prevention:prevented_accidents",
        "evaluation.runs.with_prevented": "safety.prevention:with_prevented",
        "evaluation.warning.AccidentOutcomes": f"{_RESULT}:AccidentOutcomes",
        "evaluation.warning.OutcomeTable": f"{_RESULT}:OutcomeTable",
        "evaluation.warning.PreventedEvaluator": "safety.prevention:PreventedEvaluator",
        "evaluation.warning.PreventedResult": f"{_RESULT}:PreventedResult",
        "evaluation.warning.PreventionCurve": f"{_RESULT}:PreventionCurve",
        "evaluation.warning.PreventionFigures": f"{_RESULT}:PreventionFigures",
        "render.evaluation.render_prevention": "safety.prevention_figures:render_prevention",
        "render.render_town_map": "maps.pictures:render_town_map",
        "render.safety.render_avoidability": "safety.figures:render_avoidability",
        "render.safety.render_lead_times": "safety.figures:render_lead_times",
        "render.safety.save_safety_report": "safety.page:save_safety_report",
    },
    "opener": {"nuscenes": "nuscenes.source:open_nuscenes"},
    "picture": {
        "draw_town_map": "maps.pictures:draw_town_map",
        "ground_at": "maps.pictures:ground_at",
        "map": "maps.pictures:map_beneath",
    },
    "result": {"prevented": "safety.prevention:PREVENTED"},
    "table": {"interactions": "interactions.scenario:least_times"},
    "verb": {
        "audit": "audit.cli:audit",
        "demo": "synth.demo:demo",
        "explore": "explore.cli:explore",
        "predict": "baselines.cli:predict",
        "rigs": "nuscenes.cli:rigs",
        "safety": "safety.cli:safety",
        "study": "study.cli:study",
        "synth": "synth.cli:synth",
        "town-maps": "maps.cli:town_maps",
        "train": "model.cli:train",
    },
    "writer": {"nuscenes": "nuscenes.results:write_detections"},
}
"""Kind → name → where it is. `check`, `opener` and `writer`: of dataroots and results of nuScenes; `field`: of queries;
`result`: of evaluations, beside their own, with its `figures`; `method`: of the facade; `name`: of a core module;
`picture`: of `render`; `table`: of `statistics`; `verb`: of the command line."""


def added(kind: str, name: str) -> Any:
    """What a room adds under a name, imported now; raises MissingRoomError."""
    module, _, attribute = ADDED[kind][name].partition(":")
    room = module.partition(".")[0]
    for each in (room, *NEEDS.get(room, ()), *NEEDS.get(module, ())):
        need_room(each, name)
    return getattr(import_module(f"{__package__}.{module}"), attribute)


def names_of(module: str, public: Iterable[str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a module of which some public names lie in a room: imported when asked for."""
    place = module.removeprefix(f"{__package__}.")

    def found(name: str) -> Any:
        if f"{place}.{name}" not in ADDED["name"]:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return added("name", f"{place}.{name}")

    return found, lambda: sorted({*vars(sys.modules[module]), *public})


def need_room(room: str, what: str) -> None:
    """Raise MissingRoomError, which says what needs it, if a room is not installed."""
    spec = find_spec(f"{__package__}.{room}")
    if spec is None or spec.origin is None:  # without one: a folder that an uninstalled room left
        raise MissingRoomError(
            f"{what}: needs the room `{room}`, which this installation lacks; install the whole devkit"
        )
