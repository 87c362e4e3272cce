"""Roads: junctions with lanes, smooth paths, sidewalks, and a raster of the ground with its height."""

from deepaccident_devkit.synth.roads.ground import (
    FIRST_BUILDING,
    GRASS,
    MAP_CELLS,
    MAP_EXTENT,
    MAP_RESOLUTION,
    POLE,
    ROAD,
    ROAD_CODES,
    SIDEWALK,
    TERRAIN,
    TREE,
    WHITE,
    YELLOW,
    GroundMap,
    tag_of_code,
)
from deepaccident_devkit.synth.roads.junction import TURNS, Junction, Route, Turn
from deepaccident_devkit.synth.roads.layout import LANE_WIDTH, RoadKind, RoadSpec
from deepaccident_devkit.synth.roads.paths import Meeting, Path, crossing, lane_change, straight
from deepaccident_devkit.synth.roads.terrain import ARMS, Arm, Hump, Terrain

__all__ = [
    "ARMS",
    "FIRST_BUILDING",
    "GRASS",
    "LANE_WIDTH",
    "MAP_CELLS",
    "MAP_EXTENT",
    "MAP_RESOLUTION",
    "POLE",
    "ROAD",
    "ROAD_CODES",
    "SIDEWALK",
    "TERRAIN",
    "TREE",
    "TURNS",
    "WHITE",
    "YELLOW",
    "Arm",
    "GroundMap",
    "Hump",
    "Junction",
    "Meeting",
    "Path",
    "RoadKind",
    "RoadSpec",
    "Route",
    "Terrain",
    "Turn",
    "crossing",
    "lane_change",
    "straight",
    "tag_of_code",
]
