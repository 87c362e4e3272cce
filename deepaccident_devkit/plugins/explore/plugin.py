"""The subcommand that the plug-in `explore` provides."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin, need_plugin

if TYPE_CHECKING:
    import click


def _explore() -> click.Command:
    need_plugin("safety", "explore")
    from deepaccident_devkit.plugins.explore.cli import explore

    return explore


PLUGIN: Final = Plugin(
    name="explore",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "explore": LazyVerb("Show a release in the browser.", _explore),
    },
)
