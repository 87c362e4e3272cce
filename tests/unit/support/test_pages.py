"""Pages by templates: well-formed, and names are harmless."""

import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jinja2 import DictLoader
from report_page import Page

from deepaccident_devkit.support.pages import document, environment, result_text

TREE = '{% from "macros.html" import tree %}{{ tree(value) }}'


def filled(text: str, **context: Any) -> str:
    return environment().from_string(text).render(**context)


@settings(max_examples=25)
@given(
    st.recursive(
        st.text() | st.floats() | st.none() | st.booleans(),
        lambda each: st.lists(each) | st.dictionaries(st.text(), each),
    )
)
def test_any_value_becomes_well_formed_html(value: Any) -> None:
    Page(filled(TREE, value=value))
    Page(filled('<p title="{{ value }}">{{ value }}</p>', value=value))


def test_trees_hold_all_values() -> None:
    assert filled(TREE, value={"<a>": [1.0, None, True]}) == (
        '<table class="tree"><tr><th scope="row">&lt;a&gt;</th><td>1, –, yes</td></tr></table>'
    )
    assert "0.333333</td>" in filled(TREE, value=[{"name": "a", "share": 1 / 3}, {"other": 2}])
    assert [filled(TREE, value=each) for each in ([], {}, [[1, 2], [3]], [""])] == [
        "none",
        "none",
        "1, 2; 3",
        "",
    ]


def test_results_have_three_decimals_or_digits() -> None:
    values = [0.382271, 3.3e-14, 81.1111, 12533.4, 12533, 90.0, None, [1.5, [2, 0.25]]]
    assert [result_text(each) for each in values] == [
        *("0.382", "0.000", "81.1", "12,533", "12,533", "90", "–"),
        "1.500; 2, 0.250",
    ]


def test_control_characters_of_names_are_shown_in_pages() -> None:
    """Whoever prints a page in a terminal sees no colours, jumps or turned letters of a
    stranger's.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(environment(), "loader", DictLoader({"page.html": "<p>{{ name }}\n\t</p>"}))
        page = document("page.html", style="", name="a\x1b[31m\x07\u202e\x9b\ud800é<")
    assert page == r"<p>a\u001b[31m\u0007\u202e\u009b\ud800é&lt;" + "\n\t</p>"
    assert page.encode()


def test_templates_are_read_when_the_first_page_is_made() -> None:
    code = (
        "import sys, deepaccident_devkit, deepaccident_devkit.cli; "
        "sys.exit('jinja2' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
