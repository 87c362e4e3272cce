"""Write what the commands of docs/safety.md print, and its pictures; the picture of the report
needs chromium.
"""

import os
import re
import shlex
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from textwrap import fill

from click.testing import CliRunner
from PIL import Image

from benchmarks.measure import temporary_folder
from benchmarks.pages.marks import DOCS
from deepaccident_devkit.cli import deepaccident

PAGE = DOCS / "safety.md"
IMAGES = PAGE.parent / "images"
RELEASE, OUT = "accidents", "out"
"""Values of DATAROOT and OUT on the page."""
PIECE = re.compile(
    r"^ {4}deepaccident (?P<command>\S[^\n]*)$|^<!-- output -->$.*?^<!-- end of output -->$",
    re.MULTILINE | re.DOTALL,
)
PICTURES = {
    "safety_lead_times.webp": "lead_times.png",
    "safety_avoidability.webp": "avoidability_vehicles.png",
    "safety_report.webp": "report.html",
}
"""Picture on the page → file in OUT that it shows."""
WIDTH, LINE = 1200, 118
"""Pixels of a figure; letters of a line of prose."""
MAX_ROWS = 1
"""Rows of a long table that the page shows."""


def main(release: Path | None = None) -> None:
    """Write the outputs and the pictures; `release` is one that the page's first command made."""
    with temporary_folder() as folder:
        os.chdir(folder)
        if release is not None:
            Path(RELEASE).symlink_to(release.resolve(), target_is_directory=True)
        page = with_outputs(PAGE.read_text(encoding="utf-8"), has_release=release is not None)
        for picture, source in PICTURES.items():
            keep(Path(OUT, source), IMAGES / picture)
        os.chdir(PAGE.parent)
    PAGE.write_text(page, encoding="utf-8")


def with_outputs(page: str, *, has_release: bool = False) -> str:
    """Return the page with the current output of its commands, run in their order in the working
    folder; the release is not made if `has_release`.
    """
    printed = ""

    def replace_output(piece: re.Match[str]) -> str:
        nonlocal printed
        command = piece["command"]
        if command is None:
            return f"<!-- output -->\n```text\n{printed}\n```\n<!-- end of output -->"
        if not (has_release and command.startswith("synth ")):
            printed = output(command)
        return piece[0]

    return PIECE.sub(replace_output, page)


def output(command: str) -> str:
    """Return the output of a command, cut to what the page shows."""
    values = {"DATAROOT": RELEASE, "OUT": OUT}
    words = [values.get(word, word) for word in shlex.split(command)]
    print(f"deepaccident {shlex.join(words)}", flush=True)
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    if result.exit_code:
        raise SystemExit(f"{command}: {result.output}")
    text = result.stdout.replace(f"{Path.cwd()}/", "")
    text = text.replace(f"{Path(RELEASE).resolve()}", RELEASE)
    for name, cut in CUTS.items():
        if f" {name} " in f" {command} ":
            return cut(text).rstrip()
    return text.rstrip()


def one_story(text: str) -> str:
    """Return the first scenario and its story."""
    scenario, story = text.splitlines()[:2]
    indent = story[: len(story) - len(story.lstrip())]
    filled = fill(story.strip(), LINE, initial_indent=indent, subsequent_indent=indent)
    return "\n".join([scenario, filled, "…"])


def paragraph(begin: str, hidden: str = r"wrote ") -> Callable[[str], str]:
    """Return a function that cuts an output to one paragraph.

    The paragraph is from the line that begins with `begin`, or from the first line, to the next
    empty line; of the rows of single accidents, the first ones stay.

    Args:
        begin: Beginning of the first line.
        hidden: Regular expression; lines with such a beginning are left out.
    """

    def cut(text: str) -> str:
        lines = text.splitlines()
        numbers = (number for number, line in enumerate(lines) if line.startswith(begin))
        first = next(numbers, 0)
        rest = takewhile(str.strip, lines[first + 1 :])
        shown_lines = [line for line in [lines[first], *rest] if not re.match(hidden, line)]
        return "\n".join(fewer_rows(shown_lines))

    return cut


def fewer_rows(lines: list[str]) -> list[str]:
    """Return the lines without the rows of accidents after the first ones."""
    result: list[str] = []
    rows = 0
    for line in lines:
        rows += line.startswith("type")
        if rows <= MAX_ROWS or not line.startswith("type"):
            result.append(line)
        elif rows == MAX_ROWS + 1:
            result.append("…")
    return result


CUTS: dict[str, Callable[[str], str]] = {
    "lead-time": paragraph("means in seconds", "wrote |accidents in which both"),
    "avoidability": paragraph("vehicles: ", r"(first|second|both) +[48] |other road users"),
    "twins": paragraph("accident "),
    "describe": one_story,
    "info": lambda text: text.splitlines()[0],
    "warning": paragraph(
        "prevented accidents", r" +(never|random per (frame  |recording)|TTC|this model, any)"
    ),
}
"""Verb → function that cuts its output; other outputs are shown as they are."""


def keep(source: Path, picture: Path) -> None:
    """Save a figure, or the table of accidents on the report's page, as a small WebP."""
    if source.suffix == ".html":
        from docs.make_pictures import page_picture  # selenium, which tests of the text do without

        source = page_picture(source.resolve(), "all-accidents")
    image = Image.open(source).convert("RGB")
    image.thumbnail((WIDTH, WIDTH))
    image.save(picture, quality=80)
    print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")
