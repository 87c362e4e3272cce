"""Products built on the core, each a plug-in, and the parts of a plug-in in another package."""

from deepaccident_devkit.support.plugins import (
    PROTOCOL_VERSION,
    LazyFormat,
    LazyTask,
    LazyVerb,
    Opener,
    Plugin,
)

__all__ = ["PROTOCOL_VERSION", "LazyFormat", "LazyTask", "LazyVerb", "Opener", "Plugin"]
