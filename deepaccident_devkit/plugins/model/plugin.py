"""Registration of the plug-in `model`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin

if TYPE_CHECKING:
    import click


def _load_train() -> click.Command:
    from deepaccident_devkit.plugins.model.cli import train

    return train


PLUGIN: Final = Plugin(
    name="model",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "train": LazyVerb("Train a model of motion, accidents and detections.", _load_train),
    },
)
