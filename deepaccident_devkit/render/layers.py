"""The layers of a picture, which a caller can switch on and off."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Literal, get_args

from deepaccident_devkit.text import choice

Layer = Literal[
    "image", "map", "bev", "points", "boxes", "ids", "velocities", "trajectories", "labels", "visibility", "grid"
]
"""`image` is the camera's picture, `map` the town's ground by all its recordings, `bev` the simulator's camera from
above, `labels` what the motion labels say."""
LAYERS: tuple[Layer, ...] = get_args(Layer)


def layers_of(
    given: Iterable[Layer] | None, default: Iterable[Layer], possible: Collection[Layer] = LAYERS
) -> frozenset[Layer]:
    """The layers to render.

    Args:
        given: the caller's layers, in a list or one alone. None stands for the default, an empty list for an empty
            picture.
        default: the layers rendered when the caller does not choose.
        possible: the layers that the picture has.

    Returns:
        The layers chosen.

    Raises:
        ChoiceError: the picture does not have a layer.
    """
    words = default if given is None else given
    return frozenset(choice("layers", layer, possible) for layer in ((words,) if isinstance(words, str) else words))
