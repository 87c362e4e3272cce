"""Replays: one page that asks for nothing else, and the command that writes it."""

import base64
import hashlib
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from refusals import assert_refused
from replay_page import accident, data_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.render import replay
from deepaccident_devkit.errors import ChoiceError, TokenError
from deepaccident_devkit.evaluation import Accident, ResultsWriter
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.replay.page import replay_page


def test_a_page_keeps_its_limit(
    da: DeepAccident, page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = page.stat().st_size
    assert whole < 15_000_000
    monkeypatch.setattr(
        sys.modules[render_replay.__module__], "SIZE_LIMIT", whole - 10_000
    )  # its pictures would fit
    assert render_replay(da, None, tmp_path / "small.html").stat().st_size <= whole - 10_000


def test_the_policy_allows_this_script_and_style_alone(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    expected = {
        "default-src": "'none'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    for name, tag in (("style-src", "style"), ("script-src", "script")):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        expected[name] = f"'sha256-{digest}'"
    assert dict(rule.split(" ", 1) for rule in policy.split("; ")) == expected
    assert not re.search(
        r"(?:https?:)?//\w|\bsrc=|\bhref=|@import|url\(|\bon\w+=", re.sub(r"//.*\n", "", text)
    )


def test_text_stays_text() -> None:
    wild = "</script><script>alert(1)</script> & <!--title--> \u2028 é"
    text = replay_page(wild, {"scenario": wild})
    assert data_of(text) == {"scenario": wild}
    assert "<title>&lt;/script&gt;&lt;script&gt;alert(1)" in text
    assert ("alert(1)</script>" in text, text.count("<script")) == (False, 2)


def test_what_cannot_be_is_refused(da: DeepAccident, tmp_path: Path) -> None:
    def replay(
        scenario: str | None = None, path: Path | str = tmp_path / "no.html", **how: Any
    ) -> Callable[[], object]:
        return lambda: render_replay(da, scenario, path, **how)

    assert_refused(
        (replay("type1_subtype1_accident/nowhere"), TokenError, ("nowhere",)),
        (replay(agents=["pedestrian"]), ChoiceError, ("agent", "ego_vehicle", "pedestrian")),
        (replay(path="."), ChoiceError, ("is a folder", "such as replay.html")),
    )
    assert list(tmp_path.iterdir()) == []


def test_a_release_without_an_accident_shows_its_first_scenario(
    own_release: Path, tmp_path: Path
) -> None:
    for folder in sorted(own_release.rglob("*_accident")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    page = render_replay(dataset, None, tmp_path / "first.html")
    assert (
        page.read_bytes()
        == render_replay(dataset, dataset.scenario[0], tmp_path / "named.html").read_bytes()
    )


def test_the_command_writes_the_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    results, out = tmp_path / "results.json", tmp_path / "replay.html"
    with ResultsWriter(results, "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    options = [
        "--out",
        str(out),
        "--results",
        str(results),
        "--agents",
        "ego_vehicle,infrastructure",
    ]
    ran = CliRunner().invoke(replay, [str(da_motion.dataroot), accident(da_motion), *options])
    assert (ran.exit_code, f"written: {out}, " in ran.output) == (0, True), ran.output
    data = data_of(out)
    assert [agent["name"] for agent in data["agents"]] == ["ego_vehicle", "infrastructure"]
    judged = [(each["verdict"], each["agent"]) for each in data["prediction"]["samples"]]
    assert judged == [("TP", 0), ("FP + FN", 0), ("FN", 0), ("4 FP + FN", 1)]
