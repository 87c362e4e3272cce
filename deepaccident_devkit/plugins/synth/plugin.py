"""The commands of the plug-in `synth`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin, need_plugin

if TYPE_CHECKING:
    import click


def _load_demo() -> click.Command:
    """Return the command `demo`."""
    need_plugin("baselines", "demo")
    from deepaccident_devkit.plugins.synth.demo import demo

    return demo


def _load_synth() -> click.Command:
    """Return the command `synth`."""
    from deepaccident_devkit.plugins.synth.cli import synth

    return synth


PLUGIN: Final = Plugin(
    name="synth",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "demo": LazyVerb("Make a small synthetic release, and a page that shows it.", _load_demo),
        "synth": LazyVerb("Make a synthetic release.", _load_synth),
    },
)
