"""A release's data card as Croissant metadata (JSON-LD): content, known faults, comparisons.

Croissant 1.0, with the fields of its extension for responsible AI, RAI 1.0. Paths are relative to
the dataroot.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.release.labels import LABEL_FIELDS
from deepaccident_devkit.release.store.members import SPLIT_FILE_FOLDER, SPLIT_FILES
from deepaccident_devkit.statistics import FACTS, GROUPS, DatasetStatistics, dataset_statistics
from deepaccident_devkit.statistics.overview import Overview, overview
from deepaccident_devkit.statistics.results import TOTAL, UNKNOWN_SPLIT
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS, CATEGORIES, LIDAR, SPLITS
from deepaccident_devkit.validation.codes import CODES

JsonLd = dict[str, Any]

# The standard JSON-LD context; readers expect all of it.
_CONTEXT_PATH = Path(__file__).with_name("croissant_context.json")
_CITATION = """\
@inproceedings{wang2024deepaccident,
  title = {DeepAccident: A Motion and Accident Prediction Benchmark for V2X Autonomous Driving},
  author = {Wang, Tianqi and Kim, Sukmin and Ji, Wenxuan and Xie, Enze and Ge, Chongjian and \
Chen, Junsong and Li, Zhenguo and Luo, Ping},
  booktitle = {Proceedings of the AAAI Conference on Artificial Intelligence},
  year = {2024},
  url = {https://arxiv.org/abs/2304.01168}
}"""
# Keys of the facts that give detectors shortcuts.
_SHORTCUT_FACTS = {
    "length",
    "folder_right",
    "accident_frames",
    "normal_frames",
    "short",
}
# Property of RAI → its paragraphs.
_RAI_TEXTS = {
    "rai:dataCollection": """
The data were simulated with CARLA. Designed situations at junctions were recorded at 10 Hz by four
vehicles and a roadside pole, each with six cameras, a LiDAR and a camera from above.
""",
    "rai:dataAnnotationProtocol": """
There was no human annotation: boxes, ids, velocities and visibility come from the simulator.
""",
    "rai:personalSensitiveInformation": """
None: all persons, vehicles and streets are simulated.
""",
    "rai:dataLimitations": """
The accidents are collisions at junctions, staged by twelve designs (1 to 6 with traffic lights, 7
to 12 without). Sometimes a different pair collides than was planned; meta names the pair. The
recording ends at the impact, from 0.1 s before it to a few tenths of a second after the contact
began.

The accidents are neither real nor a sample of real accidents. Their frequency, causes and severity
say nothing about real traffic. Nothing is recorded after the impact, and neither fault nor injuries
are labelled.

The name of a folder says what was designed, not what happened. The first line of meta says whether
there was a collision.

Velocities of boxes are world velocities, rotated once more by the yaw of the box. Matrices jitter
in the seventh digit. In one real scenario, about 15 % of the boxes with points have labels that
count a different number of points than the cloud contains, and sizes of pedestrians change along a
track.

Known exceptions of the real release:
""",
    "rai:dataBiases": """
There are shortcuts: the clip of an accident is short, as it ends at the impact, and its folder's
name says accident. A detector can learn either shortcut without learning anything about accidents.
Cut normal clips to the length of their accidents; `deepaccident check scores` finds detectors of
short clips.

Frames and agents of a scenario, and twins (an accident and the normal scenario of the same name),
are very similar. Keep them on one side of a split; `deepaccident check splits` finds those that are
on two sides. The mini release uses the names of the full release for other recordings.

Measured on the real release (the brackets say on what, and on how many cases):
""",
    "rai:dataUseCases": """
The data are for the prediction of motion and of accidents, warnings, detection, cooperative
perception (V2X), planning and forecasting.

Numbers can be compared only within one protocol, split, list of samples and set of agents.
docs/protocols.md of the devkit defines the protocols; never put two protocols into one column.
Publications report results on val, as test has no labels.

Published numbers can be compared with the protocol `released` on predictions given as heads: IoU,
minADE, minFDE, miss rate and APA for certain, VPQ probably. The time error cannot be compared, as
it is 0 for every model with hits. Detection by `opencood` can be compared with papers that use
OpenCOOD with the same sorting.

Published collision rates of planners cannot be compared, as no publication says how collisions are
counted. By four public definitions, a plan that repeats the recorded accident has 0 % collisions.
""",
}
_TEXT_FORMAT = "text/plain"
_BINARY_FORMAT = "application/octet-stream"
_LABEL_PATTERN = "type*/*/label/*/*.txt"
# Kind of file → its path in a split's folder or in the dataroot, its format, its content.
_FILE_SETS = {
    "label": (
        _LABEL_PATTERN,
        _TEXT_FORMAT,
        "Labels of one agent in one frame: its own velocity (m/s, world), then one box per line.",
    ),
    "label_lines": (_LABEL_PATTERN, _TEXT_FORMAT, "The same files, read line by line."),
    "calib": (
        "type*/*/calib/*/*.pkl",
        _BINARY_FORMAT,
        "Poses of an agent and its sensors, as a pickle, which can run any code.",
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
# Field → its type and meaning. Fields that are read from files also have the property of the file
# and the pattern whose group is the value.
_SPLIT_FIELDS = {
    "name": ("sc:Text", "Name of the split; unknown if neither lists nor folders say it."),
    "url": ("sc:URL", "Croissant's name of it."),
    **{
        name: ("sc:Integer", f"{name} of it here.")
        for name in ("scenarios", "frames", "samples", "annotations")
    },
}
_COUNT_FIELDS = {
    "table": ("sc:Text", "What the value is of."),
    "value": ("sc:Text", "Value, such as a town or a class."),
    "counted": ("sc:Text", "What is counted."),
    **{group: ("sc:Integer", f"How many: {group}.") for group in GROUPS},
}
_PATH_FIELDS = {
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
        f"Agent that recorded: {', '.join(AGENTS)}.",
        "fullpath",
        r"(?:.*/)?([^/]+)/label/",
    ),
    "frame": (
        "sc:Integer",
        "Number of the frame, from 1, at 10 Hz; its time is 0.1 s · (frame − 1).",
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
_LINE_FIELDS = (
    ("sc:Text", f"Class: {', '.join(CATEGORIES)}."),
    ("sc:Float", "Centre of the box, forward. m, LiDAR frame of the sample."),
    ("sc:Float", "Centre of the box, to the right. m, LiDAR frame."),
    ("sc:Float", "Centre of the box (not its bottom), up from the LiDAR. m, LiDAR frame."),
    *(("sc:Float", f"Full {size} of the box. m.") for size in ("length", "width", "height")),
    ("sc:Float", "Heading about z, clockwise seen from above. rad, LiDAR frame."),
    *(
        (
            "sc:Float",
            f"Velocity in {axis}: the world's, rotated once more by yaw. m/s; may be NaN.",
        )
        for axis in "xy"
    ),
    (
        "sc:Integer",
        (
            "Id of the actor, the same for all agents and frames; −100 is the agent itself, −1 "
            "is untracked, and ids from 20000 are parked vehicles."
        ),
    ),
    ("sc:Integer", "Points of this agent's LiDAR in the box."),
    ("sc:Boolean", "Whether any of this agent's six cameras sees it."),
)


def data_card(dataset: Dataset, *, licence: str | None = None) -> JsonLd:
    """Describe a release as a data card in Croissant metadata.

    Identical files yield identical cards, wherever they are stored.

    Args:
        dataset: A DeepAccident release. A synthetic one is described like the real release, except
            for its counts.
        licence: Terms under which you have the data, preferably as a URL. The devkit does not know
            them: if None, the card has no licence, and refers to the dataset's authors.

    Returns:
        JSON-LD. The record sets `splits` and `counts` contain their data, for the present files.
        `samples` and `annotations` are read from the label files, and left-handed like these.

    Raises:
        NotAvailableError: If the release is a nuScenes dataroot.
        ChoiceError: If `licence` is blank.
    """
    if dataset.layout not in ("A", "B", "A+B"):
        raise NotAvailableError(
            f"{dataset.dataroot}: is not a DeepAccident release, and only these have a data card"
        )
    if licence is not None and not licence.strip():
        raise ChoiceError(f"licence: expected a text such as a URL, found {licence!r}")
    counts = overview(dataset)
    statistics = dataset_statistics(dataset)
    card = {
        "@context": json.loads(_CONTEXT_PATH.read_bytes()),
        "@type": "sc:Dataset",
        "name": "DeepAccident" + dataset.version.removeprefix("v1"),
        "description": _describe_release(counts, statistics, with_licence=bool(licence)),
        "conformsTo": [
            "http://mlcommons.org/croissant/1.0",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
    }
    if licence:
        card["license"] = licence
    missing_data = (
        "The test split was published without labels and cameras from above. In this "
        f"copy, {counted(statistics.unlabelled[TOTAL], 'scenario')} without labels; "
        f"{counted(len(counts.left_out), 'broken scenario')} excluded."
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
        **_rai_properties(),
        "rai:dataCollectionType": "Software Collection",
        "rai:dataCollectionMissingData": missing_data,
        "distribution": _make_file_sets(dataset, counts),
        "recordSet": [
            _split_records(statistics),
            _count_records(dataset, statistics),
            *_label_records(dataset),
        ],
    }


def _describe_release(
    counts: Overview, statistics: DatasetStatistics, *, with_licence: bool
) -> str:
    collisions = statistics.counts["collisions"].counts["yes"][TOTAL]
    text = (
        "Accidents and normal traffic at junctions in the simulator CARLA, seen by up to five "
        "agents that can cooperate. "
        f"This copy contains {counted(statistics.scenarios[TOTAL], 'scenario')} "
        f"({collisions:,} with a collision), {counted(counts.recordings, 'recording')} of one "
        f"agent each, {counted(statistics.samples[TOTAL], 'sample')} and "
        f"{counted(counts.tables['annotation'], 'annotation')}."
    )
    if not with_licence:
        text += " The licence is not stated here; ask the authors of the dataset."
    return text


def _rai_properties() -> dict[str, str | list[str]]:
    """Return the RAI 1.0 properties, each as a text or a list of paragraphs."""
    paragraphs = {}
    for name, text in _RAI_TEXTS.items():
        paragraphs[name] = [" ".join(paragraph.split()) for paragraph in text.split("\n\n")]
    for code in CODES.values():
        if code.known:
            paragraphs["rai:dataLimitations"].append(f"{code.meaning[:-1]}: {code.known}.")
    for fact in FACTS:
        if fact.key in _SHORTCUT_FACTS:
            paragraphs["rai:dataBiases"].append(f"{fact.name}: {fact.texts()[2]}")
    properties: dict[str, str | list[str]] = {}
    for name, texts in paragraphs.items():
        properties[name] = texts
        if len(texts) == 1:
            properties[name] = texts[0]
    return properties


def _make_file_sets(dataset: Dataset, counts: Overview) -> list[JsonLd]:
    """Return a file set for each kind of file in the release."""
    folders = {f"{scenario['folder']}/".lstrip("/") for scenario in dataset.scenario[:]}
    file_sets = []
    for name, (pattern, file_format, content) in _FILE_SETS.items():
        if not counts.files.get(name, 1):
            continue
        text = content
        if name in counts.files:
            text += f" {counts.files[name]:,} of {counts.samples:,} are here."
        includes = [folder + pattern for folder in sorted(folders)]
        file_sets.append(_make_file_set(name, text, file_format, includes))
    includes = []
    for folder in ("", f"{SPLIT_FILE_FOLDER}/"):
        for name in SPLIT_FILES:
            path = f"{folder}{name}"
            if (dataset.dataroot / path).is_file():
                includes.append(path)
    if includes:
        text = "The scenarios of a split: <scenario_type> <scenario>."
        file_sets.append(_make_file_set("split_lists", text, _TEXT_FORMAT, includes))
    return file_sets


def _make_file_set(name: str, text: str, file_format: str, includes: list[str]) -> JsonLd:
    """Return a file set with the path patterns of its files."""
    return _make_node("FileSet", name, text, encodingFormat=file_format, includes=includes)


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
    split_of = {}
    for scenario in dataset.scenario[:]:
        split_of[scenario["token"]] = scenario["split"] or UNKNOWN_SPLIT
    agent_counts: dict[str, dict[str, int]] = {name: dict.fromkeys(GROUPS, 0) for name in AGENTS}
    for agent in dataset.agent[:]:
        counts_by_group = agent_counts[agent["name"]]
        counts_by_group[TOTAL] += 1
        counts_by_group[split_of[agent["scenario_token"]]] += 1
    tables: dict[str, tuple[str, Mapping[str, Mapping[str, int]]]]
    tables = {"agents": ("scenarios", agent_counts)}
    for table in statistics.counts.values():
        tables[table.name] = (table.counted, table.counts)
    rows = []
    for table_name, (subject, counts) in tables.items():
        for value, numbers in counts.items():
            if numbers[TOTAL]:
                rows.append((table_name, value, subject, *numbers.values()))
    text = "Contents of this copy by split; `deepaccident info --statistics` prints more."
    return _make_records("counts", text, _COUNT_FIELDS, rows)


def _label_records(dataset: Dataset) -> list[JsonLd]:
    """Return the record sets of samples (one per label file) and annotations (one per line)."""
    path_fields = dict(_PATH_FIELDS)
    if all(scenario["folder"] in SPLITS for scenario in dataset.scenario[:]):
        path_fields["split"] = ("sc:Text", "By the folder.", "fullpath", f"({'|'.join(SPLITS)})/")
    line_fields = {}
    fields = zip(LABEL_FIELDS, _LINE_FIELDS, strict=True)
    for fields_before, (name, kind_and_meaning) in enumerate(fields):
        fields_after = len(LABEL_FIELDS) - fields_before - 1
        pattern = rf"(?:\S+ ){{{fields_before}}}(\S+)(?: \S+){{{fields_after}}}$"
        line_fields[name] = (*kind_and_meaning, "lines", pattern)
    return [
        _make_records(
            "samples",
            "One agent at one moment that has a label. The split comes from the scenario's list "
            "or folder.",
            path_fields,
            files="label",
        ),
        _make_records(
            "annotations",
            "A box as one agent annotated it, left-handed as in the file. A file's first line "
            "is not a box and fits no pattern, so mlcroissant, which cannot skip a line, stops "
            "there. In Python, deepaccident_devkit.release.read_label reads one file, and "
            "DeepAccident reads all files, right-handed.",
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
    """Return a record set; its values are either `rows`, or read from `files`."""
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
