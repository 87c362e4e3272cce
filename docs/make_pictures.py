"""Make the pictures of the pages again: `python docs/make_pictures.py [commands|explorer|drawings]…
[--release DIR]`.

`commands` runs those of docs/pictures.md and keeps what it shows, in some three minutes on two
cores; `explorer` opens the explorer's pages, on a release that takes ten minutes unless it is
given; `drawings` are pictures that no command makes. Pictures of web pages need chromium and the
extra `test`.
"""

import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import click
from PIL import Image
from selenium import webdriver

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.plugins.explore.serving import Served, serving
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.demo import SCENARIO
from deepaccident_devkit.support.files import write_bytes

PAGE = Path(__file__).parent / "pictures.md"
IMAGES = PAGE.parent / "images"
COMMAND = re.compile(r"^(?: {4})?deepaccident (\S.*)$", re.MULTILINE)
PICTURE = re.compile(r"\]\(images/(\S+)\)")
NOT_RUN = "export mcap"
"""It makes no picture."""
MADE_ELSEWHERE = ("colour_key.png",)
WINDOW = "1400,1000"
"""Pixels."""
MOVE_ON = """
const scrubber = document.querySelector('input[type=range]');
if (scrubber) {
  scrubber.value = scrubber.max - 5;
  scrubber.dispatchEvent(new Event('input'));
}
"""
RELEASE = SynthConfig(scenarios=6, frames=40, image_size=(480, 270), seed=2, designed=True)
SELECTION = SampleSelection(split="train", scope="all")
SIZE = (1280, 720)
QUALITY = 80
WAIT = 60.0
"""Seconds for a page to be as it should."""
LOADED = "[...document.images].every((each) => each.complete)"
COMPUTED = "![...document.querySelectorAll('.waits')].length"
AT = "document.dispatchEvent(new CustomEvent('go', { detail: 29 }));"


@click.command(help=__doc__)
@click.argument("kinds", nargs=-1, type=click.Choice(["commands", "explorer", "drawings"]))
@click.option("--release", type=click.Path(exists=True, path_type=Path))
def main(kinds: tuple[str, ...], release: Path | None) -> None:
    """Make what is named, or all."""
    for kind in kinds or ("commands", "explorer", "drawings"):
        if kind == "commands":
            keep_commands()
        elif kind == "explorer":
            keep_explorer(release)
        else:
            from drawings import render_all

            render_all(IMAGES)


def keep_commands() -> None:
    """Run the commands of the page, and keep the pictures that it shows."""
    text = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chdir(folder)
        make_demo(folder / "deepaccident_demo")
        for line in COMMAND.findall(text):
            if not line.startswith(NOT_RUN):
                print(f"deepaccident {line}")
                deepaccident.main(shlex.split(line), standalone_mode=False)
        for picture in PICTURE.findall(text):
            if picture not in MADE_ELSEWHERE:
                keep(picture, folder)
        os.chdir(PAGE.parent)


def make_demo(folder: Path) -> None:
    """The accident of `deepaccident demo`, with larger images."""
    spec = folder / "accident.yaml"
    write_bytes(spec, SCENARIO.encode())
    config = SynthConfig(scenarios=1, frames=40, seed=1, image_size=(640, 360), spec=spec)
    make_release(folder / "release", config, progress=True)


def keep(picture: str, folder: Path) -> None:
    """Copy a picture into docs/images; where no command made it, it is that of the web page of its
    name.
    """
    made = next(folder.rglob(picture), None) or page_picture(
        next(folder.rglob(f"{Path(picture).stem}.html"))
    )
    shutil.copy(made, IMAGES / picture)
    print(f"{picture}: {made.stat().st_size / 1000:.0f} kB")


def page_picture(page: Path, anchor: str = "") -> Path:
    """What a browser's window shows of a web page, from an anchor on; a replay half a second before
    its end.
    """
    options = webdriver.ChromeOptions()
    for option in (
        "--headless=new",
        "--no-sandbox",
        "--hide-scrollbars",
        f"--window-size={WINDOW}",
    ):
        options.add_argument(option)
    shot = page.with_suffix(".png")
    with webdriver.Chrome(options) as browser:
        browser.get(f"{page.as_uri()}#{anchor}")
        browser.execute_script(MOVE_ON)
        time.sleep(1)  # the images are decoded
        browser.save_screenshot(str(shot))
    picture = page.with_suffix(".webp")
    Image.open(shot).convert("RGB").save(picture)
    return picture


def keep_explorer(given: Path | None) -> None:
    """Make a release, two models' bundles, and a picture of each page of the explorer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset = DeepAccident(
            "v1", given or make_release(folder / "release", RELEASE, progress=True)
        )
        explorer = Explorer(
            dataset, bundles=[bundle(dataset, folder, agents) for agents in ("single", "all")]
        )
        explorer.begin()
        explorer.jobs.wait()
        with serving(make_app(explorer)) as served:
            keep_all(served, explorer)


def bundle(dataset: DeepAccident, folder: Path, agents: str) -> Path:
    """What the baseline predicts with these agents, evaluated."""
    name = {"single": "ego_alone", "all": "five_agents"}[agents]
    tokens = SELECTION.tokens(dataset)
    results = read_results(
        predict_results(
            dataset, "accident", tokens, folder / f"{name}.json", Baseline(agents=agents)
        )
    )
    run = evaluate_results(
        dataset, results, EvaluationSetup(task="accident", protocol="boxes"), SELECTION
    )
    return save_run(run.broken_down(), folder / name, include_results=True)


def keep_all(served: Served, explorer: Explorer) -> None:
    """Open each page and keep what the window shows."""
    accident = explorer.dataset.find(collision=True)[0]["token"]
    scores = explorer.models["ego_alone"].scores
    assert scores is not None
    worst = quote(next(iter(scores.samples)))
    here = f"scenario/{quote(accident)}"
    pages: dict[str, tuple[str, str, str]] = {
        "scenarios": ("?sort=min_ttc", "", LOADED),
        "table": ("?view=table&sort=lead&order=down&q=length%3E%3D40%3B+min_ttc%3C2", "", COMPUTED),
        "scenario": (f"{here}/", AT, LOADED),
        "cameras": (
            f"{here}/?cameras=all",
            f"{AT} document.getElementById('every').scrollIntoView()",
            LOADED,
        ),
        "twin": (
            f"{here}/twin",
            "",
            "[...document.querySelectorAll('iframe')].every((each) => each.contentWindow.go)",
        ),
        "moment": (f"{here}/moment/ego_vehicle/30", "", "document.images[0].naturalWidth"),
        "model": ("model/ego_alone/", "", COMPUTED),
        "sample": (f"model/ego_alone/sample/{worst}", "", LOADED),
        "compare": ("compare/ego_alone/five_agents/", "", COMPUTED),
        "compare_sample": (f"compare/ego_alone/five_agents/sample/{worst}", "", LOADED),
        "release": ("release/", "", COMPUTED),
    }
    options = webdriver.ChromeOptions()
    for option in ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--disable-gpu"):
        options.add_argument(option)
    with webdriver.Chrome(options) as browser:
        size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(served.url)
        for name, (address, script, ready) in pages.items():
            browser.get(f"{served.origin}/{address}")
            until(browser, ready)
            browser.execute_script(script)
            time.sleep(2)  # pictures that the script asked for, and twins in step
            until(browser, ready)
            picture = IMAGES / f"explore_{name}.webp"
            Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB").save(
                picture, quality=QUALITY
            )
            print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")


def until(browser: Any, ready: str) -> None:
    """Wait until an expression holds; a page that loads itself again meanwhile is waited for
    too.
    """
    end = time.monotonic() + WAIT
    while not browser.execute_script(
        f"return document.readyState === 'complete' && Boolean({ready})"
    ):
        assert time.monotonic() < end, f"{browser.current_url}: waited in vain for {ready}"
        time.sleep(0.2)


if __name__ == "__main__":
    sys.path.insert(0, str(PAGE.parents[1]))
    main()
