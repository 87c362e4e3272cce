"""Measure numbers that show how similar generated scenarios are to the real release."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import mean

import numpy as np
import yaml

from benchmarks.measure import temporary_folder
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import (
    RecordingJob,
    forget_scenario,
    record_scenario,
)
from deepaccident_devkit.plugins.synth.spec import design_text
from deepaccident_devkit.release import (
    Labels,
    ScenarioFolder,
    find_release,
    read_calib,
    read_calibs,
    read_label,
    read_labels,
    read_lidar,
    read_meta,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CATEGORIES,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    STATIC_ACTOR_ID,
)

Numbers = dict[str, float]
AgentFrame = tuple[ScenarioFolder, str, int]

SENSOR_STEP = 25
"""Frames from one measured sensor file to the next."""
PAIRS = 4
_CAR, _PEDESTRIAN = CATEGORIES.index("car"), CATEGORIES.index("pedestrian")
_TWO_WHEELERS = [CATEGORIES.index(name) for name in ("motorcycle", "cyclist")]
_BINS = {
    "0–10": (0, 10),
    "10–20": (10, 20),
    "20–30": (20, 30),
    "30–50": (30, 50),
    "50–70": (50, 70),
    "70–120": (70, 120),
}
_MIN_MOVING_SPEED = 0.5
"""Metres per second above which an actor counts as moving."""


def measure_real(folder: Path) -> Numbers:
    """Return the numbers of a release's first scenario, which is the real one."""
    return measure([find_release(folder).scenarios[0]])


def measure_generated() -> Numbers:
    """Return the numbers of normal scenarios like the real one: three-way, with lights, clear noon;
    ego turns right.
    """
    with temporary_folder() as folder:
        spec = folder / "like_the_real_one.yaml"
        spec.write_text(_similar_spec(), encoding="utf-8")
        config = SynthConfig(
            scenarios=2 * PAIRS, frames=None, unplanned=0.0, sensors=False, spec=spec
        )
        root = make_release(folder / "release", config)
        pictured = SynthConfig(
            scenarios=2 * PAIRS, frames=None, unplanned=0.0, spec=spec, image_size=(1600, 900)
        )
        normal = [plan for plan in plan_scenarios(pictured) if not plan.accident]
        for plan in normal:
            record_scenario(RecordingJob(root, pictured, plan, 1, SENSOR_STEP))
        forget_scenario()
        tokens = {plan.token for plan in normal}
        scenarios = find_release(root).scenarios
        return measure([scenario for scenario in scenarios if scenario.token in tokens])


def _similar_spec() -> str:
    """Return design 6 without what the real scenario does not have: two lanes, a hump, a hidden
    view, rain, night.
    """
    spec = yaml.safe_load(design_text(6))
    spec["road"] = {"kind": "three-way", "signalized": True, "lanes": 1}
    ego = spec["actors"][0]
    other = spec["actors"][2]
    for key in ("from", "turn"):
        ego[key], other[key] = other[key], ego[key]
    return yaml.safe_dump(
        {**spec, "view": "open", "exchange": False, "weather": "Clear", "time_of_day": "Noon"}
    )


def measure(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Return the numbers of scenarios together: mean numbers of actors, and shares and percentiles
    of all rows.
    """
    numbers = {"scenarios": len(scenarios), "frames": mean(map(_frames, scenarios))}
    counts = [_count_actors(scenario) for scenario in scenarios]
    numbers |= {kind: mean(count[kind] for count in counts) for kind in counts[0]}
    labels = [_labels(scenario, agent) for scenario in scenarios for agent in AGENTS]
    numbers |= _measure_boxes(labels)
    numbers |= _measure_clouds(scenarios)
    numbers |= _measure_calibs(scenarios)
    return numbers | _file_sizes(scenarios)


def _frames(scenario: ScenarioFolder) -> int:
    return len(list(scenario.kind_folder(AGENTS[0], "label").iterdir()))


def _labels(scenario: ScenarioFolder, agent: str) -> Labels:
    frames = range(1, _frames(scenario) + 1)
    return read_labels([scenario.label_path(agent, frame) for frame in frames])


def _count_actors(scenario: ScenarioFolder) -> Numbers:
    """Return the number of annotated actors of each kind."""
    own_ids = dict(zip(AGENTS, read_meta(scenario.meta_path).agent_ids or (), strict=False))
    top_speed: dict[int, float] = {}
    category: dict[int, int] = {}
    for agent in AGENTS:
        labels = _labels(scenario, agent)
        ids = np.where(labels.actor_id == OWN_ACTOR_ID, own_ids.get(agent, 0), labels.actor_id)
        speeds = _speed(labels)
        for actor, code, speed in zip(ids.tolist(), labels.category, speeds, strict=True):
            if actor > 0:
                top_speed[actor] = max(top_speed.get(actor, 0.0), float(speed))
                category[actor] = int(code)
    numbers = dict.fromkeys(
        (
            "four-wheelers that drive",
            "four-wheelers that wait",
            "two-wheelers",
            "pedestrians",
            "parked",
        ),
        0,
    )
    for actor, code in category.items():
        if actor >= STATIC_ACTOR_ID:
            numbers["parked"] += 1
        if code == _PEDESTRIAN:
            numbers["pedestrians"] += 1
        elif actor < STATIC_ACTOR_ID:
            if code in _TWO_WHEELERS:
                numbers["two-wheelers"] += 1
            elif top_speed[actor] > _MIN_MOVING_SPEED:
                numbers["four-wheelers that drive"] += 1
            else:
                numbers["four-wheelers that wait"] += 1
    return numbers


def _measure_boxes(labels: Sequence[Labels]) -> Numbers:
    """Return shares and percentiles of all boxes."""
    centers = np.concatenate([of_agent.center[:, :2] for of_agent in labels])
    distance = np.hypot(*centers.T)
    speed = np.concatenate([_speed(of_agent) for of_agent in labels])
    points, visible, ids, codes, counts = (
        np.concatenate([getattr(of_agent, name) for of_agent in labels])
        for name in ("num_lidar_pts", "camera_visible", "actor_id", "category", "num_boxes")
    )
    is_own = ids == OWN_ACTOR_ID
    is_other = ~is_own
    is_pedestrian = codes == _PEDESTRIAN
    is_moving = speed > _MIN_MOVING_SPEED
    driving_speed = speed[is_other & ~is_pedestrian & is_moving]
    numbers = {
        "boxes, mean": float(counts.mean()),
        "boxes, least": float(counts.min()),
        "boxes, most": float(counts.max()),
        "speed, median": _percentile(driving_speed, 50),
        "speed, 95 %": _percentile(driving_speed, 95),
        "walking, median": _percentile(speed[is_pedestrian & is_moving], 50),
        "untracked": float((ids == -1).mean()),
        "points on itself": _percentile(points[is_own], 50),
        "without points": float((points[is_other] == 0).mean()),
        "visible": float(visible[is_other].mean()),
    }
    for share in (10, 50, 90, 100):
        numbers[f"distance, {share} %"] = _percentile(distance[is_other], share)
    for name, (low, high) in _BINS.items():
        in_bin = is_other & (distance >= low) & (distance < high)
        points_on_cars = points[in_bin & (codes == _CAR) & (points > 0)]
        numbers[f"boxes {name}"] = float(in_bin[is_other].mean())
        numbers[f"without points {name}"] = float((points[in_bin] == 0).mean())
        numbers[f"visible {name}"] = float(visible[in_bin].mean())
        numbers[f"points on a car {name}"] = _percentile(points_on_cars, 50)
    return numbers


def _measure_clouds(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Return sizes of clouds, and how labels' numbers of points differ from a recount."""
    sizes = {True: [], False: []}
    stored_counts = []
    recounts = []
    for scenario, agent, frame in _frames_with_clouds(scenarios):
        cloud = read_lidar(scenario.channel_path(agent, LIDAR, frame))
        labels = read_label(scenario.label_path(agent, frame))
        sizes[agent == INFRASTRUCTURE].append(len(cloud))
        stored_counts.append(labels.num_lidar_pts)
        recounts.append(labels.boxes().count_points(cloud.xyz))
    stored = np.concatenate(stored_counts)
    recount = np.concatenate(recounts)
    has_points = (stored > 0) | (recount > 0)
    differs = has_points & (stored != recount)
    relative_difference = np.abs(stored - recount)[differs] / np.maximum(stored, 1)[differs]
    numbers = {
        "counts that differ": float(differs[has_points].mean()),
        "counts, by": _percentile(relative_difference, 50),
    }
    for is_pole, name in (
        (False, "points of a vehicle's cloud"),
        (True, "points of the pole's cloud"),
    ):
        for key, summarise in _SUMMARIES.items():
            numbers[f"{name}, {key}"] = float(summarise(sizes[is_pole]))
    return numbers


_SUMMARIES: dict[str, Callable[[Sequence[int]], float]] = {
    "mean": np.mean,
    "least": min,
    "most": max,
}


def _agent_frames(scenarios: Sequence[ScenarioFolder]) -> Iterator[AgentFrame]:
    for scenario in scenarios:
        for agent in AGENTS:
            for frame in range(1, _frames(scenario) + 1):
                yield scenario, agent, frame


def _frames_with_clouds(scenarios: Sequence[ScenarioFolder]) -> Iterator[AgentFrame]:
    for scenario, agent, frame in _agent_frames(scenarios):
        if scenario.channel_path(agent, LIDAR, frame).exists():
            yield scenario, agent, frame


def _measure_calibs(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Return how much a vehicle's LiDAR and front camera move relative to the vehicle between
    frames.
    """
    shifts, turns, heights = [], [], []
    for scenario in scenarios:
        for agent in AGENTS[:-1]:
            frames = range(1, _frames(scenario) + 1)
            calibs = read_calibs([scenario.calib_path(agent, frame) for frame in frames])
            for poses in (calibs.ego_from_lidar, calibs.camera_from_lidar[:, 0]):
                shifts.append(np.ptp(poses[:, :3, 3], axis=0).max())
                turns.append(np.ptp(poses[:, :3, :3], axis=0).max())
            labels = read_label(scenario.label_path(agent, 1))
            _, _, own_height = labels.size[labels.actor_id == OWN_ACTOR_ID][0]
            calib = read_calib(scenario.calib_path(agent, 1))
            heights.append(calib.ego_from_lidar.translation[2] - own_height)
    return {
        "LiDAR above its vehicle": float(np.mean(heights)),
        "calib, shift": float(np.max(shifts)),
        "calib, turn": float(np.max(turns)),
    }


def _file_sizes(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Return mean sizes of files, kB; images only of the pole, at the frames with measured
    clouds.
    """
    paths = {"label": [], "calib": [], "LiDAR": [], "image": []}
    for scenario, agent, frame in _agent_frames(scenarios):
        paths["label"].append(scenario.label_path(agent, frame))
        paths["calib"].append(scenario.calib_path(agent, frame))
    for scenario, agent, frame in _frames_with_clouds(scenarios):
        paths["LiDAR"].append(scenario.channel_path(agent, LIDAR, frame))
    for scenario in scenarios:
        paths["image"] += scenario.kind_folder(INFRASTRUCTURE, "Camera_Front").rglob("*.jpg")
    numbers = {}
    for kind, files in paths.items():
        numbers[f"kB, {kind}"] = mean(path.stat().st_size for path in files) / 1000
    return numbers


def _speed(labels: Labels) -> FloatArray:
    return np.asarray(np.hypot(*labels.velocity.T))


def _percentile(values: FloatArray, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else 0.0


_PAGE_BINS = ("0–10", "20–30", "50–70")
_ROWS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("boxes without points", "{:.0%}", ("without points",)),
    (
        f"points on a car: median at {', '.join(_PAGE_BINS)} m",
        "{:.0f}, {:.0f}, {:.0f}",
        tuple(f"points on a car {name}" for name in _PAGE_BINS),
    ),
    ("points on the agent's own box, median", "{:.0f}", ("points on itself",)),
)
"""The rows of the page: heading, format of a cell, and the numbers in it."""


def comparison_rows(real: Numbers, generated: Numbers) -> list[tuple[str, ...]]:
    """Return the rows of the real scenario and of the generated ones that the page shows."""
    rows = []
    for heading, form, keys in _ROWS:
        cells = []
        for numbers in (real, generated):
            values = [numbers[key] for key in keys]
            cells.append(form.format(*values).replace("%", " %"))
        rows.append((heading, *cells))
    return rows
