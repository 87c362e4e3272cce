"""`deepaccident export`: data in other tools' formats. Only the chosen format is imported."""

import shutil
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

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
    engine_options,
    frame_range_parameter,
    pixel_size,
    refuse_unused,
    release_parameters,
    split_words,
    where_parameter,
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
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CAMERAS,
    CATEGORIES,
    CHANNELS,
    LIDAR,
    VEHICLE_AGENTS,
)
from deepaccident_devkit.v2x.collisions import default_scenario

if TYPE_CHECKING:
    from deepaccident_devkit.export.bulk import Tally

_Parameter: TypeAlias = Callable[[Any], Any]
_CONTINUED = "If a run is interrupted, the same command continues it."
_LINK_NAMES = {"hard": "hard links", "symbolic": "symbolic links", "copy": "copies"}
link_parameter = advanced(
    "--link",
    type=WordChoice(_LINK_NAMES),
    default="hard",
    show_default=True,
    help="How to place unchanged files: as hard links, symbolic links or copies; the next is the "
    "fallback.",
)


def bulk_parameters(agents: _Parameter = agents_parameter) -> _Parameter:
    """Return a release's parameters, --out, --split, --where, --agents and --dry-run.

    `agents` is the parameter --agents, which some subcommands replace by one with another meaning.
    """
    return together(
        release_parameters,
        click.option(
            "--out", required=True, type=PATH, metavar="FOLDER", help="Folder to write into."
        ),
        click.option(
            "--split",
            help="Export only this split: train, val, test, …, or a split file (.txt).  [default: "
            "all]",
        ),
        where_parameter,
        agents,
        click.option("--dry-run", is_flag=True, help="Only print how much would be written."),
    )


def run_export(
    kind: Callable[..., Any],
    settings: NamedValues,
    *,
    out: Path,
    split: str | None,
    where: tuple[str, ...],
    agents: tuple[str, ...],
    link: str = "hard",
    dry_run: bool,
    **release: Any,
) -> None:
    """Export a release to a format; `settings` are the options that only this format has.

    The estimated size is printed first, then what was written and what was left out.
    """
    from deepaccident_devkit.export.bulk import export_release

    # checked before the release is indexed
    export_format = kind(
        split=split, where=where, agents=agent_names(agents), link=link, **settings
    )
    dataset = DeepAccident(**release)
    estimate = export_release(dataset, out, export_format, dry_run=True)
    if estimate.selection:
        click.echo(estimate.selection)
    if estimate.written:
        _print_estimate(estimate.tally, estimate.folder, out)
    if dry_run:
        return
    outcome = export_release(dataset, out, export_format, **engine_options(release), progress=True)
    counts = _format_counts(outcome.tally)
    for name, count in sorted(outcome.tally.linked.items()):
        counts += f", {counted(count, 'file')} as {_LINK_NAMES[name]}"
    units = counted(outcome.written, export_format.unit_word)
    click.echo(f"wrote {outcome.folder}: {counts} ({units} new, {outcome.kept:,} already there)")
    for name, count in sorted(outcome.tally.left_out.items()):
        click.echo(f"excluded: {name} ({count:,})")


def _print_estimate(tally: "Tally", folder: Path, out: Path) -> None:
    """Print the size of an export; raise ExportError if the disk has too little space."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    counts = _format_counts(tally)
    linked = sum(tally.linked.values())  # a temporary folder may allow other links than `out`
    if linked:
        counts += f", {counted(linked, 'file')} to link"
    samples = counted(tally.samples, "sample")
    free_text = size_text(free)
    click.echo(f"estimate for about {samples}: {counts}; {free_text} free")
    if tally.bytes > free:
        needed_text = size_text(tally.bytes)
        raise ExportError(
            f"{out}: not enough free space ({needed_text} needed, {free_text} free); choose "
            "another disk, or fewer scenarios or agents"
        )


def _format_counts(tally: "Tally") -> str:
    files = "a few files"
    if tally.files:
        files = counted(tally.files, "file")
    return f"{files} ({size_text(tally.bytes)})"


def _make_format_verb(
    kind: type[Any], *options: _Parameter, summary: str = "", text: str = ""
) -> click.Command:
    """Build the subcommand for a format, with options that set the format's fields.

    Args:
        kind: Class of the format.
        *options: Options that only this format has.
        summary: Line in the list of formats; if empty, the line in `_VERBS`.
        text: Help of the subcommand; if empty, the summary.
    """
    summary = summary or _VERBS[kind.name].summary

    @verb(kind.name, short_help=summary, help=text or summary)
    @bulk_parameters()
    @together(*options)
    def export_format(**options: Any) -> None:
        run_export(kind, _pop_own_fields(kind, options), **options)

    return export_format


def _pop_own_fields(kind: type[Any], options: NamedValues) -> NamedValues:
    """Remove the fields that only this format has from the options, and return them."""
    from deepaccident_devkit.export.bulk import Format

    common_names = {field.name for field in fields(Format)}
    own_names = {field.name for field in fields(kind)} - common_names
    return {name: options.pop(name) for name in own_names & options.keys()}


def _make_nuscenes_options() -> tuple[_Parameter, ...]:
    from deepaccident_devkit.export.nuscenes import NuScenes

    names = ("van", "lidar_axes", "sweeps")
    options = [field_option(NuScenes, name, option=advanced) for name in names]
    return link_parameter, *options


def _load_nuscenes_verb() -> click.Command:
    from deepaccident_devkit.export.nuscenes import NuScenes

    return _make_format_verb(
        NuScenes,
        *_make_nuscenes_options(),
        text="Write scenarios of the release in DATAROOT for the nuScenes devkit 1.2 and all other "
        "tools that read nuScenes.\n\nKeyframes are at 2 Hz, sweeps at 10 Hz. Images are linked, "
        "and point clouds are written. The clouds of the whole release take about 210 GB, or 42 GB "
        "with --no-sweeps; the nuScenes devkit needs 6 GB or 4 GB of memory for its tables. "
        f"--dry-run prints the size of your export. {_CONTINUED}",
    )


def _load_mmdet3d_verb() -> click.Command:
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
        help="nuscenes: infos for mmdet3d 1.1 and later. released: the infos that the released "
        "code's converter makes.",
    )
    @together(*_make_nuscenes_options(), *released)
    def mmdet3d(style: str, **options: Any) -> None:
        """Write infos for mmdet3d's NuScenesDataset, and a nuScenes export if there is none yet.

        With --style released, write carla_infos_train.pkl and carla_infos_val.pkl, which the
        released code's two dataset classes read together with the release itself.
        """
        released_fields = _pop_own_fields(ReleasedInfos, options)
        nuscenes_fields = _pop_own_fields(NuScenes, options)
        if style == "released":
            refuse_unused("with --style released", *nuscenes_fields, "link")
            run_export(ReleasedInfos, released_fields, **options)
            return
        refuse_unused("without --style released", *released_fields)
        for kind in (NuScenes, Mmdet3d):
            run_export(kind, nuscenes_fields, **options)

    return mmdet3d


def _load_opencood_verb() -> click.Command:
    from deepaccident_devkit.export.opencood import OpenCood

    classes = field_option(
        OpenCood,
        "classes",
        type=str,
        default=",".join(OpenCood.classes),
        callback=lambda _context, _option, value: tuple(value.split(",")),
        metavar="NAME[,NAME…]",
        help=f"Classes of boxes that become vehicles: {', '.join(CATEGORIES)}.",
    )
    return _make_format_verb(
        OpenCood,
        link_parameter,
        classes,
        field_option(OpenCood, "ego", type=WordChoice(VEHICLE_AGENTS)),
        field_option(OpenCood, "without_clouds", option=advanced),
        text="Write scenarios of the release in DATAROOT in the format of OPV2V: one folder per "
        f"scenario, with yaml, json and pcd files.\n\n{_CONTINUED}",
    )


def _load_parquet_verb() -> click.Command:
    from deepaccident_devkit.export.parquet import Parquet

    return _make_format_verb(
        Parquet,
        text="Write all tables of the release in DATAROOT as Parquet files by split, with tokens "
        f"instead of row numbers.\n\n{_CONTINUED}",
    )


def _load_release_verb() -> click.Command:
    from deepaccident_devkit.export.release import ReleasePart

    channels = click.option(
        "--channels",
        multiple=True,
        callback=lambda _context, _option, value: tuple(split_words(value)) or CHANNELS,
        metavar="NAME[,NAME…]",
        help="Include only these sensors, such as Camera_Front,lidar01.  [default: all]",
    )
    return _make_format_verb(
        ReleasePart,
        link_parameter,
        channels,
        field_option(ReleasePart, "size", type=str, callback=pixel_size, metavar="WxH"),
        text="Write a part of the release in DATAROOT, which is a folder, a zip or a folder of "
        "zips, in the layout of a release.\n\nLabel, calib and meta files are always included, and "
        "split files name what is there. `deepaccident validate FOLDER` checks that the part is "
        f"complete. {_CONTINUED}",
    )


def _load_av2_verb() -> click.Command:
    from deepaccident_devkit.export.av2 import Av2

    return _make_format_verb(
        Av2,
        *(field_option(Av2, name, metavar="SECONDS") for name in ("past", "future", "every")),
        text="Write samples of the release in DATAROOT as scenarios of Argoverse 2: one Parquet "
        "file per sample, with the tracks that all agents' labels have, merged. The focal track is "
        f"the agent's own vehicle.\n\n{_CONTINUED}",
    )


def _load_clips_verb() -> click.Command:
    from deepaccident_devkit.export.clips import Clips

    cameras = click.option(
        "--channels",
        "cameras",
        multiple=True,
        callback=lambda _context, _option, value: _choose_cameras(value),
        metavar="NAME[,NAME…]",
        help=f"Cameras whose images to export, or all.  [default: {CAMERAS[0]}]",
    )
    size = field_option(Clips, "size", type=str, callback=pixel_size, metavar="WxH")
    return _make_format_verb(
        Clips,
        cameras,
        size,
        field_option(Clips, "quality"),
        text="Write the images of recordings in DATAROOT as videos, with a row of numbers for each "
        "frame as Parquet and CSV: time to impact, times to collision, motion and more.\n\nThe "
        "folder is a LeRobotDataset v3. Agents that lack images are left out of a scenario, and "
        f"counted. {_CONTINUED}",
    )


def _load_questions_verb() -> click.Command:
    from deepaccident_devkit.export.questions import Questions, WindowRules

    agent_parameters = together(
        cooperating_parameter("Agents that observe together with each ego", "single"),
        click.option(
            "--ego",
            multiple=True,
            metavar="NAME[,NAME…]",
            help="Agents to write questions for, or all.  [default: ego_vehicle]",
        ),
    )

    @verb(short_help=_VERBS["questions"].summary)
    @bulk_parameters(agent_parameters)
    @field_option(WindowRules, "observe")
    @field_option(WindowRules, "ahead", type=click.IntRange(min=1))
    @field_option(WindowRules, "stride", option=advanced)
    @field_option(Questions, "seen")
    @click.option(
        "--images",
        type=WordChoice(("none", "link", "copy")),
        default="none",
        show_default=True,
        help="Add images to the questions, under neutral names. link: as hard links, or copies "
        "where links are impossible.",
    )
    @click.option(
        "--channels",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"With --images: cameras whose images to add, or all.  [default: {CAMERAS[0]}]",
    )
    @field_option(Questions, "seed", metavar="TEXT")
    def questions(
        agents: tuple[str, ...],
        ego: tuple[str, ...],
        images: str,
        channels: tuple[str, ...],
        **options: Any,
    ) -> None:
        """Write questions about the release in DATAROOT: does an accident follow the observations?

        FOLDER/questions contains everything that a model may see, FOLDER/truth.jsonl the answers.
        `deepaccident results` makes a results file from a model's answers. If a run is
        interrupted, the same command continues it.
        """
        if images == "none":
            refuse_unused("without --images", "channels")
        window = WindowRules(
            observe=options.pop("observe"),
            ahead=options.pop("ahead"),
            stride=options.pop("stride"),
        )
        settings = {
            "observers": names_or_configuration(agents) or "single",
            "window": window,
            "cameras": () if images == "none" else _choose_cameras(channels),
            "seen": options.pop("seen"),
            "seed": options.pop("seed"),
        }
        run_export(
            Questions,
            settings,
            agents=agent_names(ego or ("ego_vehicle",)),
            link="copy" if images == "copy" else "hard",
            **options,
        )

    return questions


def _choose_cameras(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Return the cameras passed with repeated --channels; by default, the front camera."""
    names = [choice("--channels", name, (*CAMERAS, "all")) for name in split_words(texts)]
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
    help="Write only every N-th point of a cloud.",
)
@click.option(
    "--motion-labels", type=WordChoice(PRESETS), help="Also write motion labels of this preset."
)
@click.option(
    "--results", type=PATH, metavar="FILE", help="Also write the predictions of this results file."
)
@click.option(
    "--task",
    metavar="TASK",
    help="Task that draws the predictions, also of a plug-in.  [default: the kind of the results]",
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
    choices = {name: options.pop(name) for name in ("frames", "points", "motion_labels", "task")}
    if results is None:
        refuse_unused("without --results", "task")
    choices["agents"] = None if names == AGENTS else names
    choices["channels"] = split_words(channels) if channels else None
    config = McapConfig.of(**choices)  # fails before the release is indexed
    if LIDAR not in (config.channels or ()):
        refuse_unused(f"without the channel {LIDAR}", "points")
    prediction = None if results is None else read_results(results)
    dataset = DeepAccident(**options)
    token = scenario or default_scenario(dataset)
    path = export_mcap(dataset, token, out, prediction=prediction, progress=True, **choices)
    size = size_text(path.stat().st_size)
    script = path.with_suffix(".rerun.py")
    click.echo(f"wrote {path} ({token}, {size}); open it in Foxglove, or with: python {script}")


def _load_town_maps_verb() -> click.Command:
    from deepaccident_devkit.cli.town_maps import town_maps

    return town_maps


# Format → its line in the list of formats, and the function that builds its subcommand.
_VERBS = {
    "av2": LazyVerb("Write tracks of actors as scenarios of Argoverse 2.", _load_av2_verb),
    "clips": LazyVerb(
        "Write videos with a row of numbers for each frame, for LeRobot and pandas.",
        _load_clips_verb,
    ),
    "mcap": LazyVerb("Write a scenario as an interactive 3D scene (MCAP).", lambda: _mcap),
    "mmdet3d": LazyVerb("Write infos for mmdet3d, or for the released code.", _load_mmdet3d_verb),
    "nuscenes": LazyVerb("Write nuScenes tables and their sensor files.", _load_nuscenes_verb),
    "opencood": LazyVerb(
        "Write folders like OPV2V's, for OpenCOOD, V2X-ViT, CoAlign and HEAL.", _load_opencood_verb
    ),
    "parquet": LazyVerb(
        "Write all tables as Parquet files, for datasets, DuckDB, Polars and pandas.",
        _load_parquet_verb,
    ),
    "questions": LazyVerb(
        "Write questions about what happens next, for language models.", _load_questions_verb
    ),
    "release": LazyVerb(
        "Write a part of a release in its own layout, with smaller images if you like.",
        _load_release_verb,
    ),
    "town-maps": LazyVerb(
        "Write the roads and sidewalks of each town as GeoJSON.", _load_town_maps_verb
    ),
}


def _read_format_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the subcommands for a plug-in's formats, without options for the formats' fields."""
    return {
        name: LazyVerb(export_format.summary, partial(_load_plugin_verb, export_format))
        for name, export_format in plugin.export_formats.items()
    }


def _load_plugin_verb(export_format: LazyFormat) -> click.Command:
    return _make_format_verb(export_format.load(), link_parameter, summary=export_format.summary)


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_read_format_verbs)
def export() -> None:
    """Export data to the formats of other tools."""
