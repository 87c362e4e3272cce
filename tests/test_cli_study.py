"""`deepaccident study` of baselines; tests/torch_extra/study has the studies that train."""

import json
from pathlib import Path

from support.command_calls import invoke_command
from support.study_recipes import BASELINE_RECIPE, write_recipe

from deepaccident_devkit import DeepAccident


def test_a_study_of_baselines(da: DeepAccident, tmp_path: Path) -> None:
    first_rows = BASELINE_RECIPE["rows"][:1]
    smoke = {
        "rows": first_rows,
        "compare": [],
        "groups": {"accidents": ["collision=true"]},
    }
    recipe = {
        **BASELINE_RECIPE,
        **smoke,
        "releases": {"test": {"dataroot": str(da.dataroot)}},
        "test": {"release": "test", "samples": "all"},
        "rows": [*first_rows, {"name": "nothing", "trivial": "nothing"}],
        "smoke": smoke,
    }
    path, out = write_recipe(tmp_path, recipe), tmp_path / "out"
    folder = out / "mine"

    output = invoke_command("study", path, out, "--workers", "1", "--style", "cvpr-column").output

    assert f"wrote {folder}; open {folder / 'index.html'} in a browser" in output
    assert (
        "Among `accidents`: no significant difference in IoU, 100 m × 100 m (%) between "
        "`sees all` and `sees single`" in output
    )
    first_cells = {line.split("  ")[0] for line in output.splitlines()}
    assert first_cells > {"sees single", "sees all", "nothing"}
    assert (folder / "figures" / "rows.pdf").is_file()
    summary = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    assert list(summary["rows"]) == ["sees single", "sees all", "nothing"]

    names = {cell.name for cell in (out / "row").iterdir()}
    invoke_command("study", path, out, "--smoke", "--workers", "2")
    assert {cell.name for cell in (out / "row").iterdir()} == names
    summary = json.loads((out / "mine-smoke" / "study.json").read_text())
    assert list(summary["rows"]) == ["sees single", "sees all"]
