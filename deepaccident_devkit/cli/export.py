"""`deepaccident export`: data in other tools' formats. Only the written format is imported."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from deepaccident_devkit.cli.agents import (
    agent_names,
    agents_parameter,
    cooperating_parameter,
    names_or_configuration,
)
from deepaccident_devkit.cli.options import (
    PATH,
    channels_parameter,
    engine_of,
    frame_range_parameter,
    refuse_unused,
    release_parameters,
    where_parameter,
    words_of,
)
from deepaccident_devkit.cli.verbs import (
    LazyVerbs,
    WordChoice,
    advanced,
    field_option,
    together,
    verb,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.motion import PRESETS
from deepaccident_devkit.support.plugins import LazyFormat, LazyVerb, Plugin
from deepaccident_devkit.support.text import choice, counted, size_text
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, CATEGORIES, LIDAR, VEHICLE_AGENTS
from deepaccident_devkit.v2x.collisions import default_scenario

if TYPE_CHECKING:
    from deepaccident_devkit.export.bulk import Tally

_CONTINUED: Final = "If a run is interrupted, the same command continues it."
_LINK_NAMES: Final = {"hard": "hard links", "symbolic": "symbolic links", "copy": "copies"}
link_parameter = advanced(
    "--link",
    type=WordChoice(_LINK_NAMES),
    default="hard",
    show_default=True,
    help="How images are put there: hard links, else symbolic ones, else copies.",
)


def bulk_parameters(agents: Callable[[Any], Any] = agents_parameter) -> Callable[[Any], Any]:
    """Return a release's parameters, --out, --split, --where, --agents and --dry-run.

    `agents` adds --agents to a verb that gives it another meaning.
    """
    return together(
        release_parameters,
        click.option(
            "--out", required=True, type=PATH, metavar="FOLDER", help="Folder to write into."
        ),
        click.option(
            "--split",
            help="Only this split: train, val, test, …, or a split file (.txt).  [default: all]",
        ),
        where_parameter,
        agents,
        click.option("--dry-run", is_flag=True, help="Only say how much would be written."),
    )


def run_export(
    kind: Callable[..., Any],
    own: dict[str, Any],
    *,
    out: Path,
    split: str | None,
    where: tuple[str, ...],
    agents: tuple[str, ...],
    link: str = "hard",
    dry_run: bool,
    **release: Any,
) -> None:
    """Export in a format with its `own` settings.

    Prints an estimate of the size, then what was written and left out.
    """
    from deepaccident_devkit.export.bulk import export_release

    # before the release is indexed
    form = kind(split=split, where=where, agents=agent_names(agents), link=link, **own)
    dataset = DeepAccident(**release)
    estimate = export_release(dataset, out, form, dry_run=True)
    if estimate.written:
        _print_estimate(estimate.tally, estimate.folder, out)
    if dry_run:
        return
    done = export_release(dataset, out, form, **engine_of(release), progress=True)
    linked_text = "".join(
        f", {count:,} files as {_LINK_NAMES[name]}"
        for name, count in sorted(done.tally.linked.items())
    )
    units = f"{counted(done.written, form.unit_word)} written now, {done.kept:,} were there already"
    click.echo(f"{done.folder}: {_counts(done.tally, 'written')}{linked_text}; {units}")
    for name, count in sorted(done.tally.left_out.items()):
        click.echo(f"left out: {count:,} {name}")


def _print_estimate(tally: "Tally", folder: Path, out: Path) -> None:
    """Print the size of an export; raises ExportError if the disk has too little room."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    counts = _counts(tally, "to write")
    linked = sum(tally.linked.values())  # other links may be possible than in a temporary folder
    if linked:
        counts += f", {linked:,} files to link"
    click.echo(f"about {tally.samples:,} samples: {counts}; {size_text(free)} free")
    if tally.bytes > free:
        raise ExportError(
            f"{out}: there is too little room; choose another disk, or fewer scenarios or agents"
        )


def _counts(tally: "Tally", done: str) -> str:
    files = f"{tally.files:,}" if tally.files else "a few"
    return f"{files} files {done} ({size_text(tally.bytes)})"


def _of_format(
    kind: type[Any], *options: Callable[[Any], Any], summary: str = "", text: str = ""
) -> click.Command:
    """Return the verb of a format, with options that set fields of the format.

    Args:
        kind: The format.
        *options: Options of its own.
        summary: Line in the list of formats; empty for the one in `_VERBS`.
        text: Help; empty for the summary.
    """
    summary = summary or _VERBS[kind.name].summary

    @verb(kind.name, short_help=summary, help=text or summary)
    @bulk_parameters()
    @together(*options)
    def export_format(**options: Any) -> None:
        run_export(kind, _own(kind, options), **options)

    return export_format


def _own(kind: type[Any], options: dict[str, Any]) -> dict[str, Any]:
    """Remove the fields that only this format has from a verb's options, and return them."""
    from deepaccident_devkit.export.bulk import Format

    fields = kind.__dataclass_fields__.keys() - Format.__dataclass_fields__.keys()
    return {name: options.pop(name) for name in fields & options.keys()}


def _nuscenes_options() -> tuple[Callable[[Any], Any], ...]:
    from deepaccident_devkit.export.nuscenes import NuScenes

    fields = ("van", "lidar_axes", "sweeps")
    return link_parameter, *(field_option(NuScenes, name, option=advanced) for name in fields)


def _nuscenes() -> click.Command:
    from deepaccident_devkit.export.nuscenes import NuScenes

    return _of_format(
        NuScenes,
        *_nuscenes_options(),
        text="Write scenarios of the release in DATAROOT for the nuScenes devkit 1.2 and all that "
        "reads nuScenes.\n\nKeyframes are at 2 Hz, sweeps at 10 Hz. Images are linked, "
        "clouds are written: those of a whole release take about 210 GB, and 42 GB with "
        "--no-sweeps; the nuScenes devkit holds its tables in 6 GB of memory, or 4 GB. "
        f"--dry-run says how large yours are. {_CONTINUED}",
    )


def _mmdet3d() -> click.Command:
    from deepaccident_devkit.export.mmdet3d import Mmdet3d
    from deepaccident_devkit.export.nuscenes import NuScenes
    from deepaccident_devkit.export.released_infos import ReleasedInfos

    released = [
        field_option(ReleasedInfos, field, option=advanced)
        for field in ("root_prefix", "drop_empty")
    ]

    @verb(short_help=_VERBS["mmdet3d"].summary)
    @bulk_parameters()
    @click.option(
        "--style",
        type=WordChoice(("nuscenes", "released")),
        default="nuscenes",
        show_default=True,
        help="nuscenes: for mmdet3d from 1.1 on. released: as the released code's converter makes "
        "them.",
    )
    @together(*_nuscenes_options(), *released)
    def mmdet3d(style: str, **options: Any) -> None:
        """Write infos for mmdet3d's NuScenesDataset, and a nuScenes export if there is none yet.

        With --style released, write carla_infos_train.pkl and carla_infos_val.pkl, which the
        released code's two dataset classes read together with the release itself.
        """
        released_fields = _own(ReleasedInfos, options)
        nuscenes_fields = _own(NuScenes, options)
        if style == "released":
            refuse_unused("with --style released", *nuscenes_fields, "link")
            run_export(ReleasedInfos, released_fields, **options)
            return
        refuse_unused("without --style released", *released_fields)
        for kind in (NuScenes, Mmdet3d):
            run_export(kind, nuscenes_fields, **options)

    return mmdet3d


def _opencood() -> click.Command:
    from deepaccident_devkit.export.opencood import OpenCood

    classes = field_option(
        OpenCood,
        "classes",
        type=str,
        default=",".join(OpenCood.classes),
        callback=lambda _context, _option, value: tuple(value.split(",")),
        metavar="NAME[,NAME…]",
        help=f"Which boxes become vehicles: {', '.join(CATEGORIES)}.",
    )
    return _of_format(
        OpenCood,
        link_parameter,
        classes,
        field_option(OpenCood, "ego", type=WordChoice(VEHICLE_AGENTS)),
        field_option(OpenCood, "without_clouds", option=advanced),
        text="Write scenarios of the release in DATAROOT as OPV2V has them: a folder each, with "
        f"yaml, json and pcd files.\n\n{_CONTINUED}",
    )


def _parquet() -> click.Command:
    from deepaccident_devkit.export.parquet import Parquet

    return _of_format(
        Parquet,
        text="Write all tables of the release in DATAROOT as Parquet files by split, with tokens "
        f"in place of row numbers.\n\n{_CONTINUED}",
    )


def _webdataset() -> click.Command:
    from deepaccident_devkit.export.webdataset import WebDataset

    size = advanced(
        "--shard-size",
        type=click.IntRange(min=1),
        default=WebDataset.shard_size // 10**6,
        show_default=True,
        callback=lambda _context, _option, value: value * 10**6,
        metavar="MB",
        help="Size of a tar file, about.",
    )
    return _of_format(
        WebDataset,
        field_option(WebDataset, "frames"),
        size,
        text="Write samples of the release in DATAROOT as tar files: the images, the LiDAR "
        f"points, and the rest as JSON.\n\n{_CONTINUED}",
    )


def _questions() -> click.Command:
    from deepaccident_devkit.export.questions import Questions, WindowRules

    observing = together(
        cooperating_parameter("Agents that observe together with each ego", "single"),
        click.option(
            "--ego",
            multiple=True,
            metavar="NAME[,NAME…]",
            help="Agents that ask, each with questions of its own, or all.  [default: ego_vehicle]",
        ),
    )

    @verb(short_help=_VERBS["questions"].summary)
    @bulk_parameters(observing)
    @field_option(WindowRules, "observe")
    @field_option(WindowRules, "ahead", type=click.IntRange(min=1))
    @field_option(WindowRules, "stride", option=advanced)
    @field_option(Questions, "seen")
    @click.option(
        "--images",
        type=WordChoice(("none", "link", "copy")),
        default="none",
        show_default=True,
        help="Whether pictures go with the questions, under neutral names. link: as hard links, "
        "else copies.",
    )
    @click.option(
        "--channels",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"With --images: whose pictures, or all.  [default: {CAMERAS[0]}]",
    )
    @field_option(Questions, "seed", metavar="TEXT")
    def questions(
        agents: tuple[str, ...],
        ego: tuple[str, ...],
        images: str,
        channels: tuple[str, ...],
        **options: Any,
    ) -> None:
        """Write questions about the release in DATAROOT: whether an accident follows observations.

        FOLDER/questions holds all that a model may see, FOLDER/truth.jsonl the answers.
        `deepaccident results` makes a results file of what a model answers. If a run is
        interrupted, the same command continues it.
        """
        if images == "none":
            refuse_unused("without --images", "channels")
        own = {
            "observers": names_or_configuration(agents) or "single",
            "window": WindowRules(
                **{name: options.pop(name) for name in ("observe", "ahead", "stride")}
            ),
            "cameras": () if images == "none" else _camera_names(channels),
            **{name: options.pop(name) for name in ("seen", "seed")},
        }
        run_export(
            Questions,
            own,
            agents=agent_names(ego or ("ego_vehicle",)),
            link="copy" if images == "copy" else "hard",
            **options,
        )

    return questions


def _camera_names(texts: tuple[str, ...]) -> tuple[str, ...]:
    names = [choice("--channels", name, (*CAMERAS, "all")) for name in words_of(texts)]
    if "all" in names:
        return CAMERAS
    return tuple(names) or CAMERAS[:1]


@verb("mcap", short_help="Write a scenario as an interactive 3D scene (MCAP).")
@release_parameters
@click.argument("scenario", required=False)
@click.option(
    "--out", required=True, type=PATH, metavar="FILE", help="File to write, such as accident.mcap."
)
@agents_parameter
@channels_parameter
@frame_range_parameter
@click.option(
    "--points",
    type=click.IntRange(min=1),
    metavar="N",
    default=1,
    show_default=True,
    help="Only every N-th point of a cloud.",
)
@click.option(
    "--motion-labels", type=WordChoice(PRESETS), help="Also write motion labels by this preset."
)
@click.option(
    "--results", type=PATH, metavar="FILE", help="Also write the predictions of this results file."
)
def _mcap(
    scenario: str | None,
    out: Path,
    agents: tuple[str, ...],
    channels: tuple[str, ...],
    results: Path | None,
    **options: Any,
) -> None:
    """Write one scenario of the release in DATAROOT as an MCAP file for Foxglove or rerun.

    SCENARIO is a token, such as type1_subtype1_accident/Town03_type001_subtype0001_scenario00024.
    Without SCENARIO the command takes the first scenario with a collision, or if there is none, the
    first scenario.
    """
    from deepaccident_devkit.evaluation.results import read_results
    from deepaccident_devkit.export.mcap import McapConfig, export_mcap

    names = agent_names(agents)
    choices = {name: options.pop(name) for name in ("frames", "points", "motion_labels")}
    choices["agents"] = None if names == AGENTS else names
    choices["channels"] = words_of(channels) if channels else None
    config = McapConfig.of(**choices)  # before the release is indexed
    if LIDAR not in (config.channels or ()):
        refuse_unused(f"without the channel {LIDAR}", "points")
    prediction = None if results is None else read_results(results)
    dataset = DeepAccident(**options)
    token = scenario or default_scenario(dataset)
    path = export_mcap(dataset, token, out, prediction=prediction, progress=True, **choices)
    size, script = f"{path.stat().st_size / 1e6:.1f} MB", path.with_suffix(".rerun.py")
    click.echo(f"{path}: {token}, {size}; open it in Foxglove, or with: python {script}")


def _town_maps() -> click.Command:
    from deepaccident_devkit.cli.town_maps import town_maps

    return town_maps


# Format → its line in the list of formats, and the function that makes its verb.
_VERBS: Final = {
    "mcap": LazyVerb("Write a scenario as an interactive 3D scene (MCAP).", lambda: _mcap),
    "mmdet3d": LazyVerb("Write infos for mmdet3d, or for the released code.", _mmdet3d),
    "nuscenes": LazyVerb("Write nuScenes tables and their sensor files.", _nuscenes),
    "opencood": LazyVerb(
        "Write OPV2V's folders, for OpenCOOD, V2X-ViT, CoAlign and HEAL.", _opencood
    ),
    "parquet": LazyVerb(
        "Write all tables as Parquet files, for datasets, DuckDB, Polars and pandas.", _parquet
    ),
    "questions": LazyVerb("Write questions on what happens next, for language models.", _questions),
    "town-maps": LazyVerb("Write the roads and sidewalks of each town as GeoJSON.", _town_maps),
    "webdataset": LazyVerb(
        "Write samples with images, LiDAR and boxes as tar files, for webdataset.", _webdataset
    ),
}


def _format_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the verbs of a plug-in's formats; fields of these have no options of their own."""
    return {
        name: LazyVerb(export_format.summary, partial(_plugin_format, export_format))
        for name, export_format in plugin.export_formats.items()
    }


def _plugin_format(export_format: LazyFormat) -> click.Command:
    return _of_format(export_format.load(), link_parameter, summary=export_format.summary)


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_format_verbs)
def export() -> None:
    """Write data in the formats of other tools."""
