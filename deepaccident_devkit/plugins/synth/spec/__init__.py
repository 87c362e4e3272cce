"""Scenario files: their fields, how they are read, and the paper's twelve designs as such files.

A file is read into a `SpecTemplate` with ranges and choices that are still open; `draw` makes a
`ScenarioSpec` from it. The modules, lowest layer first: `model` (the fields and their open
choices), `reading` (YAML and types), `checks` (all other checks), `catalogue` (templates and the
designs).
"""

from deepaccident_devkit.plugins.synth.spec.catalogue import (
    DESIGN_NUMBERS,
    SpecTemplate,
    design_text,
    draw,
    parse_spec,
    read_design,
    read_spec,
)
from deepaccident_devkit.plugins.synth.spec.model import (
    ActorSpec,
    BackgroundSpec,
    MeetSpec,
    ScenarioSpec,
    View,
)

__all__ = [
    "DESIGN_NUMBERS",
    "ActorSpec",
    "BackgroundSpec",
    "MeetSpec",
    "ScenarioSpec",
    "SpecTemplate",
    "View",
    "design_text",
    "draw",
    "parse_spec",
    "read_design",
    "read_spec",
]
