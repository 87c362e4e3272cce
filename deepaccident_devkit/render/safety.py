"""Pictures of what `deepaccident_devkit.safety` computes, which has them, under the names that they had here."""

from typing import Any

from deepaccident_devkit.rooms import ADDED, added


def __getattr__(name: str) -> Any:
    if name not in ADDED["picture"]:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return added("picture", name)
