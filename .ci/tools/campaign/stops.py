"""Every verb that writes, killed at any moment or on a full disk, then run again: as if nothing had
happened.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import killed
import numpy as np

SCENARIO = "type1_subtype1_accident/Town03_type001_subtype0001_scenario00001"
_IMPORTED = (
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
        name: in the table.
        words: its arguments; {home} is the folder of healthy files, {out} a new folder.
        progress: a file that is whole at each moment, and says how far the work is.
    """

    name: str
    words: str
    progress: str = ""

    def words_for(self, home: Path, out: Path) -> list[str]:
        """Its arguments for a folder to write into."""
        return [word.format(home=home, out=out) for word in self.words.split()]


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
            f"export {name} {_RELEASE} --out {{out}}/{name}{own}",
            progress=f"{name}/{name}.manifest.json",
        )
        for name, own in {
            "opencood": " --without-clouds",
            "nuscenes": "",
            "parquet": "",
            "webdataset": "",
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
    """One verb that is stopped once: after a share of its time, or at a share of its largest
    file.
    """

    verb: str
    kind: str
    share: float


@dataclass(frozen=True, slots=True)
class Stopped:
    """What became of it; `fault` is empty if nothing is wrong."""

    stop: Stop
    fault: str = ""

    def __str__(self) -> str:
        return f"{self.stop.verb} / {self.stop.kind} at {self.stop.share:.3f}: {self.fault}"

    @property
    def failed(self) -> bool:
        return bool(self.fault)


@dataclass(frozen=True, slots=True)
class _Healthy:
    """An undisturbed run: its seconds and its files."""

    seconds: float
    files: Mapping[str, bytes]


def drawn_stops(kills: int, seed: int) -> list[Stop]:
    """So many kills, the verbs by turns, at moments by chance; and for each verb four sizes of a
    full disk.
    """
    rng = np.random.default_rng(seed)
    moments = [
        Stop(VERBS[number % len(VERBS)].name, "kill", float(rng.uniform(0.0, 1.05)))
        for number in range(kills)
    ]
    return moments + [
        Stop(verb.name, "full disk", share) for verb in VERBS for share in (0.0, 0.01, 0.5, 0.999)
    ]


class Stopper:
    """Runs verbs, stops them, and runs them again."""

    def __init__(self, home: Path, folder: Path, server: "subprocess.Popen[str]") -> None:
        self._home, self._folder, self._server = home, folder, server
        self._healthy: dict[str, _Healthy] = {}
        self._count = 0

    def stopped(self, stop: Stop) -> Stopped:
        """Stop a verb as told; compare what is there afterwards, and after the next run."""
        verb = next(each for each in VERBS if each.name == stop.verb)
        healthy = self._undisturbed(verb)
        out = self._new_folder()
        largest = max(map(len, healthy.files.values()))
        how = (
            {"delay": stop.share * healthy.seconds}
            if stop.kind == "kill"
            else {"limit": int(stop.share * largest)}
        )
        first = self._run(verb, out, **how)
        faults = [
            *(_told(first) if stop.kind == "full disk" else ()),
            *_unwhole(files_in(out), healthy.files, verb.progress),
        ]
        if stop.kind == "kill" and not faults and files_in(out) == healthy.files:
            return Stopped(
                stop, ""
            )  # killed when all was written; some verbs refuse to write it again
        again = self._run(verb, out)
        if again["status"] != 0:
            faults.append(f"the next run: status {again['status']}: {again['message'][-300:]}")
        faults += _differences(files_in(out), healthy.files)
        return Stopped(stop, "; ".join(faults))

    def _undisturbed(self, verb: Verb) -> _Healthy:
        if verb.name not in self._healthy:
            runs = []
            for _ in range(2):  # a verb whose runs differ by themselves is none to compare with
                out = self._new_folder()
                run = self._run(verb, out)
                assert run["status"] == 0, (verb.name, run["message"])
                runs.append(_Healthy(run["seconds"], files_in(out)))
            assert runs[0].files == runs[1].files, verb.name
            self._healthy[verb.name] = runs[1]
        return self._healthy[verb.name]

    def _new_folder(self) -> Path:
        """Of the same length of name each time, in case that a file holds it."""
        self._count += 1
        folder = self._folder / f"{self._count:05d}"
        folder.mkdir(parents=True)
        return folder

    def _run(self, verb: Verb, out: Path, **how: Any) -> dict[str, Any]:
        assert self._server.stdin
        assert self._server.stdout
        self._server.stdin.write(
            json.dumps({"words": verb.words_for(self._home, out), **how}) + "\n"
        )
        self._server.stdin.flush()
        answer: dict[str, Any] = json.loads(self._server.stdout.readline())
        return answer


@contextmanager
def stopper(home: Path, folder: Path) -> Iterator[Stopper]:
    """A server of processes to stop, for the healthy files in `home`; outputs go into `folder`."""
    command = [sys.executable, "-W", "ignore", killed.__file__, *_IMPORTED]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            yield Stopper(home, folder, server)
        finally:
            assert server.stdin
            server.stdin.close()


def run_stops(
    stops: list[Stop], home: Path, folder: Path, tell: Callable[[Stopped], object] = lambda _: None
) -> list[Stopped]:
    """What became of each stop."""
    found = []
    with stopper(home, folder) as runner:
        for stop in stops:
            found.append(runner.stopped(stop))
            tell(found[-1])
    return found


def files_in(folder: Path) -> dict[str, bytes]:
    """Path → content of all files of a folder, hidden ones too."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _told(run: Mapping[str, Any]) -> Iterator[str]:
    """A full disk is one line and status 2; or the run needed no more room than there was."""
    if run["status"] == 0:
        return
    lines = [line for line in run["message"].splitlines() if line.startswith("error: ")]
    if run["status"] != 2 or len(lines) != 1 or "Traceback" in run["message"]:
        yield f"status {run['status']}: {run['message'][-300:]}"


def _unwhole(
    found: Mapping[str, bytes], healthy: Mapping[str, bytes], progress: str
) -> Iterator[str]:
    """Files under a final name that are not those of an undisturbed run; what an evaluation resumes
    from has none.
    """
    for name, content in found.items():
        own = any(
            part.startswith(".") or part.endswith(".unfinished") or part == "locks"
            for part in name.split("/")
        )
        if name == progress:
            json.loads(content)
        elif not own and healthy.get(name) != content:
            yield f"{name} is not whole"


def _differences(found: Mapping[str, bytes], healthy: Mapping[str, bytes]) -> Iterator[str]:
    for name in sorted(found.keys() | healthy.keys()):
        if name not in healthy:
            yield f"{name} is left over"
        elif found.get(name) != healthy[name]:
            yield f"{name} is unequal"
