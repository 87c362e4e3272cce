"""Scenarios of Argoverse 2 hold the windows of samples."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.tiny_release import SCENARIO_TOKEN, label_lines, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError
from deepaccident_devkit.export.av2 import Av2
from deepaccident_devkit.export.bulk import export_release

SAMPLE = f"{SCENARIO_TOKEN}/ego_vehicle/002"


def lines_with_passers_by(agent: str, frame: int) -> list[str]:
    """Add a cyclist who leaves, and a motorcycle and a pedestrian who come later."""
    lines = label_lines(agent, frame)
    if frame < 4:
        lines.append("cyclist 5.0 2.0 -1.0 1.8 0.5 1.6 0.0 0.0 0.0 1400 9 True")
    if frame > 2:
        lines.append("motorcycle 9.0 2.0 -1.0 2.0 0.8 1.6 0.0 0.0 0.0 1401 9 True")
    if frame > 1:
        lines.append("pedestrian 7.0 4.0 -1.0 0.4 0.4 1.8 0.0 0.0 0.0 1402 9 True")
    return lines


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = tmp_path_factory.mktemp("tiny") / "release"
    write_tiny_release(root, frames=4, lines_of=lines_with_passers_by)
    return DeepAccident("v1", root, verbose=False)


def read_rows(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    return rows


def test_rows_are_the_valid_cells_of_a_window(tiny: DeepAccident, tmp_path: Path) -> None:
    window = tiny.window(SAMPLE, past=0.3, future=0.2, frame="world", actors="any")
    path = window.write_av2(tmp_path / "scenario_a.parquet")
    rows = read_rows(path)

    tracks: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        tracks.setdefault(row["track_id"], []).append(row)
    # The own vehicle is 1223; the steps 0 and 1 are before the recording.
    described = {}
    for track, states in tracks.items():
        (state,) = {(state["object_type"], state["object_category"]) for state in states}
        described[track] = [*state, [row["timestep"] for row in states]]
    assert described["1223"] == ["vehicle", 3, [2, 3, 4, 5]]
    assert described["1300"] == ["vehicle", 2, [2, 3, 4, 5]]
    assert described["1400"] == ["cyclist", 1, [2, 3, 4]]
    assert described["1401"] == ["motorcyclist", 0, [4, 5]]
    assert described["1402"] == ["pedestrian", 2, [3, 4, 5]]
    assert "-1" not in tracks

    van = tracks["1300"]
    assert [row["observed"] for row in van] == [True, True, False, False]
    assert [row["position_x"] for row in van] == pytest.approx([20.2, 20.4, 20.6, 20.8])
    assert [row["position_y"] for row in van] == pytest.approx([-3.0] * 4)
    assert [row["velocity_x"] for row in van] == pytest.approx([2.0] * 4)
    assert {(row["scenario_id"], row["city"], row["focal_track_id"]) for row in rows} == {
        (SAMPLE, "Town03", "1223")
    }
    times = {(row["start_timestamp"], row["end_timestamp"]) for row in rows}
    assert times == {(-200_000_000, 300_000_000)}
    assert {row["num_timestamps"] for row in rows} == {6}


@pytest.mark.parametrize("focal", [1300, "1300", f"{SCENARIO_TOKEN}/actor/1300"])
def test_a_focal_track_by_id_or_token(tiny: DeepAccident, tmp_path: Path, focal: Any) -> None:
    window = tiny.window(SAMPLE, past=0, future=0, frame="world")
    rows = read_rows(window.write_av2(tmp_path / "a.parquet", focal=focal))
    assert {row["track_id"] for row in rows if row["object_category"] == 3} == {"1300"}


def test_windows_that_are_no_scenario(tiny: DeepAccident, tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    window = tiny.window(SAMPLE, frame="world")
    pole = tiny.window(f"{SCENARIO_TOKEN}/infrastructure/002", frame="world")
    assert_raises(
        (lambda: tiny.window(SAMPLE).write_av2(path), ConfigError, "frame='world'"),
        (lambda: window.write_av2(path, focal=7), ChoiceError, "expected one of .*1300.*found 7"),
        (lambda: pole.write_av2(path), ChoiceError, "no vehicle of its own; choose one of .*1300"),
    )
    assert not path.exists()


def test_a_window_without_actors_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "release"
    write_tiny_release(root, agents=("infrastructure",), lines_of=lambda *_: ["0.0 0.0"])
    dataset = DeepAccident("v1", root, verbose=False)
    window = dataset.window(dataset.sample[0], frame="world")
    with pytest.raises(NotAvailableError, match="no actors"):
        window.write_av2(tmp_path / "a.parquet")


def test_the_command_writes_a_file_for_each_sample(tiny: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ("export", "av2", tiny.dataroot, "--out", out, "--workers", 1)
    options = ("--past", 0.2, "--future", 0.1, "--every", 0.2)
    text = invoke_command(*command, *options, "--agents", "ego_vehicle,infrastructure").output

    folder = out / SCENARIO_TOKEN.replace("/", "__") / "ego_vehicle"
    name = SCENARIO_TOKEN.replace("/", "__") + "__ego_vehicle"
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.parquet"))
    assert files == [f"{number}/scenario_{name}__{number}.parquet" for number in ("002", "004")]
    assert "excluded: samples of agents without a track of their own (2)" in text
    window = tiny.window(SAMPLE, past=0.2, future=0.1, frame="world")
    written = window.write_av2(tmp_path / "a.parquet")
    assert pq.read_table(folder / files[0]).equals(pq.read_table(written))
    assert json.loads((out / "av2.manifest.json").read_text())["settings"]["past"] == 0.2
    assert "load_argoverse_scenario_parquet" in (out / "README.md").read_text()


def test_samples_without_labels_are_refused(
    unlabelled_dataset: DeepAccident, tmp_path: Path
) -> None:
    with pytest.raises(NotAvailableError, match="is a vehicle with labels"):
        export_release(unlabelled_dataset, tmp_path / "out", Av2(), workers=1)


@pytest.mark.parametrize(
    "settings",
    [
        {"every": 0},
        {"every": 0.25},
        {"every": float("nan")},
        {"every": True},
        {"past": 0.25},
        {"future": -1},
        {"past": float("inf")},
    ],
)
def test_times_that_do_not_fit(settings: dict[str, Any]) -> None:
    (name,) = settings
    with pytest.raises(ConfigError, match=f"^{name}: "):
        Av2(**settings)
