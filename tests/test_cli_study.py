"""`deepaccident study` as users call it, of baselines alone; tests/torch_extra/study has those that
train.
"""

import json
from pathlib import Path

from studies import BASELINES, written
from verbs import called

from deepaccident_devkit import DeepAccident


def test_a_study_of_baselines(da: DeepAccident, tmp_path: Path) -> None:
    releases = {"test": {"dataroot": str(da.dataroot)}}
    test = {"release": "test", "samples": "all"}
    small = {
        "rows": BASELINES["rows"][:1],
        "compare": [],
        "groups": {"accidents": ["collision=true"]},
    }
    rows = [*BASELINES["rows"][:1], {"name": "nothing", "trivial": "nothing"}]
    recipe = {
        **BASELINES,
        **small,
        "releases": releases,
        "test": test,
        "rows": rows,
        "smoke": small,
    }
    path, out = written(tmp_path, recipe), tmp_path / "out"
    told = called("study", path, out, "--workers", "1", "--style", "cvpr-column").output
    assert f"written: {out / 'mine'}; open {out / 'mine' / 'index.html'} in a browser" in told
    assert (
        "Among `accidents`: it is not decided whether `sees all` has more IoU "
        "100x100 (%) than `sees single`" in told
    )
    assert {line.split("  ")[0] for line in told.splitlines()} > {
        "sees single",
        "sees all",
        "nothing",
    }
    assert (out / "mine" / "figures" / "rows.pdf").is_file()
    summary = json.loads((out / "mine" / "study.json").read_text(encoding="utf-8"))
    assert list(summary["rows"]) == ["sees single", "sees all", "nothing"]
    before = {cell.name for cell in (out / "row").iterdir()}
    called("study", path, out, "--smoke", "--workers", "2")
    assert {cell.name for cell in (out / "row").iterdir()} == before
    assert list(json.loads((out / "mine-smoke" / "study.json").read_text())["rows"]) == [
        "sees single",
        "sees all",
    ]
