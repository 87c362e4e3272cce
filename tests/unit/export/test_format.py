"""Settings of a format, and the names that scenarios get."""

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused
from tiny_format import TinyFormat

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.export.bulk import flat_name

TYPE = "type1_subtype1_accident"
TOKENS = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="/\0"), min_size=1, max_size=250)


def test_choices_get_their_usual_spelling_and_order() -> None:
    form = TinyFormat(
        agents=("Infrastructure", "EGO_VEHICLE", "ego_vehicle"), link="Copy", split="VAL", where="length>=3"
    )  # type: ignore[arg-type]
    usual = TinyFormat(agents=("ego_vehicle", "infrastructure"), link="copy", split="val", where=("length>=3",))
    assert (form, form.settings()) == (usual, usual.settings())
    assert TinyFormat(agents="ego_vehicle").agents == ("ego_vehicle",)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"agents": ("ego",)}, "agents: expected one of"),
        ({"agents": ()}, "agents: expected some of .*found none"),
        ({"link": "soft"}, "link: expected one of hard, symbolic, copy, found 'soft'"),
        ({"split": "trian"}, "split: expected one of .*did you mean 'train'"),
        ({"where": ("town",)}, "expected field=value"),
        ({"where": (len,)}, "expected a text such as"),
    ],
)
def test_a_wrong_choice_is_refused_before_a_release_is_opened(options: dict[str, Any], words: str) -> None:
    assert_refused((lambda: TinyFormat(**options), ChoiceError, words))


class TestNames:
    def test_published_ones_are_plain(self) -> None:
        name = "Town03_type001_subtype0001_scenario00024"
        assert flat_name(f"{TYPE}/{name}") == f"{TYPE}__{name}"

    @given(TOKENS, TOKENS)
    def test_two_tokens_have_two_names_of_few_characters(self, a: str, b: str) -> None:
        first, second = flat_name(f"{TYPE}/{a}"), flat_name(f"{TYPE}/{b}")
        assert (first == second) == (a == b)
        assert re.fullmatch(r"[!-~]{1,199}", first)
        assert not set(first) & set('/\\:*?"<>|')

    @pytest.mark.parametrize("odd", ["a b", "a\nb", "ä_b", "a" * 240])
    def test_those_that_would_be_alike(self, odd: str) -> None:
        made = flat_name(f"{TYPE}/{odd}")
        alike = [made, *(flat_name(f"{TYPE}/{name}") for name in (made.split("__")[1], "a_b", "__b", "a" * 241))]
        assert len(set(alike)) == len(alike)
