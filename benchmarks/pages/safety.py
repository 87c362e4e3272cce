"""What the commands of docs/safety.md print, and its pictures, of which that of the report needs
chromium.
"""

import os
import re
import shlex
import tempfile
from collections.abc import Callable
from itertools import dropwhile, takewhile
from pathlib import Path
from textwrap import fill

from click.testing import CliRunner
from PIL import Image

from benchmarks.pages.marks import DOCS
from deepaccident_devkit.cli import deepaccident

PAGE = DOCS / "safety.md"
IMAGES = PAGE.parent / "images"
RELEASE, OUT = "accidents", "out"
"""What DATAROOT and OUT on the page are here."""
PIECE = re.compile(
    r"^ {4}deepaccident (?P<command>\S[^\n]*)$|^<!-- output -->$.*?^<!-- end of output -->$",
    re.MULTILINE | re.DOTALL,
)
PICTURES = {
    "safety_lead_times.webp": "lead_times.png",
    "safety_avoidability.webp": "avoidability_vehicles.png",
    "safety_report.webp": "report.html",
}
"""Picture on the page → the file in OUT that it shows."""
WIDTH, LINE = 1200, 118
"""Pixels of a figure; letters of a line of prose."""
SHOWN = 3
"""Rows of a long table that the page has."""


def main(release: Path | None = None) -> None:
    """Write the outputs and the pictures; a release is one that the page's first command made."""
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        if release is not None:
            Path(RELEASE).symlink_to(release.resolve(), target_is_directory=True)
        page = with_outputs(PAGE.read_text(encoding="utf-8"), made=release is not None)
        for picture, source in PICTURES.items():
            keep(Path(OUT, source), IMAGES / picture)
        os.chdir(PAGE.parent)
    PAGE.write_text(page, encoding="utf-8")


def with_outputs(page: str, *, made: bool = False) -> str:
    """The page with what its commands print now, run in their order in the working folder; `made`:
    the release is.
    """
    printed = ""

    def replaced(piece: re.Match[str]) -> str:
        nonlocal printed
        command = piece["command"]
        if command is None:
            return f"<!-- output -->\n```text\n{printed}\n```\n<!-- end of output -->"
        if not (made and command.startswith("synth ")):
            printed = output(command)
        return piece[0]

    return PIECE.sub(replaced, page)


def output(command: str) -> str:
    """What a command prints of which the page has the output, cut to what it shows."""
    words = [{"DATAROOT": RELEASE, "OUT": OUT}.get(word, word) for word in shlex.split(command)]
    print(f"deepaccident {shlex.join(words)}", flush=True)
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    if result.exit_code:
        raise SystemExit(f"{command}: {result.output}")
    text = result.stdout.replace(f"{Path.cwd()}/", "").replace(
        f"{Path(RELEASE).resolve()}", RELEASE
    )
    cut = next((each for name, each in CUTS.items() if f" {name} " in f" {command} "), str)
    return cut(text).rstrip()


def fewer_rows(text: str) -> str:
    """Without the rows of accidents after the first ones."""
    lines: list[str] = []
    rows = 0
    for line in text.splitlines():
        rows += line.startswith("type")
        if rows <= SHOWN or not line.startswith("type"):
            lines.append(line)
        elif rows == SHOWN + 1:
            lines.append("…")
    return "\n".join(lines)


def one_story(text: str) -> str:
    """The first scenario and its story."""
    scenario, story = text.splitlines()[:2]
    indent = story[: len(story) - len(story.lstrip())]
    return "\n".join(
        [scenario, fill(story.strip(), LINE, initial_indent=indent, subsequent_indent=indent), "…"]
    )


def paragraph(begin: str) -> Callable[[str], str]:
    """A function that takes the lines from the one that begins so, or from the first, to the next
    empty one.
    """

    def found(text: str) -> str:
        lines = text.splitlines()
        first, *rest = [*dropwhile(lambda line: not line.startswith(begin), lines)] or lines
        return "\n".join([first, *takewhile(str.strip, rest)])

    return found


CUTS: dict[str, Callable[[str], str]] = {
    "lead-time": fewer_rows,
    "twins": fewer_rows,
    "describe": one_story,
    "--statistics": paragraph("least TTC"),
    "info": lambda text: text.splitlines()[0],
    "warning": paragraph("prevented accidents"),
}
"""Verb or option → what the page shows of its output; of others all."""


def keep(source: Path, picture: Path) -> None:
    """A figure, or the table of accidents on the report's page, as a small WebP."""
    if source.suffix == ".html":
        from docs.make_pictures import page_picture  # selenium, which tests of the text do without

        source = page_picture(source.resolve(), "all-accidents")
    image = Image.open(source).convert("RGB")
    image.thumbnail((WIDTH, WIDTH))
    image.save(picture, quality=80)
    print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")
