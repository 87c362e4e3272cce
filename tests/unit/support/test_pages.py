"""Pages from templates are well-formed, and hostile names in them are harmless."""

import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jinja2 import DictLoader
from support.report_page import ReportPage

from deepaccident_devkit.support.pages import document, environment, result_text

TREE = '{% from "macros.html" import tree %}{{ tree(value) }}'


def fill_template(text: str, **context: Any) -> str:
    return environment().from_string(text).render(**context)


@settings(max_examples=25)
@given(
    st.recursive(
        st.text() | st.floats() | st.none() | st.booleans(),
        lambda values: st.lists(values) | st.dictionaries(st.text(), values),
    )
)
def test_any_value_becomes_well_formed_html(value: Any) -> None:
    ReportPage(fill_template(TREE, value=value))
    ReportPage(fill_template('<p title="{{ value }}">{{ value }}</p>', value=value))


def test_trees_hold_all_values() -> None:
    assert fill_template(TREE, value={"<a>": [1.0, None, True]}) == (
        '<table class="tree"><tr><th scope="row">&lt;a&gt;</th><td>1, –, yes</td></tr></table>'
    )
    assert "0.333333</td>" in fill_template(
        TREE, value=[{"name": "a", "share": 1 / 3}, {"other": 2}]
    )
    assert fill_template(TREE, value=[]) == "none"
    assert fill_template(TREE, value={}) == "none"
    assert fill_template(TREE, value=[[1, 2], [3]]) == "1, 2; 3"
    assert fill_template(TREE, value=[""]) == ""


def test_results_have_three_decimals_or_digits() -> None:
    values = [0.382271, 3.3e-14, 81.1111, 12533.4, 12533, 90.0, None]
    expected = ["0.382", "0.000", "81.1", "12,533", "12,533", "90", "–"]
    assert [result_text(value) for value in values] == expected
    assert result_text([1.5, [2, 0.25]]) == "1.500; 2, 0.250"


def test_control_characters_of_names_are_shown_in_pages() -> None:
    """A page printed in a terminal must not show colours, jumps or reversed letters from a
    stranger's name.
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
