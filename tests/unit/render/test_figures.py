"""Layers: what a caller may ask of a picture."""

from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.figures import LAYERS, layers_of


def test_none_is_the_default_and_nothing_is_nothing() -> None:
    assert layers_of(None, ("boxes", "ids")) == {"boxes", "ids"}
    assert layers_of((), ("boxes",)) == frozenset()


def test_one_layer_needs_no_list_and_any_iterable_is_fine() -> None:
    assert layers_of("boxes", ()) == {"boxes"}  # type: ignore[arg-type]
    assert layers_of(iter(("boxes", "ids")), ()) == {"boxes", "ids"}


def test_a_layer_that_the_picture_has_not_is_refused_with_those_it_has() -> None:
    assert_refused(
        (
            lambda: layers_of(["points"], (), ("image", "boxes")),
            ChoiceError,
            "layers: expected one of image, boxes, found 'points'",
        ),
        (
            lambda: layers_of(["box"], (), LAYERS),
            ChoiceError,
            r"layers: expected one of image, .*, found 'box'; did you mean 'boxes'",
        ),
    )
