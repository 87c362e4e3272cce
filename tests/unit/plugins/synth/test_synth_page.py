"""docs/synth.md: its tables show what was measured, a new measurement agrees, and its code runs."""

import re
from pathlib import Path

import pytest
from support.repository_scripts import import_from_checkout

from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[4] / "docs"


@pytest.fixture(scope="module")
def script():
    return import_from_checkout("benchmarks.pages.synth")


def test_the_texts_are_made_of_what_was_measured(script):
    page = (DOCS / "synth.md").read_text(encoding="utf-8")

    for name, text in script.texts(script.measured()).items():
        assert f"<!-- {name} -->\n\n{text}\n\n<!-- end of {name} -->" in page, (
            "run: python docs/make_tables.py synth"
        )


def test_what_the_page_says_of_all_designed_accidents_was_measured(script):
    pairs = script.measured()["pairs"]

    assert {pair["design"] for pair in pairs} == set(DESIGN_NUMBERS)
    for pair in pairs:
        assert pair["draws"] == 1
        assert pair["type"] == pair["design"]
        assert not pair["twin_touches"]
        assert pair["twin_gap"] > 1.0
        assert "u" not in "".join(pair["views"].values())


def test_all_facts_agree_as_the_page_says(script):
    page = (DOCS / "synth.md").read_text(encoding="utf-8")
    facts = script.measured()["facts"]

    names = [script.fact_name(fact) for fact in script.FACTS if fact.source]
    assert list(facts["values"]) == names
    assert {fact["verdict"] for fact in facts["values"].values()} == {"agree"}
    assert f"{facts['scenarios']} generated scenarios agree with all {len(names)} [facts" in page


@pytest.mark.parametrize("number", [0, 4, 19, 34])
def test_a_new_measurement_agrees(script, number):
    """A few pairs, without sensors; numbers may differ a little between machines."""
    stored = script.measured()["pairs"][number]
    measured = script.measure(number, views=False)

    exact = ("design", "type", "draws", "frames", "twin_frames", "twin_touches")
    tolerances = {**dict.fromkeys(exact, 0), "angle": 1.0, "speeds": 0.3, "twin_gap": 0.2}
    for key, tolerance in tolerances.items():
        assert measured[key] == pytest.approx(stored[key], abs=tolerance), (
            "the generator has changed; run: python docs/make_tables.py synth"
        )


def test_the_page_s_code_runs(tmp_path, monkeypatch, capsys):
    page = (DOCS / "synth.md").read_text("utf-8")
    code, _ = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "synth.md", "exec"), {})  # noqa: S102

    assert capsys.readouterr().out == "3\n"
