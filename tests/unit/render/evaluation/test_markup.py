"""HTML out of values: well-formed, and names are harmless."""

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from report_page import Page

from deepaccident_devkit.render.evaluation.markup import Markup, tag, tree


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
