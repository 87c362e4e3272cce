"""HTML out of values: well-formed, and names are harmless."""

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from report_page import Page

from deepaccident_devkit.render.markup import Markup, breakable, number, tag, tree


@settings(max_examples=25)
@given(
    st.recursive(
        st.text() | st.floats() | st.none() | st.booleans(),
        lambda each: st.lists(each) | st.dictionaries(st.text(), each),
    )
)
def test_any_value_becomes_well_formed_html(value: Any) -> None:
    Page(tree(value))
    Page(tag("p", str(value), title=str(value)))


def test_only_markup_is_not_escaped() -> None:
    assert tag("p", "<b>", Markup("<i>x</i>"), class_='"') == '<p class="&quot;">&lt;b&gt;<i>x</i></p>'
    assert tree({"a": [1.0, None, True]}) == (
        '<table class="tree"><tr><th scope="row">a</th><td>1, –, yes</td></tr></table>'
    )
    assert "0.333333</td>" in tree([{"name": "a", "share": 1 / 3}, {"other": 2}])


def test_results_have_three_decimals_or_digits() -> None:
    values = [0.382271, 3.3e-14, 81.1111, 12533.4, 12533, 90.0, None, [1.5, [2, 0.25]]]
    assert [number(each) for each in values] == [
        *("0.382", "0.000", "81.1", "12,533", "12,533", "90", "–"),
        "1.500; 2, 0.250",
    ]


def test_names_are_broken_between_words() -> None:
    assert breakable("ego_vehicle/030 <b>") == "ego_<wbr>vehicle/<wbr>030 &lt;b&gt;"
    assert breakable("accuracy@5") == "accuracy<wbr>@5"
    assert breakable(Markup("a_b")) == "a_b"
