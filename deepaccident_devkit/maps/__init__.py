"""Maps of towns: the ground that BEV cameras of a town's recordings saw, in one raster."""

from deepaccident_devkit.maps.counting import GROUND_CLASSES, TownMapConfig
from deepaccident_devkit.maps.making import kept_town_map, town_map, towns_of
from deepaccident_devkit.maps.town_map import Area, TownMap

__all__ = [
    "GROUND_CLASSES",
    "Area",
    "TownMap",
    "TownMapConfig",
    "kept_town_map",
    "town_map",
    "towns_of",
]
