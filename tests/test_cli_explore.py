"""`deepaccident explore`: the printed address opens the pages, and Ctrl-C ends the server."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from click.testing import CliRunner
from support.command_calls import invoke_command
from support.explorer_requests import send_request
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident

pytestmark = pytest.mark.slow


@contextmanager
def start_explorer(root: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the command, and yield its process and the address that it prints."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", "explore", str(root), "--no-open"]
    with subprocess.Popen(
        [*command, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509 - as in a terminal
    ) as process:
        try:
            assert process.stdout is not None
            address = None
            while address is None:
                line = process.stdout.readline()
                assert line, "the command ended without printing an address"
                address = re.search(r"open (http\S+)", line)
            yield process, address[1]
        finally:
            process.kill()


def test_the_printed_address_opens_the_pages_until_ctrl_c(da: DeepAccident) -> None:
    with start_explorer(da.dataroot) as (process, url):
        address = urlsplit(url)
        port = address.port or 0
        response = send_request(port, f"/?{address.query}")
        assert response.status == 303
        assert response.headers["location"] == "./"
        assert send_request(port, "/").status == 401

        cookie = ("Cookie", response.cookie)
        scenario = accident_scenario(da)
        assert scenario in send_request(port, "/", cookie).body
        assert send_request(port, f"/scenario/{scenario}/", cookie).status == 200
        for target in (
            "/../../../etc/passwd",
            "/static/0/..%2f..%2fexplorer.py",
            "/scenario/..%2f..%2fetc/passwd/",
        ):
            response = send_request(port, target, cookie)
            assert response.status == 404
            assert "root:" not in response.body
        assert send_request(port, "/", cookie, host="evil.example").status == 400
        assert send_request(port, "/", cookie, ("Origin", "http://evil.example")).status == 403
        words = ["explore", str(da.dataroot), "--no-open", "--address", str(port)]
        assert str(port) in str(CliRunner().invoke(deepaccident, words).exception)

        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert address.query not in errors


def test_pages_are_written_as_files(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "pages"
    words = ["explore", str(da.dataroot), "--out", str(out), "--where", "collision=true"]
    assert str(out) in invoke_command(*words).output
    assert (out / "index.html").is_file()
    assert len([*out.glob("*/*/index.html")]) == len(da.find(collision=True))
