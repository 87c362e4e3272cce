"""The shapes of each category: solids inside its label box, x forward, origin on the road below the box's centre."""

from collections.abc import Callable

from deepaccident_devkit.synth import solids
from deepaccident_devkit.synth.shapes import riders, vehicles
from deepaccident_devkit.synth.shapes.parts import BOX_CLEARANCE, INSET, LAMP, TAIL, Frame
from deepaccident_devkit.synth.solids import Block, Color, Solids

MODELS: dict[str, tuple[Callable[[Frame], list[Block]], ...]] = {
    "car": (vehicles.saloon, vehicles.hatchback, vehicles.off_roader),
    "van": (vehicles.delivery_van, vehicles.minibus),
    "truck": (vehicles.box_truck, vehicles.tank_truck),
    "motorcycle": (riders.motorcycle, riders.scooter),
    "cyclist": (riders.cyclist,),
    "pedestrian": (riders.walker, riders.stroller),
}
"""Category → the functions that build its models."""


def shape_of(category: str, size: tuple[float, float, float], color: Color, accent: Color, model: int = 0) -> Solids:
    """The solids of a road user.

    Args:
        category: one of `taxonomy.CATEGORIES`.
        size: length, width, height of its label box, metres.
        color: the colour of paint or clothes.
        accent: the colour of a second part.
        model: which of the category's `MODELS`; after the last one, the first follows.
    """
    length, width, height = size
    frame = Frame(length / 2 - INSET, width / 2 - INSET, BOX_CLEARANCE + height - INSET, color, accent)
    models = MODELS[category]
    return solids.build(models[model % len(models)](frame))


__all__ = ["BOX_CLEARANCE", "INSET", "LAMP", "MODELS", "TAIL", "shape_of"]
