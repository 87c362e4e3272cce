"""docs/synth.md: its tables are what was measured, what was measured is still so, and its code
runs.
"""

import re
from pathlib import Path

import pytest
from scripts import of_checkout

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[4] / "docs"


@pytest.fixture(scope="module")
def script():
    return of_checkout("benchmarks.pages.synth")


def test_the_tables_are_made_of_what_was_measured(script):
    page = (DOCS / "synth.md").read_text(encoding="utf-8")
    for name, text in script.tables(script.measured()).items():
        assert f"<!-- {name} -->\n\n{text}\n\n<!-- end of {name} -->" in page, (
            "run: python docs/make_tables.py synth"
        )


@pytest.mark.parametrize("number", [0, 4, 19, 34])
def test_what_was_measured_is_still_so(script, number):
    """Of a few pairs, what needs no sensors; numbers may differ a little between machines."""
    stored, now = script.measured()["pairs"][number], script.measure(number, views=False)
    message = "the generator has changed; run: python docs/make_tables.py synth"
    exact = ("design", "type", "draws", "frames", "twin_frames", "twin_touches")
    for key, near in {
        **dict.fromkeys(exact, 0),
        "angle": 1.0,
        "speeds": 0.3,
        "twin_gap": 0.2,
    }.items():
        assert now[key] == pytest.approx(stored[key], abs=near), message


def test_the_page_s_code_runs(tmp_path, monkeypatch, capsys):
    code, _ = re.findall(
        r"^```python\n(.*?)^```", (DOCS / "synth.md").read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "synth.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out == "3\n"
