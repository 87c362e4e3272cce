"""DeepAccident devkit: the V2X accident dataset as tables, sensors, transforms, labels and numbers, on any CPU."""

from deepaccident_devkit._version import __version__
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import DeepAccidentError

__all__ = ["DeepAccident", "DeepAccidentError", "__version__"]
