"""Draw the pictures of the pages that no command makes: the colour key, the designs, the sketch of
a junction, the labels.

`python docs/make_pictures.py` renders them.
"""

from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from benchmarks.measure import temporary_folder
from benchmarks.pages.labels import ACTORS, CLEAN, COLLIDING, RELEASE, RELEASED, STEP, turn
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.sensor_setup_figures import sensor_setups_figure
from deepaccident_devkit.plugins.nuscenes.sensor_setups import sensor_setup_report
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.plan import RigName
from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS, read_design
from deepaccident_devkit.plugins.synth.traffic.driving import distance_to_middle, road_crossing
from deepaccident_devkit.render import detached_figure, draw_motion_map, styles
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.figures import save_picture, write_figure
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, short_name
from deepaccident_devkit.v2x import Contact

SIZES = {
    "car": (4.6, 2.0),
    "truck": (8.0, 2.6),
    "van": (5.4, 2.2),
    "cyclist": (1.8, 0.7),
    "motorcycle": (2.2, 0.9),
    "pedestrian": (0.6, 0.6),
}
"""Length and width of the boxes in the colour key, metres."""
KEY_STEP, KEY_ROW = 15.0, 7.0
"""Metres from one column of the key to the next, and from row to row."""
SEEDS = {1: 1, 2: 7, 3: 7, 4: 5, 5: 3, 6: 4, 7: 6, 8: 11, 9: 12, 10: 3, 11: 7, 12: 2}
"""Seed of a draw of each design in the daytime."""
DESIGN_FRAMES = 25
RIGS: tuple[RigName, ...] = ("released", "road")
COMPARED_RELEASE = SynthConfig(
    scenarios=2, frames=31, image_size=(480, 270), sensor_step=5, seed=4, designed=True
)
"""Shown as it is, and as nuScenes: from its first frame to its last, each fifth one has images."""
FRAMES_BEFORE = 7
"""Frames from the pictures to the impact."""
COLUMNS = 4
EGO_RANGE = 26.0
"""Metres shown to each side of the ego."""
SPEC = RoadSpec(lanes=2)
JUNCTION_RANGE = 50.0
"""Metres shown to each side of the junction's middle."""
START, PARKED, STEP_OUT = 40.0, 33.5, 27.0
"""Distances of ego, of parked vehicles and of a pedestrian to the junction's middle, metres."""
ROAD, STRIP, LINE = "0.82", "0.9", "white"
TURN_LIMITS = {"xlim": (-6, 40), "ylim": (-15, 13)}
"""Axis limits of the pictures of the turn, metres."""


def render_all(images: Path) -> None:
    """Render all pictures into a folder."""
    save_picture(draw_key(detached_figure((9, 3.0))), images / "colour_key.png", dpi=120)
    save_picture(draw_sketch(), images / "scenario_sketch.png", dpi=100)
    save_picture(draw_designs(), images / "designs.jpg", dpi=100)
    with temporary_folder() as folder:
        root = make_release(folder / "release", RELEASE)
        release = DeepAccident(dataroot=root, verbose=False)
        draw_labels(release, images / "motion_labels.png")
        draw_rigs(folder, images / "rigs.webp")
        # nuscenes-devkit needs an environment of its own (docs/nuscenes.md)
        if find_spec("nuscenes") is not None:
            draw_both_sources(folder, images / "road.webp")
    draw_turn("instance", range(5), images / "labels_released_clean.png")
    draw_turn("flow", range(4), images / "labels_released_clean_flow.png")
    draw_half_cell(images / "labels_half_cell.png")


def draw_key(fig: Figure) -> Figure:
    """Draw a row for each rule of the grammar, and the colour maps to their right."""
    panels = fig.subplot_mosaic(
        [["rows", "depth"], ["rows", "height"], ["rows", "flow"]], width_ratios=(5.2, 1)
    )
    rows = panels["rows"]
    rows.set(xlim=(-22, 6 * KEY_STEP - 4), ylim=(-4.3 * KEY_ROW, 0.6 * KEY_ROW), aspect="equal")
    rows.set_axis_off()
    vehicles = [agent for agent in AGENTS if agent != "infrastructure"]
    entries = [(short_name(agent), "car", styles.AGENT_COLORS[agent]) for agent in vehicles]
    draw_row(rows, 0, "agents", entries)
    position = (len(vehicles) * KEY_STEP, 0.0)
    rows.plot(*position, "o", color=styles.AGENT_COLORS["infrastructure"], markersize=9)
    write(rows, "infrastructure", *position)
    red = styles.COLLIDER_COLOR
    pair = [("a car", "car", red), ("a pedestrian", "pedestrian", red)]
    draw_row(rows, 1, "colliding pair", pair)
    actors = [(name, name, styles.CATEGORY_COLORS[name]) for name in SIZES]
    draw_row(rows, 2, "other actors", actors)
    verdicts = {**styles.OUTCOME_COLORS, "no verdict": styles.PREDICTED_COLOR}
    draw_patches(rows, 3, "predictions", verdicts)
    series = zip(("first", "second", "third", "fourth"), styles.SERIES_COLORS, strict=True)
    draw_patches(rows, 4, "charts", dict(series))
    draw_colormap(panels["depth"], "depth", styles.DEPTH_COLORMAP, ("near", "far"))
    draw_colormap(panels["height"], "height", styles.HEIGHT_COLORMAP, ("low", "high"))
    draw_wheel(panels["flow"])
    return fig


def draw_colormap(ax: Axes, name: str, colormap: str, limits: tuple[str, str]) -> None:
    """Draw a colour map of points with the meaning of its two limits."""
    gradient = np.linspace(0, 1, 256)[None]
    ax.imshow(gradient, cmap=colormap, aspect="auto", extent=(0, 1, 0, 1))
    ax.set(xticks=(0, 1), yticks=(), box_aspect=0.16)
    ax.set_xticks((0, 1), limits, fontsize=8)
    ax.set_title(f"points by {name}", fontsize=8)


def draw_row(ax: Axes, row: int, title: str, entries: list[tuple[str, str, str]]) -> None:
    """Draw the boxes of one rule: their words, classes and colours."""
    y = -row * KEY_ROW
    ax.text(-22, y, title, va="center", fontsize=9, fontweight="bold")
    names = [name for _, name, _ in entries]
    center = [(column * KEY_STEP, y, 0.0) for column in range(len(entries))]
    size = [(*SIZES[name], 1.5) for name in names]
    yaw = [0.0] * len(names)
    boxes = Boxes.from_arrays(center, size, yaw, frame="ego", category=names)
    draw_boxes_from_above(boxes, ax, [color for _, _, color in entries])
    for column, (words, _, _) in enumerate(entries):
        write(ax, words, column * KEY_STEP, y)


def draw_patches(ax: Axes, row: int, title: str, meanings: dict[str, str]) -> None:
    """Draw the filled rectangles of one rule, from their meanings to their colours."""
    y = -row * KEY_ROW
    ax.text(-22, y, title, va="center", fontsize=9, fontweight="bold")
    for column, (words, color) in enumerate(meanings.items()):
        x = column * KEY_STEP
        left = x - 2.3
        right = x + 2.3
        ax.fill([left, right, right, left], [y - 1, y - 1, y + 1, y + 1], color=color)
        write(ax, words, x, y)


def write(ax: Axes, words: str, x: float, y: float) -> None:
    """Write words below a point."""
    ax.annotate(
        words, (x, y), (0, -10), textcoords="offset points", ha="center", va="top", fontsize=8
    )


def draw_wheel(ax: Axes) -> None:
    """Draw the colours of directions."""
    left, along = np.mgrid[-1:1:101j, -1:1:101j]
    inside = (np.hypot(left, along) <= 1)[..., None]
    colors = np.where(inside, direction_colors(left, along, longest=1.0), 1.0)
    ax.imshow(colors, origin="lower", extent=(-1, 1, -1, 1))
    ax.set_axis_off()
    ax.set_title("flow: forward to the right", fontsize=8)


def draw_designs() -> Figure:
    """Draw a contact sheet of the paper's twelve designs, of synthetic accidents."""
    rows = len(DESIGN_NUMBERS) // COLUMNS
    fig = detached_figure((16, 6.9 * rows))
    axes = fig.subplots(2 * rows, COLUMNS, height_ratios=[1, 9 / 16] * rows)
    for index, number in enumerate(DESIGN_NUMBERS):
        row, column = divmod(index, COLUMNS)
        from_above, image = axes[2 * row : 2 * row + 2, column]
        with temporary_folder() as folder:
            release = DeepAccident(dataroot=make_design(number, folder / "release"))
            draw_design(release, from_above, image)
        from_above.set_title(title_of(number), fontsize=13)
    return fig


def make_design(number: int, folder: Path) -> Path:
    """Make a release of one accident of a design."""
    config = SynthConfig(
        scenarios=1,
        frames=DESIGN_FRAMES,
        image_size=(640, 360),
        designs=(number,),
        seed=SEEDS[number],
        unplanned=0,
        designed=True,
    )
    return make_release(folder, config, progress=True)


def title_of(number: int) -> str:
    """Return the title of a design, with its junction and lights."""
    name = read_design(number).name
    short, _, _ = name.partition(",")
    junction = "three-way" if "three-way" in name else "four-way"
    lights = "signalised" if number <= len(DESIGN_NUMBERS) // 2 else "unsignalised"
    return f"{number}  {short},\n{junction}, {lights}"


def draw_design(release: DeepAccident, from_above: Axes, image: Axes) -> None:
    """Draw the paths of the colliding pair from above, the impact as a cross; and the camera that
    shows both best.
    """
    token = release.scenario[0]["token"]
    contact = release.collision(token)
    if contact is None:
        raise SystemExit(f"{token}: nobody collides in it; choose another seed")
    frame = release.field2token("frame", "scenario_token", token)[-1 - FRAMES_BEFORE]
    samples = [sample["token"] for sample in release.samples_of(frame)]
    ego = samples[0]
    release.render_bev(
        ego, agents="all", view_range=EGO_RANGE, layers=("bev", "boxes"), ax=from_above
    )
    draw_meeting(release, ego, contact, from_above)
    boxes = release.cooperative_boxes(ego, agents="all", frame="world")
    pair = boxes.select(np.isin(boxes.actor_id, contact.actor_ids))
    # for followers, one of the two hides the other
    witnesses = [sample for sample in samples if "behind" not in sample]
    view = best_view(release, witnesses, pair)
    camera = f"{ego}/Camera_Front" if view is None else view.camera
    release.render_sample_data(camera, layers=("image",), ax=image)
    for ax in (from_above, image):
        ax.set(title="", xlabel="", ylabel="", xticks=[], yticks=[])
        legend = ax.get_legend()
        if legend is not None:
            legend.remove()


def draw_meeting(release: DeepAccident, ego: str, contact: Contact, ax: Axes) -> None:
    """Draw the paths of ego and other in their hues and a red cross where they meet, in the ego
    frame of a sample.
    """
    agent = ego.rsplit("/", 1)[0]
    own_id = release.get("agent", agent)["actor_id"]
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        color = AGENT_COLORS["ego_vehicle" if actor == own_id else "other_vehicle"]
        x, y, _ = release.trajectory(instance, ego, "ego").center.T
        ax.plot(x, y, color=color, linewidth=4, zorder=4)
    ego_from_world = release.world_from(ego, "ego").inverse()
    x, y, _ = ego_from_world.apply(contact.point[None])[0]
    ax.plot(x, y, "x", color=COLLIDER_COLOR, markersize=16, markeredgewidth=4, zorder=6)


def draw_sketch() -> Figure:
    """Draw the sketch of a junction: arms, lanes, sides and distances, as scenario files name them."""
    fig = detached_figure((8, 8))
    ax = fig.subplots()
    render_roads(ax)
    render_lanes(ax)
    render_distances(ax)
    render_sides(ax)
    ax.set(
        xlim=(-JUNCTION_RANGE, JUNCTION_RANGE),
        ylim=(-JUNCTION_RANGE, JUNCTION_RANGE),
        xticks=[],
        yticks=[],
        aspect="equal",
    )
    return fig


def render_roads(ax: Axes) -> None:
    """Draw the two roads with their parking strips, stop lines and names."""
    for half_width, color in ((SPEC.road_edge, STRIP), (SPEC.lanes_edge, ROAD)):
        for half_x, half_y in ((JUNCTION_RANGE, half_width), (half_width, JUNCTION_RANGE)):
            corner = (-half_x, -half_y)
            road = Rectangle(corner, 2 * half_x, 2 * half_y, color=color, linewidth=0)
            ax.add_patch(road)
    stop_line = SPEC.stop_line[0]
    edge = SPEC.lanes_edge
    for arm, (x, y) in OUTWARD.items():
        outward = np.array([x, y])
        left = np.array([-y, x])
        start = stop_line * outward
        for across, style in ((0.0, "-"), (edge / 2, "--"), (-edge / 2, "--")):
            line = np.stack([start, JUNCTION_RANGE * outward]) + across * left
            ax.plot(*line.T, style, color=LINE, linewidth=2)
        ax.plot(*np.stack([start, start + edge * left]).T, color=LINE, linewidth=5)
        text_x, text_y = 46 * outward - 13 * np.abs(left)
        ax.text(text_x, text_y, arm, fontsize=15, fontweight="bold", ha="center", va="center")
    ax.plot(0, 0, "+", color="black", markersize=14)
    ax.text(1, 1, "middle", fontsize=10)


def render_lanes(ax: Axes) -> None:
    """Draw each lane's number before the junction, and an arrow in the direction of its traffic."""
    junction = Junction(SPEC)
    for arm in junction.arms:
        for lane in range(SPEC.lanes):
            route = junction.route(arm, "straight", lane)
            x, y, yaw, _ = (float(value) for value in route.path.at(route.stop_s - 4.0))
            ahead = 3.5 * np.array([np.cos(yaw), np.sin(yaw)])
            tail = np.array([x, y])
            arrow = {"arrowstyle": "-|>", "color": "0.3"}
            ax.annotate("", tail + ahead, tail, arrowprops=arrow)
            ax.text(*(tail - ahead / 3), str(lane), fontsize=12, ha="center", va="center")


def render_distances(ax: Axes) -> None:
    """Draw ego, which turns left from the south, and its start distance along its path."""
    route = Junction(SPEC).route("south", "left", 1)
    middle_s = distance_to_middle(route)
    s = np.linspace(middle_s - START, middle_s + 30, 200)
    x, y, _, _ = route.path.at(s)
    before = s <= middle_s
    ax.plot(x[before], y[before], color="C0", linewidth=3)
    ax.plot(x[~before], y[~before], color="C0", linewidth=1.5, linestyle=":")
    ax.plot(x[0], y[0], "o", color="C0", markersize=12)
    ax.annotate(
        f"ego: from: south, turn: left, lane: 1,\nstart_distance: {START:g}\n(the solid line, {START:g} m)",
        (x[0], y[0]), (-JUNCTION_RANGE + 1, -38), color="C0", fontsize=10, arrowprops={"arrowstyle": "-", "color": "C0"},
    )  # fmt: skip


def render_sides(ax: Axes) -> None:
    """Draw parked vehicles and a pedestrian on either side of the south arm."""
    for side, sign in (("left", -1), ("right", 1)):
        middle = sign * (SPEC.lanes_edge + SPEC.road_edge) / 2
        ax.add_patch(Rectangle((middle - 0.9, -PARKED - 2.2), 1.8, 4.4, color="C2"))
        label = f"parked: from: south,\nside: {side},\nstart_distance: {PARKED:g}"
        if side == "right":
            ax.text(middle + 3, -PARKED, label, color="C2", fontsize=10, va="center")
        else:
            label = f"the same,\nside: {side}"
            ax.text(
                middle - 2, -PARKED + 4, label, color="C2", fontsize=10, va="center", ha="right"
            )
    path = road_crossing(SPEC, "south", STEP_OUT, "right").xy
    arrow = {"arrowstyle": "-|>", "color": "C3", "linewidth": 2}
    ax.annotate("", path[-1], path[0], arrowprops=arrow)
    label = f"pedestrian: from: south,\nside: right,\nstart_distance: {STEP_OUT:g}"
    x, y = path[0] + 1
    ax.text(x, y, label, color="C3", fontsize=10)


def draw_labels(release: DeepAccident, path: Path) -> None:
    """Draw the ego's labels 2 s before the accident, the earliest that end with the impact."""
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    sample = release.get_sample(accident, "ego_vehicle", frame=RELEASE.frames - 20)
    figure = release.render_motion_labels(sample, fig=detached_figure((16.5, 12)))
    figure.axes[0].set(xlim=(-22, 33), ylim=(-28, 27))
    figure.savefig(path, dpi=72)


def draw_rigs(folder: Path, path: Path) -> None:
    """Draw the two rigs of the generator."""
    datasets = []
    for name in RIGS:
        config = SynthConfig(rig=name, frames=3, image_size=(64, 36), designed=True)
        root = make_release(folder / name, config)
        datasets.append(DeepAccident(dataroot=root, verbose=False))
    report = sensor_setup_report(*datasets)
    write_figure(sensor_setups_figure(report), path, dpi=110)


def draw_both_sources(folder: Path, path: Path) -> None:
    """Draw the same moment of a release, and of its export as the nuScenes devkit reads it."""
    release = DeepAccident(dataroot=make_release(folder / "ours", COMPARED_RELEASE), verbose=False)
    export_release(release, folder / "nuscenes", NuScenes(agents=AGENTS[:1], lidar_axes="nuscenes"))
    accident = next(scenario["token"] for scenario in release.scenario if scenario["collision"])
    sources = {
        accident: release,
        f"nuscenes/{accident.replace('/', '-')}-ego_vehicle": open_nuscenes(folder / "nuscenes"),
    }
    pictures = []
    for scenario, source in sources.items():
        sample = source.get_sample(scenario, "ego_vehicle", frame=COMPARED_RELEASE.frames - 10)
        content = BytesIO()
        source.render_sample(sample).savefig(content, dpi=60)
        pictures.append(np.asarray(Image.open(content).convert("RGB")))
    Image.fromarray(np.concatenate(pictures)).save(path, quality=85)


def draw_turn(name: Any, frames: range, path: Path) -> None:
    """Draw a map of the turn under both protocols, a column for each frame, all warped to the
    present.
    """
    figure = detached_figure((3.5 * len(frames) + 0.4, 5.0))
    panels = figure.subplots(2, len(frames), sharex=True, sharey=True)
    for row, config in zip(panels, (RELEASED, CLEAN), strict=True):
        labels = turn(config).to_present()
        for frame, ax in zip(frames, row, strict=True):
            draw_motion_map(labels, name, frame, marked=COLLIDING, ax=ax)
            _draw_outlines(frame, ax)
            ax.set(**TURN_LIMITS)
            ax.tick_params(labelsize=12)
        row[0].set_ylabel(config.protocol, fontsize=18)
    for frame, ax in zip(frames, panels[0], strict=True):
        ax.set_title(f"+{frame * STEP:.1f} s" if frame else "present", fontsize=18)
    figure.savefig(path, dpi=80)


def draw_half_cell(path: Path) -> None:
    """Draw some cells of the turn's present frame under both protocols, with the grid's lines."""
    figure = detached_figure((14, 4.4))
    for ax, config in zip(figure.subplots(1, 2, sharey=True), (RELEASED, CLEAN), strict=True):
        draw_motion_map(turn(config), "instance", 0, marked=COLLIDING, ax=ax)
        _draw_outlines(0, ax)
        ax.set(xlim=(-3.5, 13), ylim=(-8.5, 2.5))
        ax.set_xticks(np.arange(-3, 13.1, 0.5), minor=True)
        ax.set_yticks(np.arange(-8.5, 2.6, 0.5), minor=True)
        ax.grid(which="both", color="#b0b0b0", linewidth=0.5)
        ax.set_title(config.protocol, fontsize=18)
        ax.set_xlabel("x forward (m)", fontsize=14)
        ax.set_ylabel("y left (m)", fontsize=14)
        ax.tick_params(labelsize=12)
    figure.savefig(path, dpi=80)


def _draw_outlines(frame: int, ax: Any) -> None:
    """Draw the true footprints, in the present ego frame."""
    for actor in ACTORS:
        length, width, _ = actor.size
        corners = np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        corners = corners * (length, width, 0) / 2
        x, y, _ = (actor.pose(frame) @ corners).T
        ax.plot(x, y, color="#f5a000", linewidth=1.2, zorder=2)
