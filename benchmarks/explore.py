"""Measure `deepaccident explore` on tables of the whole release's size: its list pages, twenty
readers, memory, pictures.

The command runs in a process of its own, and readers on the same machine ask it, each without a
pause. Pictures are measured separately, on a small release with images of 1600 × 900.
"""

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

import numpy as np

from benchmarks.measure import Figure, milliseconds, temporary_folder
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
BACKGROUND_TIMEOUT_S = 240.0
"""Longest wait for the work in the background."""


@dataclass(frozen=True, slots=True)
class Served:
    """A running command: its address, the cookie that opens it, and its process."""

    address: str
    cookie: str
    process: int

    def reader(self) -> "Reader":
        return Reader(self.address, self.cookie)

    @property
    def memory_mb(self) -> float:
        """The anonymous memory of the process, in MB."""
        status = Path(f"/proc/{self.process}/status").read_text()
        return int(re.findall(r"RssAnon:\s+(\d+)", status)[0]) / 1024


class Reader:
    """A browser that keeps its connection open."""

    def __init__(self, host: str, cookie: str = "") -> None:
        self._connection = HTTPConnection(host, timeout=30)
        self._headers = {"Cookie": cookie}

    def get(self, address: str) -> tuple[int, dict[str, str], bytes]:
        """Return the status, headers and body of a page."""
        self._connection.request("GET", address, headers=self._headers)
        response = self._connection.getresponse()
        headers = {name.lower(): value for name, value in response.getheaders()}
        return response.status, headers, response.read()

    def seconds(self, address: str) -> float:
        """Return the seconds to get a page; raises OSError unless it is there."""
        start = time.perf_counter()
        status, _, _ = self.get(address)
        if status != 200:
            raise OSError(f"{address}: {status}")
        return time.perf_counter() - start


def measure() -> list[Figure]:
    with temporary_folder("explore") as folder:
        return [
            *_measure_lists(write_whole_release(folder)),
            *_measure_pictures(folder / "pictures"),
        ]


def _measure_lists(root: Path) -> Iterator[Figure]:
    start = time.perf_counter()
    with served(root) as running:
        yield Figure("explore_start_s", time.perf_counter() - start, "s")
        reader = running.reader()
        while_computing_s = _slowest(reader)
        yield Figure("explore_background_s", _wait_for_background(reader), "s")
        yield milliseconds("explore_list_while_computing_ms", while_computing_s)
        yield milliseconds("explore_list_ms", _slowest(reader), bound=100)
        yield Figure("explore_list_kb", len(reader.get("/")[2]) / 1e3, "kB")
        _read_in_parallel(running, 3.0)
        memory_before = running.memory_mb
        times, errors = _read_in_parallel(running, SECONDS)
        p95_s = float(np.quantile(times, 0.95))
        median_s = float(np.median(times))
        yield Figure("explore_readers_errors", errors)
        yield milliseconds("explore_readers_p95_ms", p95_s, bound=300)
        yield milliseconds("explore_readers_median_ms", median_s)
        yield Figure("explore_readers_pages_per_s", len(times) / SECONDS, "/s")
        yield Figure("explore_memory_mb", running.memory_mb, "MB")
        growth_mb = running.memory_mb - memory_before
        yield Figure("explore_memory_growth_mb", growth_mb, "MB")


def _slowest(reader: Reader) -> float:
    """Return the largest of the lists' median times, in seconds."""
    for address in LISTS:
        reader.seconds(address)
    return max(_median_seconds(reader, address) for address in LISTS)


def _wait_for_background(reader: Reader) -> float:
    start = time.perf_counter()
    while (
        reader.get("/waiting.json")[2] != b"[]"
        and time.perf_counter() - start < BACKGROUND_TIMEOUT_S
    ):
        time.sleep(0.5)
    return time.perf_counter() - start


def _read_in_parallel(running: Served, seconds: float) -> tuple[list[float], int]:
    """Let readers get one list after another; return the seconds of all pages, and the number of
    failures.
    """
    times: list[float] = []
    errors: list[str] = []
    end = time.monotonic() + seconds

    def read(seed: int) -> None:
        reader = running.reader()
        source = np.random.default_rng(seed)
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


def _measure_pictures(root: Path) -> Iterator[Figure]:
    make_release(root, RELEASE, workers=2)
    with served(root) as running:
        reader = running.reader()
        links = re.findall(r'href="\./(scenario/[^"]+)/"', reader.get("/")[2].decode())
        (scenario,) = set(links)
        thumbnail = f"/thumbnail/{scenario.removeprefix('scenario/')}.jpg"
        yield milliseconds("explore_thumbnail_ms", reader.seconds(thumbnail))
        yield milliseconds("explore_thumbnail_kept_ms", _median_seconds(reader, thumbnail))
        for width in (320, 960):
            image = f"/{scenario}/images/ego_vehicle/Camera_{{}}/1?width={width}"
            cameras = ("Front", "FrontLeft", "FrontRight", "Back", "BackLeft", "BackRight")
            seconds = [reader.seconds(image.format(camera)) for camera in cameras]
            yield milliseconds(f"explore_image_{width}_ms", float(np.median(seconds)))
        yield milliseconds("explore_image_kept_ms", _median_seconds(reader, image.format("Front")))
        yield milliseconds("explore_scenario_ms", reader.seconds(f"/{scenario}/"))
        yield milliseconds("explore_scenario_kept_ms", _median_seconds(reader, f"/{scenario}/"))


def _median_seconds(reader: Reader, address: str) -> float:
    """Return the median time of a page."""
    times = [reader.seconds(address) for _ in range(REPEATS)]
    return float(np.median(times))


@contextmanager
def served(root: Path) -> Iterator[Served]:
    """Run the command on a release until the end of the block."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", "explore", str(root), "--no-open"]
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }
    environment["PYTHONUNBUFFERED"] = "1"
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            url = next(filter(None, map(_find_url, process.stdout)))
            _, headers, _ = Reader(url.netloc).get(f"/?{url.query}")
            cookie = headers["set-cookie"].partition(";")[0]
            yield Served(url.netloc, cookie, process.pid)
        finally:
            process.terminate()


def _find_url(line: str) -> SplitResult | None:
    match = re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", line)
    return match and urlsplit(match[0])
