"""Make the pictures of the pages again: `python docs/make_pictures.py [commands|explorer|drawings]…
[--release DIR]`.

`commands` runs the commands of docs/pictures.md and saves the pictures that it shows, in about
three minutes on two cores; `explorer` opens the explorer's pages, on a release that takes ten
minutes unless it is given; `drawings` are pictures that no command makes. Pictures of web pages
need chromium and the extra `test`.
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
"""Command that makes no picture."""
MADE_ELSEWHERE = ("colour_key.png",)
WINDOW = "1400,1000"
"""Width and height in pixels."""
MOVE_SCRUBBER = """
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
PAGE_TIMEOUT_S = 60.0
"""Longest wait for a page to be as it should."""
LOADED = "[...document.images].every((each) => each.complete)"
COMPUTED = "![...document.querySelectorAll('.waits')].length"
GO_TO_FRAME = "document.dispatchEvent(new CustomEvent('go', { detail: 29 }));"


@click.command(help=__doc__)
@click.argument("kinds", nargs=-1, type=click.Choice(["commands", "explorer", "drawings"]))
@click.option("--release", type=click.Path(exists=True, path_type=Path))
def main(kinds: tuple[str, ...], release: Path | None) -> None:
    """Make the named kinds of pictures, or all."""
    for kind in kinds or ("commands", "explorer", "drawings"):
        if kind == "commands":
            save_commands()
        elif kind == "explorer":
            save_explorer(release)
        else:
            from drawings import render_all

            render_all(IMAGES)


def save_commands() -> None:
    """Run the commands of the page, and save the pictures that it shows."""
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
                save_picture(picture, folder)
        os.chdir(PAGE.parent)


def make_demo(folder: Path) -> None:
    """Make the accident of `deepaccident demo`, with larger images."""
    spec = folder / "accident.yaml"
    write_bytes(spec, SCENARIO.encode())
    config = SynthConfig(scenarios=1, frames=40, seed=1, image_size=(640, 360), spec=spec)
    make_release(folder / "release", config, progress=True)


def save_picture(picture: str, folder: Path) -> None:
    """Copy a picture into docs/images; if no command made it, take a picture of the web page of the
    same name.
    """
    source = next(folder.rglob(picture), None)
    if source is None:
        page = next(folder.rglob(f"{Path(picture).stem}.html"))
        source = page_picture(page)
    shutil.copy(source, IMAGES / picture)
    print(f"{picture}: {source.stat().st_size / 1000:.0f} kB")


def page_picture(page: Path, anchor: str = "") -> Path:
    """Save what a browser's window shows of a web page, from an anchor on; a replay is shown half a
    second before its end.
    """
    options = browser_options(f"--window-size={WINDOW}")
    screenshot = page.with_suffix(".png")
    with webdriver.Chrome(options) as browser:
        browser.get(f"{page.as_uri()}#{anchor}")
        browser.execute_script(MOVE_SCRUBBER)
        time.sleep(1)  # the images are decoded
        browser.save_screenshot(str(screenshot))
    picture = page.with_suffix(".webp")
    Image.open(screenshot).convert("RGB").save(picture)
    return picture


def browser_options(option: str) -> webdriver.ChromeOptions:
    """Return the options of a browser without a window, with another one."""
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--hide-scrollbars", option):
        options.add_argument(argument)
    return options


def save_explorer(release: Path | None) -> None:
    """Make a release, two models' bundles, and a picture of each page of the explorer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        root = release or make_release(folder / "release", RELEASE, progress=True)
        dataset = DeepAccident("v1", root)
        bundles = [make_bundle(dataset, folder, agents) for agents in ("single", "all")]
        explorer = Explorer(dataset, bundles=bundles)
        explorer.begin()
        explorer.jobs.wait()
        with serving(make_app(explorer)) as served:
            save_pages(served, explorer)


def make_bundle(dataset: DeepAccident, folder: Path, agents: str) -> Path:
    """Evaluate what the baseline predicts with these agents."""
    name = {"single": "ego_alone", "all": "five_agents"}[agents]
    tokens = SELECTION.tokens(dataset)
    baseline = Baseline(agents=agents)
    path = predict_results(dataset, "accident", tokens, folder / f"{name}.json", baseline)
    setup = EvaluationSetup(task="accident", protocol="boxes")
    run = evaluate_results(dataset, read_results(path), setup, SELECTION)
    return save_run(run.broken_down(), folder / name, include_results=True)


def save_pages(served: Served, explorer: Explorer) -> None:
    """Open each page and save what the window shows."""
    accident = explorer.dataset.find(collision=True)[0]["token"]
    scores = explorer.models["ego_alone"].scores
    assert scores is not None
    worst = quote(next(iter(scores.samples)))
    scenario = f"scenario/{quote(accident)}"
    pages = {
        "scenarios": ("?sort=min_ttc", "", LOADED),
        "table": ("?view=table&sort=lead&order=down&q=length%3E%3D40%3B+min_ttc%3C2", "", COMPUTED),
        "scenario": (f"{scenario}/", GO_TO_FRAME, LOADED),
        "cameras": (
            f"{scenario}/?cameras=all",
            f"{GO_TO_FRAME} document.getElementById('every').scrollIntoView()",
            LOADED,
        ),
        "twin": (
            f"{scenario}/twin",
            "",
            "[...document.querySelectorAll('iframe')].every((each) => each.contentDocument.querySelector('canvas[data-view]'))",
        ),
        "moment": (f"{scenario}/moment/ego_vehicle/30", "", "document.images[0].naturalWidth"),
        "model": ("model/ego_alone/", "", COMPUTED),
        "sample": (f"model/ego_alone/sample/{worst}", "", LOADED),
        "compare": ("compare/ego_alone/five_agents/", "", COMPUTED),
        "compare_sample": (f"compare/ego_alone/five_agents/sample/{worst}", "", LOADED),
        "release": ("release/", "", COMPUTED),
    }
    with webdriver.Chrome(browser_options("--disable-gpu")) as browser:
        size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(served.url)
        for name, (address, script, ready) in pages.items():
            browser.get(f"{served.origin}/{address}")
            wait_until(browser, ready)
            browser.execute_script(script)
            time.sleep(2)  # pictures that the script asked for, and twins in step
            wait_until(browser, ready)
            picture = IMAGES / f"explore_{name}.webp"
            screenshot = Image.open(BytesIO(browser.get_screenshot_as_png()))
            screenshot.convert("RGB").save(picture, quality=QUALITY)
            print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")


def wait_until(browser: Any, ready: str) -> None:
    """Wait until an expression holds, even if the page loads itself again meanwhile."""
    end = time.monotonic() + PAGE_TIMEOUT_S
    script = f"return document.readyState === 'complete' && Boolean({ready})"
    while not browser.execute_script(script):
        assert time.monotonic() < end, f"{browser.current_url}: waited in vain for {ready}"
        time.sleep(0.2)


if __name__ == "__main__":
    sys.path.insert(0, str(PAGE.parents[1]))
    main()
