"""DeepAccident devkit: the V2X accident dataset as tables, sensors, labels and numbers."""

from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.support.text import PictureRepr
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from deepaccident_devkit.deepaccident import DeepAccident

__all__ = ["DeepAccident", "DeepAccidentError", "__version__"]


def __getattr__(name: str) -> Any:
    """Import the facade at its first use: pytest loads the test kit's plugin, which needs none."""
    if name != "DeepAccident":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from deepaccident_devkit.deepaccident import DeepAccident

    return DeepAccident


def _png_of(subject: object) -> bytes:
    """Render the picture that `PictureRepr` shows; the renderer is only imported here."""
    from deepaccident_devkit.render.notebook import png_of

    return png_of(subject)


PictureRepr.png_of = staticmethod(_png_of)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
