"""Layers: which ones a caller may ask a picture for."""

from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.figures import LAYERS, layers_of


def test_none_means_the_default_layers_and_an_empty_list_means_no_layer() -> None:
    assert layers_of(None, ("boxes", "ids")) == {"boxes", "ids"}
    assert layers_of((), ("boxes",)) == frozenset()


def test_one_layer_needs_no_list_and_any_iterable_is_fine() -> None:
    assert layers_of("boxes", ()) == {"boxes"}  # type: ignore[arg-type]
    assert layers_of(iter(("boxes", "ids")), ()) == {"boxes", "ids"}


def test_an_unknown_layer_is_refused_and_the_known_ones_are_named() -> None:
    assert_raises(
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
