"""Every command that writes: killed at any moment or stopped by a full disk, then run again.

The output of the second run must be as if nothing had happened.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from support import stopped_index_process

SCENARIO = "type1_subtype1_accident/Town03_type001_subtype0001_scenario00001"
_IMPORTED_MODULES = (
    "matplotlib.pyplot",
    "scipy.optimize",
    "shapely",
    "cv2",
    "yaml",
    "pyarrow.parquet",
    "PIL.ImageFont",
)


@dataclass(frozen=True, slots=True)
class Verb:
    """A command that writes.

    Attributes:
        name: Name in the table.
        arguments: Arguments, separated by spaces; {home} is the folder of healthy files, {out} a
            new folder.
        progress: File that is complete at any moment, and records how far the work is.
    """

    name: str
    arguments: str
    progress: str = ""

    def format_arguments(self, home: Path, out: Path) -> list[str]:
        """Return the arguments for a folder to write into."""
        return [word.format(home=home, out=out) for word in self.arguments.split()]


_RELEASE = "{home}/release --index-dir {home}/index --workers 1"
_SENSORS = f"{{home}}/sensors {SCENARIO} --index-dir {{home}}/index_of_sensors --workers 1"
_EVALUATE = f"{_RELEASE} --split train --samples all"
VERBS = (
    Verb("check index", "check index {home}/release --index-dir {out} --workers 1"),
    Verb(
        "labels",
        f"labels {_RELEASE} --split train --out {{out}}/labels",
        progress="labels/manifest.json",
    ),
    Verb("synth", "synth {out}/made --scenarios 2 --frames 3 --sensors none --seed 1 --workers 1"),
    Verb("split", f"split {_RELEASE} --out {{out}} --overwrite"),
    Verb("split to a file", f"split {_RELEASE} --out {{out}}/mine.txt --overwrite"),
    Verb("info --statistics", f"info {_RELEASE} --statistics --out {{out}}/statistics"),
    Verb(
        "evaluate",
        f"evaluate accident {_EVALUATE} --scope accident --horizon 0.5 "
        f"--protocol boxes --resamples 20 "
        "--results {home}/results/accident --out {out}/bundle --include-results --overwrite",
    ),
    Verb(
        "evaluate compare",
        "evaluate compare {home}/bundles/accident {home}/bundles/accident "
        "--resamples 20 --out {out}/a.csv "
        "--out {out}/a.json --out {out}/a.png",
    ),
    Verb(
        "predict",
        f"predict constant_velocity {_EVALUATE} --task accident --horizon 0.5 "
        f"--out {{out}}/predicted",
    ),
    Verb(
        "render bev",
        f"render bev {_RELEASE} {SCENARIO}/ego_vehicle/003 --out {{out}}/picture.png --dpi 40",
    ),
    Verb(
        "render video",
        f"render video {_RELEASE} {SCENARIO} --what bev --size 160x90 --out {{out}}/video.gif",
    ),
    Verb("export mcap", f"export mcap {_SENSORS} --out {{out}}/scenario.mcap"),
    *(
        Verb(
            f"export {name}",
            f"export {name} {_RELEASE} --out {{out}}/{name}{options}",
            progress=f"{name}/{name}.manifest.json",
        )
        for name, options in {
            "opencood": " --without-clouds",
            "nuscenes": "",
            "parquet": "",
            "av2": "",
            "release": "",
        }.items()
    ),
    Verb(
        "export questions",
        f"export questions {_RELEASE} --observe 0 --ahead 1 --stride 0.5 --out {{out}}/questions",
        progress="questions/questions.manifest.json",
    ),
    Verb(
        "cache",
        "cache {home}/sensors --index-dir {home}/index_of_sensors --workers 1 --out "
        "{out}/cache --size 30x18 "
        "--channels Camera_Front --agents ego_vehicle --where length>=1",
        progress="cache/cache.manifest.json",
    ),
    Verb(
        "results",
        "results {home}/questions/answers.jsonl --truth "
        "{home}/questions/truth.jsonl --out {out}/answered.json",
    ),
    Verb("safety report", f"safety report {_RELEASE} --replays none --out {{out}}/safety"),
    Verb("explore", f"explore {_RELEASE} --out {{out}}/pages"),
    Verb("replay", f"render replay {_SENSORS} --out {{out}}/replay.html"),
)


@dataclass(frozen=True, slots=True)
class Stop:
    """One command that is stopped once.

    Attributes:
        verb: Name of the command.
        kind: `kill` or `full disk`.
        share: Share of the command's time, or of its largest file, at which it is stopped.
    """

    verb: str
    kind: str
    share: float


@dataclass(frozen=True, slots=True)
class StopOutcome:
    """The outcome of a stop; `fault` is empty if nothing is wrong."""

    stop: Stop
    fault: str = ""

    def __str__(self) -> str:
        stop = self.stop
        return f"{stop.verb} / {stop.kind} at {stop.share:.3f}: {self.fault}"

    @property
    def failed(self) -> bool:
        return bool(self.fault)


@dataclass(frozen=True, slots=True)
class _HealthyRun:
    """The duration in seconds and the files of an undisturbed run."""

    seconds: float
    files: Mapping[str, bytes]


def draw_stops(kills: int, seed: int) -> list[Stop]:
    """Draw kills at random moments, and add four sizes of a full disk for each command.

    Args:
        kills: Number of kills, for which the commands take turns.
        seed: Seed of the moments.
    """
    rng = np.random.default_rng(seed)
    stops = []
    for number in range(kills):
        verb = VERBS[number % len(VERBS)]
        stops.append(Stop(verb.name, "kill", float(rng.uniform(0.0, 1.05))))
    for verb in VERBS:
        stops += [Stop(verb.name, "full disk", share) for share in (0.0, 0.01, 0.5, 0.999)]
    return stops


class Stopper:
    """Runs commands, stops them, and runs them again."""

    def __init__(self, home: Path, folder: Path, server: "subprocess.Popen[str]") -> None:
        self._home, self._folder, self._server = home, folder, server
        self._healthy_runs: dict[str, _HealthyRun] = {}
        self._count = 0

    def run(self, stop: Stop) -> StopOutcome:
        """Stop a command; compare its files after the stop and after the next run."""
        verb = next(verb for verb in VERBS if verb.name == stop.verb)
        healthy_run = self._run_undisturbed(verb)
        healthy_files = healthy_run.files
        out = self._make_folder()
        if stop.kind == "kill":
            self._run_command(verb, out, delay=stop.share * healthy_run.seconds)
            faults = []
        else:
            largest = max(map(len, healthy_files.values()))
            run = self._run_command(verb, out, limit=int(stop.share * largest))
            faults = list(_find_disk_faults(run))
        faults += _find_unfinished_files(read_files(out), healthy_files, verb.progress)
        if stop.kind == "kill" and not faults and read_files(out) == healthy_files:
            # killed when all was written; some commands refuse to write it again
            return StopOutcome(stop)
        next_run = self._run_command(verb, out)
        if next_run["status"] != 0:
            message = next_run["message"][-300:]
            faults.append(f"the next run: status {next_run['status']}: {message}")
        faults += _find_differences(read_files(out), healthy_files)
        return StopOutcome(stop, "; ".join(faults))

    def _run_undisturbed(self, verb: Verb) -> _HealthyRun:
        """Return an undisturbed run of a command; two runs must write the same files."""
        if verb.name not in self._healthy_runs:
            runs = []
            for _ in range(2):
                out = self._make_folder()
                run = self._run_command(verb, out)
                assert run["status"] == 0, (verb.name, run["message"])
                runs.append(_HealthyRun(run["seconds"], read_files(out)))
            first, second = runs
            assert first.files == second.files, verb.name
            self._healthy_runs[verb.name] = second
        return self._healthy_runs[verb.name]

    def _make_folder(self) -> Path:
        """Make a new folder; all names have the same length, in case a file holds them."""
        self._count += 1
        folder = self._folder / f"{self._count:05d}"
        folder.mkdir(parents=True)
        return folder

    def _run_command(self, verb: Verb, out: Path, **stop: float) -> dict[str, Any]:
        """Run a command in a process of the server; return its status, message and duration."""
        assert self._server.stdin
        assert self._server.stdout
        request = {"words": verb.format_arguments(self._home, out), **stop}
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        answer: dict[str, Any] = json.loads(self._server.stdout.readline())
        return answer


@contextmanager
def open_stopper(home: Path, folder: Path) -> Iterator[Stopper]:
    """Start a server of processes that can be stopped.

    Args:
        home: Folder of healthy files.
        folder: Folder for the outputs of the commands.
    """
    module = stopped_index_process.__file__
    command = [sys.executable, "-W", "ignore", module, *_IMPORTED_MODULES]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as server:
        try:
            yield Stopper(home, folder, server)
        finally:
            assert server.stdin
            server.stdin.close()


def run_stops(
    stops: list[Stop],
    home: Path,
    folder: Path,
    report: Callable[[StopOutcome], object] = lambda _: None,
) -> list[StopOutcome]:
    """Run stops and return their outcomes; `report` is called with each of them."""
    outcomes = []
    with open_stopper(home, folder) as stopper:
        for stop in stops:
            outcome = stopper.run(stop)
            outcomes.append(outcome)
            report(outcome)
    return outcomes


def read_files(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder by their paths, including hidden files."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _find_disk_faults(run: Mapping[str, Any]) -> Iterator[str]:
    """Yield a fault unless a run on a full disk ends with status 2 and one line of error.

    A run that needed no more space than there was may end with status 0.
    """
    if run["status"] == 0:
        return
    lines = [line for line in run["message"].splitlines() if line.startswith("error: ")]
    if run["status"] != 2 or len(lines) != 1 or "Traceback" in run["message"]:
        yield f"status {run['status']}: {run['message'][-300:]}"


def _find_unfinished_files(
    files: Mapping[str, bytes], healthy_files: Mapping[str, bytes], progress: str
) -> Iterator[str]:
    """Yield a fault for each file that has its final name but not its final content.

    The file of the progress must be complete JSON. Temporary files may hold anything.
    """
    for name, content in files.items():
        if name == progress:
            json.loads(content)
        elif not _is_temporary(name) and healthy_files.get(name) != content:
            yield f"{name} is not whole"


def _is_temporary(name: str) -> bool:
    """Return whether a file is hidden, unfinished or a lock, or lies in such a folder."""
    parts = name.split("/")
    if "locks" in parts:
        return True
    return any(part.startswith(".") or part.endswith(".unfinished") for part in parts)


def _find_differences(
    files: Mapping[str, bytes], healthy_files: Mapping[str, bytes]
) -> Iterator[str]:
    """Yield a fault for each file that is left over, missing or different."""
    for name in sorted(files.keys() | healthy_files.keys()):
        if name not in healthy_files:
            yield f"{name} is left over"
        elif files.get(name) != healthy_files[name]:
            yield f"{name} is unequal"
