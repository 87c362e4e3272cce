"""Products that stand on the core, each a plug-in; and what a plug-in of another package is made of."""

from deepaccident_devkit.support.plugins import (
    PROTOCOL_VERSION,
    LazyFormat,
    LazyTask,
    LazyVerb,
    Opener,
    Plugin,
)

__all__ = ["PROTOCOL_VERSION", "LazyFormat", "LazyTask", "LazyVerb", "Opener", "Plugin"]
