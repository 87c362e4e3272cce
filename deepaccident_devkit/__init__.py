"""DeepAccident devkit: the V2X accident dataset as tables, sensors, transforms, labels and numbers, on any CPU."""

from typing import TYPE_CHECKING, Any

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import DeepAccidentError

if TYPE_CHECKING:
    from deepaccident_devkit.deepaccident import DeepAccident

__all__ = ["DeepAccident", "DeepAccidentError", "__version__"]


def __getattr__(name: str) -> Any:
    """Import the facade when it is asked for: the test kit's plugin, which pytest loads at its start, is none of it."""
    if name != "DeepAccident":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from deepaccident_devkit.deepaccident import DeepAccident

    return DeepAccident


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
