"""Run the commands of docs/gallery.md and keep the pictures that the page shows: `python docs/make_pictures.py`.

It takes some three minutes on two cores. Pictures of web pages need chromium and the extra `test`.
"""

import os
import re
import shlex
import shutil
import tempfile
import time
from pathlib import Path

from PIL import Image
from selenium import webdriver

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.demo import SCENARIO

PAGE = Path(__file__).parent / "gallery.md"
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


def main() -> None:
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
    """Copy a picture into docs/images; where no command made it, it is that of the web page of its name."""
    made = next(folder.rglob(picture), None) or page_picture(next(folder.rglob(f"{Path(picture).stem}.html")))
    shutil.copy(made, IMAGES / picture)
    print(f"{picture}: {made.stat().st_size / 1000:.0f} kB")


def page_picture(page: Path, anchor: str = "") -> Path:
    """What a browser's window shows of a web page, from an anchor on; a replay half a second before its end."""
    options = webdriver.ChromeOptions()
    for option in ("--headless=new", "--no-sandbox", "--hide-scrollbars", f"--window-size={WINDOW}"):
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


if __name__ == "__main__":
    main()
