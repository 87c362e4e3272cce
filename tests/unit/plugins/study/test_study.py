"""Every default and constant of studies, against what is written out here."""

from written_out import written_out

WRITTEN = {
    "cells.Bench": "device='cpu'",
    "numbers.DETECTION_RADIUS": "2.0",
    "numbers.LEAST_BOX_SCORE": "0.1",
    "numbers.HIDDEN": "'hidden'",
    "numbers.RESAMPLING": "Resampling(resamples=1000, confidence=0.95, seed=0)",
    "numbers.setups_of": "horizon=2.0",
    "numbers.numbers_of_rows": "less=None",
    "page.PAGE_FILE": "'index.html'",
    "plugin.PLUGIN": "Plugin('study')",
    "recipe.DEFAULT_HORIZON": "2.0",
    "recipe.MOST_ROWS": "1000",
    "recipe.NUSCENES": "'nuscenes'",
    "recipe.read_recipe": "smoke=False",
    "run.run_study": "device='auto'",
    "summary.ALL": "'all samples'",
    "summary.MAIN": "('apa', 'iou_100', 'map', 'hidden_foreground')",
}


def test_what_is_written_out() -> None:
    found = written_out("deepaccident_devkit.plugins.study")
    assert {name: words for name, words in found.items() if name != "recipe.SHIPPED_RECIPES"} == WRITTEN
