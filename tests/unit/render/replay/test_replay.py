"""Replays are a single page that requests nothing else, written by a function or a command."""

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
from support.expected_errors import assert_raises
from support.replay_page import accident_scenario, read_page_data

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.render import replay
from deepaccident_devkit.errors import ChoiceError, TokenError
from deepaccident_devkit.evaluation import Accident, ResultsWriter
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.replay.page import replay_page


def test_a_page_keeps_its_size_limit(
    da: DeepAccident, page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    full_size = page.stat().st_size
    assert full_size < 15_000_000
    limit = full_size - 10_000  # only the pictures would fit
    monkeypatch.setattr(sys.modules[render_replay.__module__], "SIZE_LIMIT", limit)
    assert render_replay(da, None, tmp_path / "small.html").stat().st_size <= limit


def test_the_policy_only_allows_this_script_and_style(page: Path) -> None:
    html = page.read_text(encoding="utf-8")
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    expected = {
        "default-src": "'none'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    for name, tag in (("style-src", "style"), ("script-src", "script")):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        expected[name] = f"'sha256-{digest}'"
    assert dict(rule.split(" ", 1) for rule in policy.split("; ")) == expected

    html_without_comments = re.sub(r"//.*\n", "", html)
    assert not re.search(
        r"(?:https?:)?//\w|\bsrc=|\bhref=|@import|url\(|\bon\w+=", html_without_comments
    )


def test_text_stays_text() -> None:
    malicious = "</script><script>alert(1)</script> & <!--title--> \u2028 é"
    html = replay_page(malicious, {"scenario": malicious})
    assert read_page_data(html) == {"scenario": malicious}
    assert "<title>&lt;/script&gt;&lt;script&gt;alert(1)" in html
    assert "alert(1)</script>" not in html
    assert html.count("<script") == 2


def test_unknown_scenarios_agents_and_paths_are_refused(da: DeepAccident, tmp_path: Path) -> None:
    def replay(
        scenario: str | None = None, path: Path | str = tmp_path / "no.html", **options: Any
    ) -> Callable[[], object]:
        return lambda: render_replay(da, scenario, path, **options)

    assert_raises(
        (replay("type1_subtype1_accident/nowhere"), TokenError, ("nowhere",)),
        (replay(agents=["pedestrian"]), ChoiceError, ("agent", "ego_vehicle", "pedestrian")),
        (replay(path="."), ChoiceError, ("is a folder", "such as replay.html")),
        (replay(path="r.png"), ChoiceError, ("r.png: expected a file that ends in .html, .htm",)),
    )
    assert list(tmp_path.iterdir()) == []


def test_a_release_without_an_accident_shows_its_first_scenario(
    own_release: Path, tmp_path: Path
) -> None:
    for folder in sorted(own_release.rglob("*_accident")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    default_page = render_replay(dataset, None, tmp_path / "first.html")
    first_page = render_replay(dataset, dataset.scenario[0], tmp_path / "named.html")
    assert default_page.read_bytes() == first_page.read_bytes()


def test_the_command_writes_the_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    results = tmp_path / "results.json"
    with ResultsWriter(results, "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    out = tmp_path / "replay.html"
    arguments = [
        str(da_motion.dataroot),
        accident_scenario(da_motion),
        "--out",
        str(out),
        "--results",
        str(results),
        "--agents",
        "ego_vehicle,infrastructure",
    ]

    result = CliRunner().invoke(replay, arguments)

    assert result.exit_code == 0, result.output
    assert f"wrote {out} (" in result.output
    data = read_page_data(out)
    assert [agent["name"] for agent in data["agents"]] == ["ego_vehicle", "infrastructure"]
    samples = data["prediction"]["samples"]
    verdicts = [(sample["verdict"], sample["agent"]) for sample in samples]
    assert verdicts == [("alarm", 0), ("no alarm", 0), ("alarm", 1)]
