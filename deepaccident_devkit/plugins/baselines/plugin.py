"""What the plug-in `baselines` adds to the devkit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin

if TYPE_CHECKING:
    import click


def _predict() -> click.Command:
    from deepaccident_devkit.plugins.baselines.cli import predict

    return predict


PLUGIN: Final = Plugin(
    name="baselines",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "predict": LazyVerb("Predict with a trained model, or with a baseline.", _predict),
    },
)
