"""`deepaccident explore` on tables of the whole release's size: its list pages, twenty readers,
memory, pictures.

The command runs in a process of its own, and readers on the same machine ask it, each without a
pause. Pictures are apart, of a small release with images of 1600 × 900.
"""

import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.measure import Figure
from benchmarks.scale import write_whole_release
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

LISTS = (
    "/",
    "/?view=table",
    "/?view=table&sort=num_frames&order=down&page=5",
    "/?town=Town03&collision=true",
    "/?q=length%3E%3D50%3B+weather%3DClear&view=table",
    "/?sort=accident_visibility&page=12",
)
READERS, SECONDS, REPEATS = 20, 30.0, 15
RELEASE = SynthConfig(
    scenarios=1, frames=2, image_size=(1600, 900), seed=7, unplanned=0, designed=True
)
WORKED = 240.0
"""Seconds to wait for the work in the background."""


@dataclass(frozen=True, slots=True)
class Served:
    """A running command: where it answers, the cookie that opens it, and its process."""

    place: str
    cookie: str
    process: int

    def reader(self) -> "Reader":
        return Reader(self.place, self.cookie)

    @property
    def memory_mb(self) -> float:
        """Anonymous memory."""
        status = Path(f"/proc/{self.process}/status").read_text()
        return int(re.findall(r"RssAnon:\s+(\d+)", status)[0]) / 1024


class Reader:
    """A browser that keeps its connection."""

    def __init__(self, place: str, cookie: str = "") -> None:
        self._connection = HTTPConnection(place, timeout=30)
        self._headers = {"Cookie": cookie}

    def get(self, address: str) -> tuple[int, dict[str, str], bytes]:
        self._connection.request("GET", address, headers=self._headers)
        answer = self._connection.getresponse()
        return (
            answer.status,
            {name.lower(): value for name, value in answer.getheaders()},
            answer.read(),
        )

    def seconds(self, address: str) -> float:
        start = time.perf_counter()
        status, _, _ = self.get(address)
        if status != 200:
            raise OSError(f"{address}: {status}")
        return time.perf_counter() - start


def measure() -> list[Figure]:
    with tempfile.TemporaryDirectory(prefix="deepaccident_explore_") as folder:
        return [
            *_of_lists(write_whole_release(Path(folder))),
            *_of_pictures(Path(folder) / "pictures"),
        ]


def _of_lists(root: Path) -> Iterator[Figure]:
    start = time.perf_counter()
    with served(root) as running:
        yield Figure(name="explore_start_s", value=time.perf_counter() - start, unit="s")
        reader = running.reader()
        busy = _slowest(reader)
        yield Figure(name="explore_background_s", value=_wait_for_work(reader), unit="s")
        yield Figure(name="explore_list_while_computing_ms", value=busy * 1e3, unit="ms")
        yield Figure(name="explore_list_ms", value=_slowest(reader) * 1e3, unit="ms", bound=100)
        yield Figure(name="explore_list_kb", value=len(reader.get("/")[2]) / 1e3, unit="kB")
        _crowd(running, 3.0)
        before = running.memory_mb
        times, errors = _crowd(running, SECONDS)
        yield Figure(name="explore_readers_errors", value=errors, bound=None)
        yield Figure(
            name="explore_readers_p95_ms",
            value=float(np.quantile(times, 0.95)) * 1e3,
            unit="ms",
            bound=300,
        )
        yield Figure(
            name="explore_readers_median_ms", value=float(np.median(times)) * 1e3, unit="ms"
        )
        yield Figure(name="explore_readers_pages_per_s", value=len(times) / SECONDS, unit="/s")
        yield Figure(name="explore_memory_mb", value=running.memory_mb, unit="MB")
        yield Figure(name="explore_memory_growth_mb", value=running.memory_mb - before, unit="MB")


def _slowest(reader: Reader) -> float:
    """Of the lists' medians, the largest, seconds."""
    for address in LISTS:
        reader.seconds(address)
    return max(
        float(np.median([reader.seconds(address) for _ in range(REPEATS)])) for address in LISTS
    )


def _wait_for_work(reader: Reader) -> float:
    start = time.perf_counter()
    while reader.get("/waiting.json")[2] != b"[]" and time.perf_counter() - start < WORKED:
        time.sleep(0.5)
    return time.perf_counter() - start


def _crowd(running: Served, seconds: float) -> tuple[list[float], int]:
    """Readers who ask for lists one after another: the seconds of all pages, and how many
    failed.
    """
    times: list[float] = []
    errors: list[str] = []
    end = time.monotonic() + seconds

    def read(seed: int) -> None:
        reader, source = running.reader(), np.random.default_rng(seed)
        while time.monotonic() < end:
            try:
                times.append(reader.seconds(LISTS[source.integers(len(LISTS))]))
            except (OSError, HTTPException) as error:  # noqa: PERF203 - each page for itself
                errors.append(str(error))
                reader = running.reader()

    threads = [threading.Thread(target=read, args=(seed,)) for seed in range(READERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return times, len(errors)


def _of_pictures(root: Path) -> Iterator[Figure]:
    make_release(root, RELEASE, workers=2)
    with served(root) as running:
        reader = running.reader()
        (scenario,) = set(re.findall(r'href="\./(scenario/[^"]+)/"', reader.get("/")[2].decode()))
        thumbnail = f"/thumbnail/{scenario.removeprefix('scenario/')}.jpg"
        yield Figure(name="explore_thumbnail_ms", value=reader.seconds(thumbnail) * 1e3, unit="ms")
        yield Figure(name="explore_thumbnail_kept_ms", value=_again(reader, thumbnail), unit="ms")
        for width in (320, 960):
            image = f"/{scenario}/images/ego_vehicle/Camera_{{}}/1?width={width}"
            cameras = ("Front", "FrontLeft", "FrontRight", "Back", "BackLeft", "BackRight")
            took = [reader.seconds(image.format(camera)) * 1e3 for camera in cameras]
            yield Figure(name=f"explore_image_{width}_ms", value=float(np.median(took)), unit="ms")
        yield Figure(
            name="explore_image_kept_ms", value=_again(reader, image.format("Front")), unit="ms"
        )
        yield Figure(
            name="explore_scenario_ms", value=reader.seconds(f"/{scenario}/") * 1e3, unit="ms"
        )
        yield Figure(
            name="explore_scenario_kept_ms", value=_again(reader, f"/{scenario}/"), unit="ms"
        )


def _again(reader: Reader, address: str) -> float:
    return float(np.median([reader.seconds(address) for _ in range(REPEATS)])) * 1e3


@contextmanager
def served(root: Path, *more: Any) -> Iterator[Served]:
    """The command on a release, until the end of the block."""
    words = [
        sys.executable,
        "-m",
        "deepaccident_devkit.cli",
        "explore",
        str(root),
        "--no-open",
        *map(str, more),
    ]
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, env={**environment, "PYTHONUNBUFFERED": "1"}
    ) as ran:
        assert ran.stdout is not None
        try:
            url = next(found[0] for line in ran.stdout if (found := _urls(line)))
            place = urlsplit(url)
            _, headers, _ = Reader(place.netloc).get(f"/?{place.query}")
            yield Served(place.netloc, headers["set-cookie"].partition(";")[0], ran.pid)
        finally:
            ran.terminate()


def _urls(line: str) -> Sequence[str]:
    return re.findall(r"http://127\.0\.0\.1:\d+/\?token=\S+", line)
