"""Kinds of files beside releases and results: of exports, questions and caches; a scheduler's
address; zips.
"""

import json
from collections.abc import Mapping
from functools import cache
from math import prod
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from campaign import other_mutations, plain
from campaign.healthy import AGENTS, CHANNELS, EXPORT, SCHEDULER, opened
from campaign.kind import Action, Kind, Room, dataset_of
from campaign.tables_of_releases import judge_tables, tables
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import WorkerError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.questions import read_answers, results_of_answers
from deepaccident_devkit.plugins.study import Recipe, read_recipe
from deepaccident_devkit.support.parallel import cluster_executor, executors
from deepaccident_devkit.training.image_cache import ImageCache
from deepaccident_devkit.validation import validate_release

assert other_mutations  # made for these

# ---- exports


def _exported(room: Room) -> dict[str, bytes]:
    """Run the export again: a killed one goes on, a complete one is compared."""
    folder = _export(room)
    export_release(dataset_of(room.home), folder, EXPORT, workers=1)
    files = (path for path in folder.rglob("*.yaml") if path.is_file() and not path.is_symlink())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def _export(room: Room) -> Path:
    return room.tree / room.victim.relative_to(room.tree).parts[0]


def _judge_exported(room: Room, read: Mapping[str, bytes]) -> str | None:
    """The manifest tells of the settings and the scenarios, and files of a whole export have its
    bytes.

    Which of them are there is not compared: records say that a unit is done, and are believed.
    """
    folder, whole = _export(room), room.home / "exports" / "whole"
    told, expected = (plain.json_file(each / "opencood.manifest.json") for each in (folder, whole))
    if (
        told["settings"] != expected["settings"]
        or told["release"]["scenarios"] != expected["release"]["scenarios"]
    ):
        return "other settings or scenarios"
    files = {
        path.relative_to(whole).as_posix(): path.read_bytes() for path in whole.rglob("*.yaml")
    }
    wrong = [name for name in read.keys() & files.keys() if read[name] != files[name]]
    return f"{wrong[0]} differs from that of a whole export" if wrong else None


# ---- questions


def _answered(room: Room) -> Any:
    files = room.tree / "answers.jsonl", room.victim
    results_of_answers(*files, room.scratch / "results.json")
    return read_answers(*files)


def _judge_answers(room: Room, read: Any) -> str | None:
    told = [json.loads(line) for line in room.victim.read_bytes().split(b"\n") if line.strip()]
    asked = {line["id"]: line for line in told}
    lines = [json.loads(line) for line in (room.tree / "answers.jsonl").read_bytes().splitlines()]
    expected: dict[str, list[tuple[int, int]]] = {line["sample"]: [] for line in asked.values()}
    for line in asked.values():
        expected.setdefault(f"{line['sample'].rpartition('/')[0]}/{line['last_frame']:03d}", [])
    for answer in lines:
        question = asked[answer["id"]]
        expected[question["sample"]].append(
            tuple(question["actors"][name] for name in answer["who"])
        )
    found = {token: [each.ids for each in accidents] for token, accidents in read.accidents.items()}
    return None if found == expected else "other samples or actors"


# ---- a cache of images


@cache
def _sensors(home: Path) -> DeepAccident:
    return opened(home / "sensors", home / "index_of_sensors")


def _cached(room: Room) -> dict[str, Any]:
    dataset, images = _sensors(room.home), ImageCache(room.tree)
    agents = [f"{each['token']}/{AGENTS[0]}" for each in dataset.scenario]
    images.check_release(dataset, agents)
    return {
        agent: images.load(images.images, dataset, f"{agent}/001/{CHANNELS[0]}")[0].copy()
        for agent in agents
    }


def _judge_cached(room: Room, read: Mapping[str, Any]) -> str | None:
    settings = plain.json_file(room.tree / "cache.manifest.json")["settings"]
    shape = (
        settings["images"]["resize"]
        if settings["images"]["crop"] is None
        else settings["images"]["crop"][2:]
    )
    place = settings["agents"].index(AGENTS[0]), settings["images"]["cameras"].index(CHANNELS[0])
    for agent, found in read.items():
        path = room.tree / f"{agent.rpartition('/')[0].replace('/', '__')}.images"
        if not np.array_equal(found, plain.cached_image(path, *place, *shape)):
            return f"{agent}: other pixels than numpy reads"
    return None


# ---- the file of a scheduler


def _scheduled(room: Room) -> str:
    """Nobody listens at the healthy address, and it is right to say so."""
    try:
        with (
            patch.object(executors, "ADDRESS_WAIT", 0.2),
            cluster_executor(scheduler_file=room.victim),
        ):
            return "a scheduler"
    except WorkerError:
        same = room.victim.is_file() and room.victim.stat().st_size == room.healthy.stat().st_size
        if same and room.victim.read_bytes() == room.healthy.read_bytes():
            return SCHEDULER
        raise


def _judge_scheduled(room: Room, read: str) -> str | None:
    return None if read == plain.json_file(room.victim)["address"] else f"a connection: {read}"


# ---- a release in an archive


def _from_zip(room: Room) -> dict[str, Any]:
    index = room.scratch / "index"
    return tables(DeepAccident("v1", room.victim, index_dir=index, workers=1, verbose=False))


def _judge_zip(room: Room, read: Mapping[str, Any]) -> str | None:
    """Unpacked without a look at checksums, the release says the same."""
    unpacked = plain.unpacked(room.victim, room.scratch / "unpacked")
    return judge_tables(
        Room(room.home, unpacked, room.victim, room.scratch, room.outside, room.healthy), read
    )


def _validated_zip(room: Room) -> list[str]:
    return [
        str(finding) for finding in validate_release(room.victim, workers=1, deep=True).findings
    ]


def _judge_findings(room: Room, sentences: list[str]) -> str | None:
    """`validate` tells of an archive that cannot be read, or of a member whose checksum is
    another.
    """
    if long := next((each for each in sentences if len(each) > 2000), None):
        return f"a sentence of {len(long)} characters"
    if any(room.victim.name in each for each in sentences):
        return None
    damaged = [name for name, (_, right) in plain.members(room.victim).items() if not right]
    untold = [
        name for name in damaged if not any(name.rpartition("/")[2] in each for each in sentences)
    ]
    return f"no word of {untold[0]}, which is damaged" if untold else None


# ---- recipes of studies


def _judge_recipe(room: Room, read: Recipe) -> str | None:
    """The same names in the same order, and a row for each value of the lists."""
    said = plain.yaml_file(room.victim)
    for part in ("title", "question"):
        if getattr(read, part) != said[part]:
            return f"another {part}"
    for part in ("releases", "weights", "groups"):
        if list(getattr(read, part)) != list(said.get(part, {})):
            return f"other {part}"
    keys = ("agents", "latency", "pose_noise", "packet_loss", "budget", "horizon")
    lists = [[row[key] for key in keys if isinstance(row.get(key), list)] for row in said["rows"]]
    return (
        None
        if len(read.rows) == sum(prod(map(len, each)) for each in lists)
        else "another number of rows"
    )


_EXPORTED = Action(_exported, _judge_exported)
_CACHED = Action(_cached, _judge_cached)
_JOURNALS = ".deepaccident-parts/kept/opencood/*.paths"
_DONE = ".deepaccident-parts/kept/opencood/*/done"
KINDS = (
    Kind(
        "export's manifest",
        "manifest",
        "exports",
        "*/opencood.manifest.json",
        (_EXPORTED,),
        writes=True,
    ),
    Kind(
        "export's journals", "journal", "exports", f"begun/{_JOURNALS}", (_EXPORTED,), writes=True
    ),
    Kind("export's done records", "record", "exports", f"begun/{_DONE}", (_EXPORTED,), writes=True),
    Kind(
        "questions' truth",
        "lines",
        "questions",
        "truth.jsonl",
        (Action(_answered, _judge_answers),),
    ),
    Kind("images cache's list", "manifest", "cache", "cache.manifest.json", (_CACHED,)),
    Kind("images cache", "images", "cache", "*.images", (_CACHED,)),
    Kind(
        "study recipes",
        "recipe",
        "recipes",
        "*.yaml",
        (
            Action(lambda room: read_recipe(str(room.victim)), _judge_recipe),
            Action(lambda room: read_recipe(str(room.victim), smoke=True)),
        ),
    ),
    Kind(
        "scheduler file",
        "address",
        "schedulers",
        "scheduler.json",
        (Action(_scheduled, _judge_scheduled),),
    ),
    Kind(
        "zip of a release",
        "zip",
        "zips",
        "*.zip",
        (Action(_from_zip, _judge_zip), Action(_validated_zip, _judge_findings)),
    ),
)
