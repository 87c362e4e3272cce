"""DeepAccident devkit: the V2X accident dataset as tables, sensors, transforms, labels and numbers, on any CPU."""

from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.support.text import Pictured
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from deepaccident_devkit.deepaccident import DeepAccident

__all__ = ["DeepAccident", "DeepAccidentError", "__version__"]


def __getattr__(name: str) -> Any:
    """Import the facade when it is asked for: the test kit's plugin, which pytest loads at its start, is none of it."""
    if name != "DeepAccident":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from deepaccident_devkit.deepaccident import DeepAccident

    return DeepAccident


def _png_of(thing: object) -> bytes:
    """What `Pictured` shows: rendered by the package that is imported for it."""
    from deepaccident_devkit.render.notebook import png_of

    return png_of(thing)


Pictured.png_of = staticmethod(_png_of)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
