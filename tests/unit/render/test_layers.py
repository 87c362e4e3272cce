"""Layers: what a caller may ask of a picture."""

import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.axes import LAYERS, layers_of


def test_none_is_the_default_and_nothing_is_nothing() -> None:
    assert layers_of(None, ("boxes", "ids")) == {"boxes", "ids"}
    assert layers_of((), ("boxes",)) == frozenset()


def test_one_layer_needs_no_list_and_any_iterable_is_fine() -> None:
    assert layers_of("boxes", ()) == {"boxes"}  # type: ignore[arg-type]
    assert layers_of(iter(("boxes", "ids")), ()) == {"boxes", "ids"}


def test_a_layer_that_the_picture_has_not_is_refused_with_those_it_has() -> None:
    with pytest.raises(ChoiceError, match="layers: expected one of image, boxes, found 'points'"):
        layers_of(["points"], (), ("image", "boxes"))
    with pytest.raises(ChoiceError, match=r"layers: expected one of image, .*, found 'box'; did you mean 'boxes'"):
        layers_of(["box"], (), LAYERS)  # type: ignore[list-item]
