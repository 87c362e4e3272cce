"""The data card of a release as Croissant metadata (JSON-LD): what it holds, what is known of it, and what compares.

Croissant 1.0, with the fields of its extension for responsible AI, RAI 1.0. Paths are below the dataroot.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.release.labels import LABEL_FIELDS
from deepaccident_devkit.release.store.members import SPLIT_FILE_FOLDER, SPLIT_FILES
from deepaccident_devkit.statistics import FACTS, GROUPS, DatasetStatistics, dataset_statistics
from deepaccident_devkit.statistics.overview import Overview, overview
from deepaccident_devkit.statistics.results import TOTAL, UNKNOWN_SPLIT
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS, CATEGORIES, LIDAR, SPLITS
from deepaccident_devkit.validation.codes import CODES

JsonLd = dict[str, Any]

_CONTEXT: Final = Path(__file__).with_name(
    "croissant_context.json"
)  # the standard's own, which readers expect as a whole
_CITATION: Final = """\
@inproceedings{wang2024deepaccident,
  title = {DeepAccident: A Motion and Accident Prediction Benchmark for V2X Autonomous Driving},
  author = {Wang, Tianqi and Kim, Sukmin and Ji, Wenxuan and Xie, Enze and Ge, Chongjian and Chen, Junsong and \
Li, Zhenguo and Luo, Ping},
  booktitle = {Proceedings of the AAAI Conference on Artificial Intelligence},
  year = {2024},
  url = {https://arxiv.org/abs/2304.01168}
}"""
_SHORTCUTS: Final = {
    "length",
    "folder_right",
    "accident_frames",
    "normal_frames",
    "short",
}  # keys of FACTS
# property → its paragraphs
_RAI: Final = {
    "rai:dataCollection": """
Simulated with CARLA: designed situations at junctions, each recorded at 10 Hz by four vehicles and a roadside pole,
with six cameras, a LiDAR and a camera from above each.
""",
    "rai:dataAnnotationProtocol": """
No person annotated: boxes, ids, velocities and visibility are the simulator's own.
""",
    "rai:personalSensitiveInformation": """
None: all persons, vehicles and streets are simulated.
""",
    "rai:dataLimitations": """
What the accidents are: collisions at junctions, staged by twelve designs (1 to 6 with traffic lights, 7 to 12 without);
now and then another pair meets than was planned. Meta names the pair. The recording ends at the impact: at most 0.1 s
before it, or some tenths of a second after contact began.

What they are not: real accidents, or a sample of them. How often they happen, why, and how hard they are says nothing
of real traffic. Nothing is recorded after the impact, and neither fault nor injuries are labelled.

A folder's name says what was designed, not what happened: ask meta's first line whether there was a collision.

Velocities of boxes are the world's, turned once more by the box's yaw. Matrices jitter in the seventh digit. In one
real scenario, some 15 % of the boxes with points count other points than the cloud has, and sizes of pedestrians change
along a track.

Known exceptions of the real release:
""",
    "rai:dataBiases": """
Shortcuts: a clip of an accident is short, since it ends at the impact, and its folder's name says accident. A detector
can learn either, and know nothing of accidents. Cut normal clips to the length of their accidents; `deepaccident audit
scores` finds detectors of short clips.

Frames and agents of a scenario, and twins (an accident and the normal scenario of its name), are much alike: keep them
on one side of a split; `deepaccident check splits` finds those that are not. The mini release has names of the whole
one, with other recordings.

Measured on the real release, in brackets on what and on how many cases:
""",
    "rai:dataUseCases": """
Prediction of motion and of accidents, warnings, detection, perception by several agents (V2X), planning, forecasting.

Which numbers compare: those of one protocol, split, list of samples and set of agents. docs/protocols.md of the devkit
defines the protocols; never put two into one column. People report on val, as test has no labels.

Published numbers compare with those of the protocol `released`, of predictions given as heads: IoU, minADE, minFDE,
miss rate and APA do, VPQ probably. The time error does not: it is 0 for every model with hits. Detection by `opencood`
compares with papers that use OpenCOOD with the same sorting.

Published rates of planners' collisions compare with nothing, as nobody says how they are counted. By four public
definitions a plan that repeats the recorded accident has 0 % collisions.
""",
}
_TEXT, _BINARY, _LABELS = "text/plain", "application/octet-stream", "type*/*/label/*/*.txt"
# kind of file → its place below a split's folder or the dataroot, its format, what it holds
_FILES: Final[Mapping[str, tuple[str, str, str]]] = {
    "label": (
        _LABELS,
        _TEXT,
        "What one agent annotated at one frame: its own velocity (m/s, world), then a box a line.",
    ),
    "label_lines": (_LABELS, _TEXT, "The same files, read line by line."),
    "calib": (
        "type*/*/calib/*/*.pkl",
        _BINARY,
        "Where an agent and its sensors are: a pickle, which can run any code.",
    ),
    "meta": ("type*/meta/*.txt", _TEXT, "How a scenario was set up, and how it ended."),
    **{
        name: (f"type*/*/{name}/*/*.jpg", "image/jpeg", "Images of this camera.")
        for name in CAMERAS
    },
    LIDAR: (
        f"type*/*/{LIDAR}/*/*.npz",
        _BINARY,
        "Points: x, y, z in m, LiDAR frame, y to the right; intensity. NumPy.",
    ),
    BEV_CAMERA: (
        f"type*/*/{BEV_CAMERA}/*/*.npz",
        _BINARY,
        "±60 m from above: instances, and in channel 2 classes. NumPy.",
    ),
}
# field → its type and meaning, and of what is read in which property of files, by the group of which pattern
_OF_SPLIT: Final = {
    "name": ("sc:Text", "Of the split; unknown where neither lists nor folders say it."),
    "url": ("sc:URL", "Croissant's name of it."),
    **{
        name: ("sc:Integer", f"{name} of it here.")
        for name in ("scenarios", "frames", "samples", "annotations")
    },
}
_OF_COUNT: Final = {
    "table": ("sc:Text", "What the value is of."),
    "value": ("sc:Text", "Such as a town or a class."),
    "counted": ("sc:Text", "What is counted."),
    **{group: ("sc:Integer", f"How many: {group}.") for group in GROUPS},
}
_OF_PATH: Final = {
    "scenario_type": (
        "sc:Text",
        "Such as type1_subtype1_accident.",
        "fullpath",
        r"(?:.*/)?([^/]+)/[^/]+/label/",
    ),
    "scenario": (
        "sc:Text",
        "Its name, which occurs under several types.",
        "fullpath",
        r".*/label/([^/]+)/",
    ),
    "agent": (
        "sc:Text",
        f"Who recorded: {', '.join(AGENTS)}.",
        "fullpath",
        r"(?:.*/)?([^/]+)/label/",
    ),
    "frame": (
        "sc:Integer",
        "From 1, at 10 Hz: 0.1 s · (frame − 1) since the first.",
        "fullpath",
        r".*_(\d+)\.txt",
    ),
    "accident": (
        "sc:Text",
        "What was designed: accident or normal.",
        "fullpath",
        r".*_(accident|normal)/",
    ),
}
_OF_LINE: Final = (
    ("sc:Text", f"Class: {', '.join(CATEGORIES)}."),
    ("sc:Float", "Centre of the box, forward. m, LiDAR frame of the sample."),
    ("sc:Float", "Centre of the box, to the right. m, LiDAR frame."),
    ("sc:Float", "Centre of the box (not its bottom), up from the LiDAR. m, LiDAR frame."),
    *(("sc:Float", f"Full {size} of the box. m.") for size in ("length", "width", "height")),
    ("sc:Float", "Heading about z, clockwise seen from above. rad, LiDAR frame."),
    *(
        ("sc:Float", f"Velocity in {axis}: the world's, turned once more by yaw. m/s; may be NaN.")
        for axis in "xy"
    ),
    (
        "sc:Integer",
        "Actor, the same for all agents and frames; −100 the agent, −1 untracked, from 20000 on parked.",
    ),
    ("sc:Integer", "Points of this agent's LiDAR in the box."),
    ("sc:Boolean", "Whether any of this agent's six cameras sees it."),
)


def data_card(dataset: Dataset, *, licence: str | None = None) -> JsonLd:
    """The data card of a release as Croissant metadata; the same files give the same card, wherever they lie.

    Args:
        dataset: a release of DeepAccident. A synthetic one is described as if it were real, but for the counts.
        licence: the terms that you have the data under, better a URL. The devkit knows none: without it the card has no
            licence, and says whom to ask.

    Returns:
        JSON-LD. The record sets `splits` and `counts` hold their data, which are of what is here; `samples` and
        `annotations` are read from the label files, left-handed as these are.

    Raises:
        NotAvailableError: the release is a dataroot of nuScenes.
        ChoiceError: `licence` is blank.
    """
    if dataset.layout not in ("A", "B", "A+B"):
        raise NotAvailableError(
            f"{dataset.dataroot}: is no release of DeepAccident; only such have a data card here"
        )
    if licence is not None and not licence.strip():
        raise ChoiceError(f"licence: expected a text such as a URL, found {licence!r}")
    seen, found = overview(dataset), dataset_statistics(dataset)
    told = {
        name: [" ".join(each.split()) for each in text.split("\n\n")] for name, text in _RAI.items()
    }
    told["rai:dataLimitations"] += [
        f"{code.meaning[:-1]}: {code.known}." for code in CODES.values() if code.known
    ]
    told["rai:dataBiases"] += [
        f"{each.name}: {each.texts()[2]}" for each in FACTS if each.key in _SHORTCUTS
    ]
    text = (
        "Accidents and normal traffic at junctions in the simulator CARLA, seen by up to five agents that can "
        f"cooperate. Here are {found.scenarios[TOTAL]} scenarios, of which "
        f"{found.counts['collisions'].counts['yes'][TOTAL]:,} end in a collision, with {seen.recordings:,} recordings "
        f"of one agent each, {found.samples[TOTAL]:,} samples and {seen.tables['annotation']:,} annotated boxes."
        + ("" if licence else " The licence is not stated here; ask the dataset's authors for it.")
    )
    return {
        "@context": json.loads(_CONTEXT.read_bytes()),
        "@type": "sc:Dataset",
        "name": "DeepAccident" + dataset.version.removeprefix("v1"),
        "description": text,
        "conformsTo": [
            "http://mlcommons.org/croissant/1.0",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        **({"license": licence} if licence else {}),
        "citeAs": _CITATION,
        "datePublished": "2024",
        "keywords": [
            "autonomous driving",
            "V2X",
            "accident prediction",
            "motion prediction",
            "CARLA",
        ],
        "url": "https://deepaccident.github.io/",
        "version": dataset.version.replace("v1", "1.0.0"),
        **{name: texts if len(texts) > 1 else texts[0] for name, texts in told.items()},
        "rai:dataCollectionType": "Software Collection",
        "rai:dataCollectionMissingData": "The test split was published without labels and cameras from above. Here, "
        f"{found.unlabelled[TOTAL]} scenarios have no labels, and {len(seen.left_out)} are left out as broken.",
        "distribution": _distribution(dataset, seen),
        "recordSet": [_splits(found), _counts(dataset, found), *_of_labels(dataset)],
    }


def _distribution(dataset: Dataset, seen: Overview) -> list[JsonLd]:
    """A file set for each kind of file that is here."""
    folders = sorted({f"{each['folder']}/".lstrip("/") for each in dataset.scenario[:]})
    here = {
        name: f" {number:,} of {seen.samples:,} are here." for name, number in seen.files.items()
    }
    sets = [
        _node(
            "FileSet",
            name,
            text + here.get(name, ""),
            encodingFormat=form,
            includes=[each + place for each in folders],
        )
        for name, (place, form, text) in _FILES.items()
        if seen.files.get(name, 1)
    ]
    lists = [f"{folder}{name}" for folder in ("", f"{SPLIT_FILE_FOLDER}/") for name in SPLIT_FILES]
    includes = [name for name in lists if (dataset.dataroot / name).is_file()]
    if includes:
        text = "The scenarios of a split: <scenario_type> <scenario>."
        sets.append(_node("FileSet", "split_lists", text, encodingFormat=_TEXT, includes=includes))
    return sets


def _splits(found: DatasetStatistics) -> JsonLd:
    boxes = {group: found.counts["annotations"].total(group) for group in GROUPS}
    urls = {"train": "cr:TrainingSplit", "val": "cr:ValidationSplit", "test": "cr:TestSplit"}
    rows = [
        (
            split,
            urls.get(split),
            *(each[split] for each in (found.scenarios, found.frames, found.samples, boxes)),
        )
        for split in (*SPLITS, UNKNOWN_SPLIT)
        if split in SPLITS or found.scenarios[split]
    ]
    made = _records("splits", "The official splits, and how much of each is here.", _OF_SPLIT, rows)
    return {**made, "dataType": "cr:Split", "key": {"@id": "splits/name"}}


def _counts(dataset: Dataset, found: DatasetStatistics) -> JsonLd:
    splits = {each["token"]: each["split"] or UNKNOWN_SPLIT for each in dataset.scenario[:]}
    recorded = Counter(
        (each["name"], of)
        for each in dataset.agent[:]
        for of in (TOTAL, splits[each["scenario_token"]])
    )
    tables: dict[str, tuple[str, Mapping[str, Mapping[str, int]]]] = {
        "agents": (
            "scenarios",
            {name: {group: recorded[name, group] for group in GROUPS} for name in AGENTS},
        ),
        **{each.name: (each.counted, each.counts) for each in found.counts.values()},
    }
    rows = [
        (table, value, counted, *numbers.values())
        for table, (counted, counts) in tables.items()
        for value, numbers in counts.items()
        if numbers[TOTAL]
    ]
    return _records(
        "counts",
        "What is here, by split; `deepaccident info --statistics` has more.",
        _OF_COUNT,
        rows,
    )


def _of_labels(dataset: Dataset) -> list[JsonLd]:
    """Samples by the paths of their label files, and annotations by the lines of these."""
    of_path = dict(_OF_PATH)
    if all(each["folder"] in SPLITS for each in dataset.scenario[:]):
        of_path["split"] = ("sc:Text", "By the folder.", "fullpath", f"({'|'.join(SPLITS)})/")
    of_line = {
        name: (
            *how,
            "lines",
            rf"(?:\S+ ){{{place}}}(\S+)(?: \S+){{{len(LABEL_FIELDS) - place - 1}}}$",
        )
        for place, (name, how) in enumerate(zip(LABEL_FIELDS, _OF_LINE, strict=True))
    }
    return [
        _records(
            "samples",
            "One agent at one moment, where it has a label. Its split is that of the scenario's list, or folder.",
            of_path,
            files="label",
        ),
        _records(
            "annotations",
            "A box as one agent annotated it, left-handed as in the file. A file's first line is no box, and fits no "
            "pattern: mlcroissant, which cannot leave out a line, stops there. In Python, "
            "deepaccident_devkit.release.read_label reads a file, and DeepAccident all of them, right-handed.",
            {**of_path, **of_line},
            files="label_lines",
        ),
    ]


def _records(
    name: str,
    text: str,
    fields: Mapping[str, tuple[str, ...]],
    rows: Iterable[tuple[Any, ...]] = (),
    files: str = "",
) -> JsonLd:
    """A record set that holds rows of its fields, or whose fields are read in files."""
    made = [
        _node("Field", f"{name}/{field}", meaning, dataType=kind)
        | (
            {
                "source": {
                    "fileSet": {"@id": files},
                    "extract": {"fileProperty": how[0]},
                    "transform": {"regex": how[1]},
                }
            }
            if how
            else {}
        )
        for field, (kind, meaning, *how) in fields.items()
    ]
    data = [dict(zip((field["@id"] for field in made), row, strict=True)) for row in rows]
    return _node("RecordSet", name, text, field=made, **({"data": data} if data else {}))


def _node(kind: str, name: str, text: str, **more: Any) -> JsonLd:
    return {
        "@type": f"cr:{kind}",
        "@id": name,
        "name": name.rpartition("/")[2],
        "description": text,
        **more,
    }
