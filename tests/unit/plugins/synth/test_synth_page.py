"""docs/synth.md: its tables are what was measured, what was measured is still so, and its code runs."""

import re
from pathlib import Path

import pytest
from scripts import of_checkout

from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[4] / "docs"


@pytest.fixture(scope="module")
def script():
    return of_checkout("benchmarks.pages.synth")


def test_the_tables_are_made_of_what_was_measured(script):
    page = (DOCS / "synth.md").read_text(encoding="utf-8")
    for name, text in script.tables(script.measured()).items():
        assert f"<!-- {name} -->\n\n{text}\n\n<!-- end of {name} -->" in page, "run: python docs/make_tables.py synth"


@pytest.mark.parametrize("number", [0, 4, 19, 34])
def test_what_was_measured_is_still_so(script, number):
    """Of a few pairs, what needs no sensors; numbers may differ a little between machines."""
    stored, now = script.measured()["pairs"][number], script.measure(number, views=False)
    message = "the generator has changed; run: python docs/make_tables.py synth"
    exact = ("design", "type", "draws", "frames", "twin_frames", "twin_touches")
    for key, near in {**dict.fromkeys(exact, 0), "angle": 1.0, "speeds": 0.3, "twin_gap": 0.2}.items():
        assert now[key] == pytest.approx(stored[key], abs=near), message


def test_the_generator_keeps_its_promises(script):
    pairs = script.measured()["pairs"]
    for design in DESIGN_NUMBERS:
        of_design = [pair for pair in pairs if pair["design"] == design]
        assert [pair["type"] for pair in of_design] == [design] * script.SEEDS
        assert sum(pair["draws"] == 1 for pair in of_design) >= 0.7 * len(of_design)
    assert not any(pair["twin_touches"] or pair["twin_gap"] < 1.0 for pair in pairs)
    letters = "".join(of_agent for pair in pairs for of_agent in pair["views"].values())
    unseen = len(letters) - letters.count("v")
    assert 0.05 < unseen / len(letters) < 0.3
    assert letters.count("c") >= 0.95 * unseen


def test_a_generated_scenario_is_like_the_real_one(script):
    """Where it was moved towards it; the page says where it is not."""
    real, generated = script.measured()["real"], script.measured()["generated"]
    for key in ("distance, 50 %", "speed, median", "kB, LiDAR", "kB, calib", "points of a vehicle's cloud, mean"):
        assert generated[key] == pytest.approx(real[key], rel=0.3)
    for key in ("without points", "visible", "visible 30–50", "without points 50–70"):
        assert generated[key] == pytest.approx(real[key], abs=0.15)
    for distance in ("10–20", "20–30", "30–50"):
        assert generated[f"points on a car {distance}"] == pytest.approx(real[f"points on a car {distance}"], rel=0.35)
    assert generated["LiDAR above its vehicle"] == pytest.approx(real["LiDAR above its vehicle"], abs=0.001)
    assert (0 < generated["calib, shift"] < 3e-4, 0.05 < generated["counts that differ"] < 0.4) == (True, True)


def test_the_page_s_code_runs(tmp_path, monkeypatch, capsys):
    code, _ = re.findall(r"^```python\n(.*?)^```", (DOCS / "synth.md").read_text("utf-8"), re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "synth.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out == "3\n"
