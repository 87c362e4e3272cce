"""What the plug-in `study` adds to the devkit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin, need_plugin

if TYPE_CHECKING:
    import click


def _study() -> click.Command:
    need_plugin("baselines", "study")
    need_plugin("synth", "study")
    from deepaccident_devkit.plugins.study.cli import study

    return study


PLUGIN = Plugin(
    name="study",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "study": LazyVerb("Train and compare models as a recipe says.", _study),
    },
)
