"""The data card of a release as Croissant metadata (JSON-LD): content, known faults, comparisons.

Croissant 1.0, with the fields of its extension for responsible AI, RAI 1.0. Paths are relative to
the dataroot.
"""

from __future__ import annotations

import json
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

# The standard's own context, which readers expect completely.
_CONTEXT_PATH: Final = Path(__file__).with_name("croissant_context.json")
_CITATION: Final = """\
@inproceedings{wang2024deepaccident,
  title = {DeepAccident: A Motion and Accident Prediction Benchmark for V2X Autonomous Driving},
  author = {Wang, Tianqi and Kim, Sukmin and Ji, Wenxuan and Xie, Enze and Ge, Chongjian and \
Chen, Junsong and Li, Zhenguo and Luo, Ping},
  booktitle = {Proceedings of the AAAI Conference on Artificial Intelligence},
  year = {2024},
  url = {https://arxiv.org/abs/2304.01168}
}"""
# Keys of the facts that detectors can take shortcuts by.
_SHORTCUT_FACTS: Final = {
    "length",
    "folder_right",
    "accident_frames",
    "normal_frames",
    "short",
}
# Property → its paragraphs.
_RAI_TEXTS: Final = {
    "rai:dataCollection": """
Simulated with CARLA: designed situations at junctions, each recorded at 10 Hz by four vehicles
and a roadside pole, with six cameras, a LiDAR and a camera from above each.
""",
    "rai:dataAnnotationProtocol": """
No person annotated: boxes, ids, velocities and visibility are the simulator's own.
""",
    "rai:personalSensitiveInformation": """
None: all persons, vehicles and streets are simulated.
""",
    "rai:dataLimitations": """
What the accidents are: collisions at junctions, staged by twelve designs (1 to 6 with traffic
lights, 7 to 12 without); now and then another pair meets than was planned. Meta names the pair.
The recording ends at the impact: at most 0.1 s before it, or some tenths of a second after
contact began.

What they are not: real accidents, or a sample of them. How often they happen, why, and how hard
they are says nothing of real traffic. Nothing is recorded after the impact, and neither fault nor
injuries are labelled.

A folder's name says what was designed, not what happened: ask meta's first line whether there was
a collision.

Velocities of boxes are the world's, turned once more by the box's yaw. Matrices jitter in the
seventh digit. In one real scenario, some 15 % of the boxes with points count other points than
the cloud has, and sizes of pedestrians change along a track.

Known exceptions of the real release:
""",
    "rai:dataBiases": """
Shortcuts: a clip of an accident is short, since it ends at the impact, and its folder's name says
accident. A detector can learn either, and know nothing of accidents. Cut normal clips to the
length of their accidents; `deepaccident audit scores` finds detectors of short clips.

Frames and agents of a scenario, and twins (an accident and the normal scenario of its name), are
much alike: keep them on one side of a split; `deepaccident check splits` finds those that are
not. The mini release has names of the whole one, with other recordings.

Measured on the real release, in brackets on what and on how many cases:
""",
    "rai:dataUseCases": """
Prediction of motion and of accidents, warnings, detection, perception by several agents (V2X),
planning, forecasting.

Which numbers compare: those of one protocol, split, list of samples and set of agents.
docs/protocols.md of the devkit defines the protocols; never put two into one column. People
report on val, as test has no labels.

Published numbers compare with those of the protocol `released`, of predictions given as heads:
IoU, minADE, minFDE, miss rate and APA do, VPQ probably. The time error does not: it is 0 for
every model with hits. Detection by `opencood` compares with papers that use OpenCOOD with the
same sorting.

Published rates of planners' collisions compare with nothing, as nobody says how they are counted.
By four public definitions a plan that repeats the recorded accident has 0 % collisions.
""",
}
_TEXT_FORMAT: Final = "text/plain"
_BINARY_FORMAT: Final = "application/octet-stream"
_LABEL_PATTERN: Final = "type*/*/label/*/*.txt"
# Kind of file → its path in a split's folder or the dataroot, its format, its content.
_FILE_SETS: Final[Mapping[str, tuple[str, str, str]]] = {
    "label": (
        _LABEL_PATTERN,
        _TEXT_FORMAT,
        "What one agent annotated at one frame: its own velocity (m/s, world), then a box a line.",
    ),
    "label_lines": (_LABEL_PATTERN, _TEXT_FORMAT, "The same files, read line by line."),
    "calib": (
        "type*/*/calib/*/*.pkl",
        _BINARY_FORMAT,
        "Where an agent and its sensors are: a pickle, which can run any code.",
    ),
    "meta": ("type*/meta/*.txt", _TEXT_FORMAT, "How a scenario was set up, and how it ended."),
    **{
        name: (f"type*/*/{name}/*/*.jpg", "image/jpeg", "Images of this camera.")
        for name in CAMERAS
    },
    LIDAR: (
        f"type*/*/{LIDAR}/*/*.npz",
        _BINARY_FORMAT,
        "Points: x, y, z in m, LiDAR frame, y to the right; intensity. NumPy.",
    ),
    BEV_CAMERA: (
        f"type*/*/{BEV_CAMERA}/*/*.npz",
        _BINARY_FORMAT,
        "±60 m from above: instances, and in channel 2 classes. NumPy.",
    ),
}
# Field → its type and meaning; of fields that are read from files, also the property of the file
# and the pattern, with the value as its group.
_SPLIT_FIELDS: Final = {
    "name": ("sc:Text", "Of the split; unknown where neither lists nor folders say it."),
    "url": ("sc:URL", "Croissant's name of it."),
    **{
        name: ("sc:Integer", f"{name} of it here.")
        for name in ("scenarios", "frames", "samples", "annotations")
    },
}
_COUNT_FIELDS: Final = {
    "table": ("sc:Text", "What the value is of."),
    "value": ("sc:Text", "Such as a town or a class."),
    "counted": ("sc:Text", "What is counted."),
    **{group: ("sc:Integer", f"How many: {group}.") for group in GROUPS},
}
_PATH_FIELDS: Final = {
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
_LINE_FIELDS: Final = (
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
        (
            "Actor, the same for all agents and frames; −100 the agent, −1 untracked, "
            "from 20000 on parked."
        ),
    ),
    ("sc:Integer", "Points of this agent's LiDAR in the box."),
    ("sc:Boolean", "Whether any of this agent's six cameras sees it."),
)


def data_card(dataset: Dataset, *, licence: str | None = None) -> JsonLd:
    """Return the data card of a release as Croissant metadata.

    The same files give the same card, wherever they lie.

    Args:
        dataset: A release of DeepAccident. A synthetic one is described like the real release,
            except for its counts.
        licence: Terms that you have the data under, preferably a URL. The devkit knows none:
            without it the card has no licence, and refers to the dataset's authors.

    Returns:
        JSON-LD. The record sets `splits` and `counts` hold their data, for the present files;
        `samples` and `annotations` are read from the label files, and are left-handed like these.

    Raises:
        NotAvailableError: The release is a dataroot of nuScenes.
        ChoiceError: `licence` is blank.
    """
    if dataset.layout not in ("A", "B", "A+B"):
        raise NotAvailableError(
            f"{dataset.dataroot}: is no release of DeepAccident; only such have a data card here"
        )
    if licence is not None and not licence.strip():
        raise ChoiceError(f"licence: expected a text such as a URL, found {licence!r}")
    counts = overview(dataset)
    statistics = dataset_statistics(dataset)
    card = {
        "@context": json.loads(_CONTEXT_PATH.read_bytes()),
        "@type": "sc:Dataset",
        "name": "DeepAccident" + dataset.version.removeprefix("v1"),
        "description": _describe(counts, statistics, with_licence=bool(licence)),
        "conformsTo": [
            "http://mlcommons.org/croissant/1.0",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
    }
    if licence:
        card["license"] = licence
    missing_data = (
        "The test split was published without labels and cameras from above. Here, "
        f"{statistics.unlabelled[TOTAL]} scenarios have no labels, and "
        f"{len(counts.left_out)} are left out as broken."
    )
    return card | {
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
        **_responsible_ai(),
        "rai:dataCollectionType": "Software Collection",
        "rai:dataCollectionMissingData": missing_data,
        "distribution": _distribution(dataset, counts),
        "recordSet": [
            _split_records(statistics),
            _count_records(dataset, statistics),
            *_label_records(dataset),
        ],
    }


def _describe(counts: Overview, statistics: DatasetStatistics, *, with_licence: bool) -> str:
    collisions = statistics.counts["collisions"].counts["yes"][TOTAL]
    text = (
        "Accidents and normal traffic at junctions in the simulator CARLA, seen by up to five "
        "agents that can cooperate. "
        f"Here are {statistics.scenarios[TOTAL]} scenarios, of which {collisions:,} end in a "
        f"collision, with {counts.recordings:,} recordings of one agent each, "
        f"{statistics.samples[TOTAL]:,} samples and {counts.tables['annotation']:,} annotated "
        "boxes."
    )
    if not with_licence:
        text += " The licence is not stated here; ask the dataset's authors for it."
    return text


def _responsible_ai() -> dict[str, str | list[str]]:
    """Return the properties of RAI 1.0, a text or a list of paragraphs each."""
    paragraphs = {}
    for name, text in _RAI_TEXTS.items():
        paragraphs[name] = [" ".join(paragraph.split()) for paragraph in text.split("\n\n")]
    for code in CODES.values():
        if code.known:
            paragraphs["rai:dataLimitations"].append(f"{code.meaning[:-1]}: {code.known}.")
    for fact in FACTS:
        if fact.key in _SHORTCUT_FACTS:
            paragraphs["rai:dataBiases"].append(f"{fact.name}: {fact.texts()[2]}")
    return {name: texts if len(texts) > 1 else texts[0] for name, texts in paragraphs.items()}


def _distribution(dataset: Dataset, counts: Overview) -> list[JsonLd]:
    """Return a file set for each kind of file that the release has."""
    folders = sorted({f"{scenario['folder']}/".lstrip("/") for scenario in dataset.scenario[:]})
    file_sets = []
    for name, (pattern, file_format, content) in _FILE_SETS.items():
        if not counts.files.get(name, 1):
            continue
        text = content
        if name in counts.files:
            text += f" {counts.files[name]:,} of {counts.samples:,} are here."
        includes = [folder + pattern for folder in folders]
        file_sets.append(
            _make_node("FileSet", name, text, encodingFormat=file_format, includes=includes)
        )
    paths = [f"{folder}{name}" for folder in ("", f"{SPLIT_FILE_FOLDER}/") for name in SPLIT_FILES]
    includes = [path for path in paths if (dataset.dataroot / path).is_file()]
    if includes:
        text = "The scenarios of a split: <scenario_type> <scenario>."
        file_sets.append(
            _make_node(
                "FileSet", "split_lists", text, encodingFormat=_TEXT_FORMAT, includes=includes
            )
        )
    return file_sets


def _split_records(statistics: DatasetStatistics) -> JsonLd:
    annotations = statistics.counts["annotations"]
    urls = {"train": "cr:TrainingSplit", "val": "cr:ValidationSplit", "test": "cr:TestSplit"}
    rows = []
    for split in (*SPLITS, UNKNOWN_SPLIT):
        if split in SPLITS or statistics.scenarios[split]:
            row = (
                split,
                urls.get(split),
                statistics.scenarios[split],
                statistics.frames[split],
                statistics.samples[split],
                annotations.total(split),
            )
            rows.append(row)
    text = "The official splits, and how much of each is here."
    records = _make_records("splits", text, _SPLIT_FIELDS, rows)
    return {**records, "dataType": "cr:Split", "key": {"@id": "splits/name"}}


def _count_records(dataset: Dataset, statistics: DatasetStatistics) -> JsonLd:
    split_of = {
        scenario["token"]: scenario["split"] or UNKNOWN_SPLIT for scenario in dataset.scenario[:]
    }
    agent_counts: dict[str, dict[str, int]] = {name: dict.fromkeys(GROUPS, 0) for name in AGENTS}
    for agent in dataset.agent[:]:
        agent_counts[agent["name"]][TOTAL] += 1
        agent_counts[agent["name"]][split_of[agent["scenario_token"]]] += 1
    tables: dict[str, tuple[str, Mapping[str, Mapping[str, int]]]]
    tables = {"agents": ("scenarios", agent_counts)}
    tables |= {table.name: (table.counted, table.counts) for table in statistics.counts.values()}
    rows = []
    for table_name, (counted, counts) in tables.items():
        for value, numbers in counts.items():
            if numbers[TOTAL]:
                rows.append((table_name, value, counted, *numbers.values()))
    text = "What is here, by split; `deepaccident info --statistics` has more."
    return _make_records("counts", text, _COUNT_FIELDS, rows)


def _label_records(dataset: Dataset) -> list[JsonLd]:
    """Return samples by the paths of their label files, and annotations by the lines of these."""
    path_fields = dict(_PATH_FIELDS)
    if all(scenario["folder"] in SPLITS for scenario in dataset.scenario[:]):
        path_fields["split"] = ("sc:Text", "By the folder.", "fullpath", f"({'|'.join(SPLITS)})/")
    line_fields = {}
    for index, (name, kind_and_meaning) in enumerate(zip(LABEL_FIELDS, _LINE_FIELDS, strict=True)):
        fields_after = len(LABEL_FIELDS) - index - 1
        pattern = rf"(?:\S+ ){{{index}}}(\S+)(?: \S+){{{fields_after}}}$"
        line_fields[name] = (*kind_and_meaning, "lines", pattern)
    return [
        _make_records(
            "samples",
            "One agent at one moment, where it has a label. Its split is that of the scenario's "
            "list, or folder.",
            path_fields,
            files="label",
        ),
        _make_records(
            "annotations",
            "A box as one agent annotated it, left-handed as in the file. A file's first line is "
            "no box, and fits no pattern: mlcroissant, which cannot leave out a line, stops there. "
            "In Python, deepaccident_devkit.release.read_label reads a file, and DeepAccident all "
            "of them, right-handed.",
            {**path_fields, **line_fields},
            files="label_lines",
        ),
    ]


def _make_records(
    name: str,
    text: str,
    fields: Mapping[str, tuple[str, ...]],
    rows: Iterable[tuple[Any, ...]] = (),
    files: str = "",
) -> JsonLd:
    """Return a record set with rows of its fields, or with fields that are read from files."""
    nodes = []
    for field, (kind, meaning, *source) in fields.items():
        node = _make_node("Field", f"{name}/{field}", meaning, dataType=kind)
        if source:
            file_property, pattern = source
            node["source"] = {
                "fileSet": {"@id": files},
                "extract": {"fileProperty": file_property},
                "transform": {"regex": pattern},
            }
        nodes.append(node)
    records = _make_node("RecordSet", name, text, field=nodes)
    ids = [node["@id"] for node in nodes]
    data = [dict(zip(ids, row, strict=True)) for row in rows]
    if data:
        records["data"] = data
    return records


def _make_node(kind: str, name: str, text: str, **properties: Any) -> JsonLd:
    return {
        "@type": f"cr:{kind}",
        "@id": name,
        "name": name.rpartition("/")[2],
        "description": text,
        **properties,
    }
