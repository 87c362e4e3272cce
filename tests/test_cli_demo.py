"""`deepaccident demo`: what it makes, when it refuses, and whether the crash can be foreseen."""

import importlib
import json
import re
import shlex
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.report_page import read_report

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth import make_release

demo: Any = importlib.import_module("deepaccident_devkit.plugins.synth.demo")


def run(*words: str) -> str:
    result = invoke_command(*words)
    assert result.stderr == "" or words[0] != "demo"  # no progress bar without a terminal
    return result.output


def modification_times(folder: Path) -> dict[Path, int]:
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path: path.stat().st_mtime_ns for path in paths}


@pytest.mark.slow
def test_the_page_shows_all_that_was_made(made_demo: tuple[Path, str]) -> None:
    out, _ = made_demo
    page = read_report(out / "index.html")
    pictures = [str(image["src"]) for image in page.all("img")]
    links = [str(link["href"]) for link in page.all("a")]
    own_links = {link for link in links if link.startswith("#")}

    assert sorted(pictures) == sorted(path.name for path in out.glob("*.png"))
    assert len(pictures) == 4 + (find_spec("torch") is not None)
    assert [name for name in pictures if (out / name).stat().st_size <= 20_000] == []
    frames = [frame["src"] for frame in page.all("iframe")]
    assert frames == ["replay.html", "evaluation/report.html"]
    assert [link for link in links if link not in own_links and not (out / link).is_file()] == []
    assert {link[1:] for link in own_links} == {
        section.get("id") for section in page.all("section")
    }
    ((single, five),) = re.findall(
        r"single vehiclefive agents\s*IoU \(%\)(\d+\.\d)(\d+\.\d)", page.text
    )
    assert float(five) > float(single)


@pytest.mark.slow
def test_the_next_steps_run_as_they_are_printed(
    made_demo: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    served_pages: list[object] = []
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.explore.serving.serve",
        lambda _, **options: served_pages.append(options["page"]),
    )
    out, output = made_demo
    assert f"Open {out / 'index.html'} in a browser" in output.splitlines()[-1]
    steps = re.findall(r"^\[(\d/7)\] (\w+) [\w ]+ \(about \d+ s\)$", output, re.MULTILINE)
    assert steps[::3] == [("1/7", "Recording"), ("4/7", "Predicting"), ("7/7", "Writing")]
    assert "\r" not in output
    assert "  100 % recorded\n[2/7] " in output
    commands = re.findall(r"^ +deepaccident (.+)$", output, re.MULTILINE)
    assert len(commands) == 6
    page = read_report(out / "index.html").text
    for command in commands:
        assert f"deepaccident {command}" in page
        for part in command.split(" && deepaccident "):
            run(*shlex.split(part))
    # the table, the report and the fifth step evaluate the same samples
    ((single, five),) = re.findall(r"\bAPA(\d\.\d{3})(\d\.\d{3})", page)
    for bundle, apa in (("evaluation/single_vehicle", single), ("five_agents/evaluation", five)):
        summary = json.loads((out / bundle / "metrics_summary.json").read_bytes())
        assert f"{summary['metrics']['apa']:.3f}" == apa
    assert served_pages == ["model/single_vehicle/"]  # with its verdicts


@pytest.mark.slow
def test_another_demo_keeps_the_release_and_the_readers_files(made_demo: tuple[Path, str]) -> None:
    out, _ = made_demo
    (out / "notes.txt").write_text("mine")
    before = modification_times(out)

    (out / "replay.html").unlink()
    run("demo", str(out))

    after = modification_times(out)
    unchanged = {path.relative_to(out).parts[0] for path in before if before[path] == after[path]}
    assert {"release", "accident.yaml", "notes.txt"} <= unchanged
    assert unchanged.isdisjoint({"index.html", "countdown.png", "single_vehicle.json"})


@pytest.mark.parametrize("name", ["notes.txt", "index.html", "release", ".deepaccident_demo"])
def test_a_folder_of_somebody_else_is_refused(name: str, tmp_path: Path) -> None:
    """The last file comes from a demo of another version; its page would not fit."""
    (tmp_path / name).write_text("0.0.1\n")
    message = ("was not made by the demo of version ", " deepaccident demo OTHER_FOLDER")
    assert_raises(
        (lambda: run("demo", str(tmp_path)), ConfigError, message),
        (
            lambda: run("demo", str(tmp_path / name)),
            ConfigError,
            (f"{name}: already exists, and was not made",),
        ),
    )
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "0.0.1\n")]


@pytest.mark.slow
def test_ego_sees_the_crash_coming_and_five_agents_see_it_earlier(tmp_path: Path) -> None:
    (tmp_path / "accident.yaml").write_text(demo.SCENARIO)
    config = replace(demo.RELEASE, scenarios=1, sensors=False, spec=tmp_path / "accident.yaml")
    da = DeepAccident(dataroot=make_release(tmp_path / "release", config, workers=1), verbose=False)
    (accident,) = da.scenario
    assert (accident["weather"], accident["time_of_day"]) == ("Clear", "Noon")
    collider = da.agent.get(f"{accident['token']}/other_vehicle")["actor_id"]

    def in_view(tenths: int) -> bool:
        boxes = da.boxes(da.get_sample(accident, "ego_vehicle", frame=40 - tenths), "ego")
        (other,) = boxes.select(boxes.actor_id == collider)
        bearing = np.degrees(np.arctan2(other.center[1], other.center[0]))
        # the front camera sees 35 degrees to each side
        return bool(other.camera_visible) and abs(bearing) < 30

    assert all(map(in_view, range(1, 21)))
    assert not any(map(in_view, range(27, 36)))

    heading, *lines = demo.demo_table(da)
    single, five = (dict(zip(heading[1:], map(float, line[1:]), strict=True)) for line in lines)
    # the single vehicle sees the collider late, and misses the accident in the first samples
    assert 0.5 < single["recall"] < five["recall"] == 1
    assert five["IoU (%)"] > single["IoU (%)"] + 10
    assert [name for name in ("VPQ (%)", "APA", "mAP (%)") if five[name] <= single[name]] == []
    assert single["precision"] == five["precision"] == 1
