"""What the plug-in `safety` adds to the devkit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin

if TYPE_CHECKING:
    import click

    from deepaccident_devkit.evaluation.runs.further import ExtraResult


def _safety() -> click.Command:
    """Import and return the command `deepaccident safety`."""
    from deepaccident_devkit.plugins.safety.cli import safety

    return safety


def _prevented() -> ExtraResult:
    """Import and return the additional evaluation result `prevented`."""
    from deepaccident_devkit.plugins.safety.prevention import PREVENTED

    return PREVENTED


PLUGIN: Final = Plugin(
    name="safety",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "safety": LazyVerb("Look into accidents: who saw it first, when it was too late.", _safety),
    },
    extra_results={"prevented": _prevented},
)
