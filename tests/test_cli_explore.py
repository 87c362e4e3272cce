"""`deepaccident explore`, as a reader runs it: the printed address opens the pages, Ctrl-C ends all
of it.
"""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from asking import ask
from click.testing import CliRunner
from replay_page import accident
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident

pytestmark = pytest.mark.slow


@contextmanager
def running(root: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command, and the address that it prints."""
    command = [
        sys.executable,
        "-m",
        "deepaccident_devkit.cli",
        "explore",
        str(root),
        "--no-open",
        *words,
    ]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509 - as in a terminal
    ) as process:
        try:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            yield (
                process,
                next(found[0] for line in lines if (found := re.findall(r"open (http\S+)", line))),
            )
        finally:
            process.kill()


def test_the_printed_address_opens_the_pages_until_ctrl_c(da: DeepAccident) -> None:
    with running(da.dataroot) as (process, url):
        place = urlsplit(url)
        port = place.port or 0
        first = ask(port, f"/?{place.query}")
        assert (ask(port, "/").status, first.status, first.headers["location"]) == (401, 303, "./")
        cookie = ("Cookie", first.cookie)
        assert accident(da) in ask(port, "/", cookie).body
        assert ask(port, f"/scenario/{accident(da)}/", cookie).status == 200
        for target in (
            "/../../../etc/passwd",
            "/static/0/..%2f..%2fexplorer.py",
            "/scenario/..%2f..%2fetc/passwd/",
        ):
            found = ask(port, target, cookie)
            assert (found.status, "root:" in found.body) == (404, False)
        assert ask(port, "/", cookie, host="evil.example").status == 400
        assert ask(port, "/", cookie, ("Origin", "http://evil.example")).status == 403
        words = ["explore", str(da.dataroot), "--no-open", "--address", str(port)]
        assert str(port) in str(CliRunner().invoke(deepaccident, words).exception)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    assert (process.returncode, "Traceback" in said, place.query in said) == (130, False, False)


def test_pages_are_written_as_files(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "pages"
    words = ["explore", str(da.dataroot), "--out", str(out), "--where", "collision=true"]
    assert str(out) in called(*words).output
    assert (out / "index.html").is_file()
    assert len([*out.glob("*/*/index.html")]) == len(da.find(collision=True))
