"""Keep pictures of the explorer's pages for docs/explore.md: `python docs/make_explore_pictures.py [RELEASE]`.

RELEASE is a folder to take in place of a new synthetic release. It takes some ten minutes on two cores, most of it for
that release. It needs chromium and the extra `test`.
"""

import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

from PIL import Image
from selenium import webdriver

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import Baseline, predict_results
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.explore import Explorer, make_app
from deepaccident_devkit.explore.serving import Served, serving
from deepaccident_devkit.synth import SynthConfig, make_release

IMAGES = Path(__file__).parent / "images"
RELEASE = SynthConfig(scenarios=6, frames=40, image_size=(480, 270), seed=2)
SELECTION = SampleSelection(split="train", scope="all")
SIZE = (1280, 720)
QUALITY = 80
WAIT = 60.0
"""Seconds for a page to be as it should."""
LOADED = "[...document.images].every((each) => each.complete)"
COMPUTED = "![...document.querySelectorAll('.waits')].length"
AT = "go(29);"


def main() -> None:
    """Make a release, two models' bundles, and a picture of each page."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        root = Path(sys.argv[1]) if len(sys.argv) > 1 else make_release(folder / "release", RELEASE, progress=True)
        dataset = DeepAccident("v1", root)
        explorer = Explorer(dataset, bundles=[bundle(dataset, folder, agents) for agents in ("single", "all")])
        explorer.begin()
        explorer.jobs.wait()
        with serving(make_app(explorer)) as served:
            keep_all(served, explorer)


def bundle(dataset: DeepAccident, folder: Path, agents: str) -> Path:
    """What the baseline predicts with these agents, evaluated."""
    name = {"single": "ego_alone", "all": "five_agents"}[agents]
    tokens = SELECTION.tokens(dataset)
    results = read_results(
        predict_results(dataset, "accident", tokens, folder / f"{name}.json", Baseline(agents=agents))
    )
    run = evaluate_results(dataset, results, EvaluationSetup(task="accident", protocol="boxes"), SELECTION)
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
        "cameras": (f"{here}/?cameras=all", f"{AT} document.getElementById('every').scrollIntoView()", LOADED),
        "twin": (f"{here}/twin", "", "[...document.querySelectorAll('iframe')].every((each) => each.contentWindow.go)"),
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
            Image.open(BytesIO(browser.get_screenshot_as_png())).convert("RGB").save(picture, quality=QUALITY)
            print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")


def until(browser: Any, ready: str) -> None:
    """Wait until an expression holds; a page that loads itself again meanwhile is waited for too."""
    end = time.monotonic() + WAIT
    while not browser.execute_script(f"return document.readyState === 'complete' && Boolean({ready})"):
        assert time.monotonic() < end, f"{browser.current_url}: waited in vain for {ready}"
        time.sleep(0.2)


if __name__ == "__main__":
    main()
