"""Numbers that show how similar generated scenarios are to the real release."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean

import numpy as np
import yaml

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
from deepaccident_devkit.support.arrays import BoolArray, FloatArray
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CATEGORIES,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    STATIC_ACTOR_ID,
)

Numbers = dict[str, float]

SENSOR_STEP = 25
"""Sensor files are measured at one of so many frames."""
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
_MOVING = 0.5
"""m/s: an actor that is faster counts as moving."""


def measure_real(folder: Path) -> Numbers:
    """The numbers of a release's first scenario, the real one."""
    return measure([find_release(folder).scenarios[0]])


def measure_generated() -> Numbers:
    """The numbers of normal scenarios like the real one: three-way, with lights, clear noon; ego
    turns right.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        spec = folder / "like_the_real_one.yaml"
        spec.write_text(_like_the_real_one(), encoding="utf-8")
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
        return measure(
            [scenario for scenario in find_release(root).scenarios if scenario.token in tokens]
        )


def _like_the_real_one() -> str:
    """Design 6 without what the real scenario does not have: two lanes, a hump, a hidden view,
    rain, night.
    """
    spec = yaml.safe_load(design_text(6))
    spec["road"] = {"kind": "three-way", "signalized": True, "lanes": 1}
    ego, other = spec["actors"][0], spec["actors"][2]
    ego["from"], ego["turn"], other["from"], other["turn"] = (
        other["from"],
        other["turn"],
        ego["from"],
        ego["turn"],
    )
    return yaml.safe_dump(
        {**spec, "view": "open", "exchange": False, "weather": "Clear", "time_of_day": "Noon"}
    )


def measure(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """The numbers of scenarios together: mean numbers of actors, and shares and percentiles of all
    rows.
    """
    numbers: Numbers = {"scenarios": len(scenarios), "frames": mean(map(_frames, scenarios))}
    by_scenario = [_actors(scenario) for scenario in scenarios]
    numbers |= {key: mean(each[key] for each in by_scenario) for key in by_scenario[0]}
    labels = [(agent, _labels(scenario, agent)) for scenario in scenarios for agent in AGENTS]
    numbers |= _boxes([each for _, each in labels])
    numbers |= _clouds(scenarios)
    numbers |= _calibs(scenarios)
    return numbers | _sizes(scenarios)


def _frames(scenario: ScenarioFolder) -> int:
    return len(list(scenario.kind_folder(AGENTS[0], "label").iterdir()))


def _labels(scenario: ScenarioFolder, agent: str) -> Labels:
    return read_labels(
        [scenario.label_path(agent, frame) for frame in range(1, _frames(scenario) + 1)]
    )


def _actors(scenario: ScenarioFolder) -> Numbers:
    """How many annotated actors of each kind there are."""
    own_ids = dict(zip(AGENTS, read_meta(scenario.meta_path).agent_ids or (), strict=False))
    fastest: dict[int, float] = {}
    category: dict[int, int] = {}
    for agent in AGENTS:
        labels = _labels(scenario, agent)
        ids = np.where(labels.actor_id == OWN_ACTOR_ID, own_ids.get(agent, 0), labels.actor_id)
        for actor, code, speed in zip(
            ids.tolist(), labels.category.tolist(), _speed(labels).tolist(), strict=True
        ):
            if actor > 0:
                fastest[actor], category[actor] = max(fastest.get(actor, 0.0), speed), code
    driven = {
        actor: code
        for actor, code in category.items()
        if actor < STATIC_ACTOR_ID and code != _PEDESTRIAN
    }
    return {
        "four-wheelers that drive": sum(
            code not in _TWO_WHEELERS and fastest[actor] > _MOVING for actor, code in driven.items()
        ),
        "four-wheelers that wait": sum(
            code not in _TWO_WHEELERS and fastest[actor] <= _MOVING
            for actor, code in driven.items()
        ),
        "two-wheelers": sum(code in _TWO_WHEELERS for code in driven.values()),
        "pedestrians": sum(code == _PEDESTRIAN for code in category.values()),
        "parked": sum(actor >= STATIC_ACTOR_ID for actor in category),
    }


def _boxes(labels: Sequence[Labels]) -> Numbers:
    joined: dict[str, FloatArray] = {
        "distance": np.concatenate([np.hypot(*each.center[:, :2].T) for each in labels]),
        "speed": np.concatenate([_speed(each) for each in labels]),
    }
    points, visible, ids, codes = (
        np.concatenate([getattr(each, name) for each in labels])
        for name in ("num_lidar_pts", "camera_visible", "actor_id", "category")
    )
    other, own = ids != OWN_ACTOR_ID, ids == OWN_ACTOR_ID
    driving = other & (codes != _PEDESTRIAN) & (joined["speed"] > _MOVING)
    distance = joined["distance"]
    counts = np.concatenate([each.num_boxes for each in labels])
    numbers: Numbers = {
        "boxes, mean": float(counts.mean()),
        "boxes, least": float(counts.min()),
        "boxes, most": float(counts.max()),
        "speed, median": _percentile(joined["speed"][driving], 50),
        "speed, 95 %": _percentile(joined["speed"][driving], 95),
        "walking, median": _percentile(
            joined["speed"][(codes == _PEDESTRIAN) & (joined["speed"] > _MOVING)], 50
        ),
        "untracked": float((ids == -1).mean()),
        "points on itself": _percentile(points[own], 50),
        "without points": float((points[other] == 0).mean()),
        "visible": float(visible[other].mean()),
    }
    numbers |= {
        f"distance, {share} %": _percentile(distance[other], share) for share in (10, 50, 90, 100)
    }
    for name, (low, high) in _BINS.items():
        rows: BoolArray = other & (distance >= low) & (distance < high)
        numbers[f"boxes {name}"] = float(rows[other].mean())
        numbers[f"without points {name}"] = float((points[rows] == 0).mean())
        numbers[f"visible {name}"] = float(visible[rows].mean())
        numbers[f"points on a car {name}"] = _percentile(
            points[rows & (codes == _CAR) & (points > 0)], 50
        )
    return numbers


def _clouds(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Sizes of clouds, and how labels' numbers of points differ from a recount."""
    sizes: dict[bool, list[int]] = {True: [], False: []}
    told, counted = [], []
    for scenario, agent, frame in _clouded(scenarios):
        cloud, labels = (
            read_lidar(scenario.channel_path(agent, LIDAR, frame)),
            read_label(scenario.label_path(agent, frame)),
        )
        sizes[agent == INFRASTRUCTURE].append(len(cloud))
        told.append(labels.num_lidar_pts)
        counted.append(labels.boxes().count_points(cloud.xyz))
    stored, recount = np.concatenate(told), np.concatenate(counted)
    with_points = (stored > 0) | (recount > 0)
    off = with_points & (stored != recount)
    numbers = {
        "counts that differ": float(off[with_points].mean()),
        "counts, by": _percentile(np.abs(stored - recount)[off] / np.maximum(stored, 1)[off], 50),
    }
    for pole, name in (
        (False, "points of a vehicle's cloud"),
        (True, "points of the pole's cloud"),
    ):
        numbers |= {f"{name}, {key}": float(of(sizes[pole])) for key, of in _ENDS.items()}
    return numbers


_ENDS: dict[str, Callable[[Sequence[int]], float]] = {"mean": np.mean, "least": min, "most": max}


def _clouded(scenarios: Sequence[ScenarioFolder]) -> list[tuple[ScenarioFolder, str, int]]:
    return [
        (scenario, agent, frame)
        for scenario in scenarios
        for agent in AGENTS
        for frame in range(1, _frames(scenario) + 1)
        if scenario.channel_path(agent, LIDAR, frame).exists()
    ]


def _calibs(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """How much a vehicle's LiDAR and front camera move relative to it from frame to frame."""
    shifts, turns, heights = [], [], []
    for scenario in scenarios:
        for agent in AGENTS[:-1]:
            frames = range(1, _frames(scenario) + 1)
            calibs = read_calibs([scenario.calib_path(agent, frame) for frame in frames])
            for poses in (calibs.ego_from_lidar, calibs.camera_from_lidar[:, 0]):
                shifts.append(np.ptp(poses[:, :3, 3], axis=0).max())
                turns.append(np.ptp(poses[:, :3, :3], axis=0).max())
            own = read_label(scenario.label_path(agent, 1))
            heights.append(
                read_calib(scenario.calib_path(agent, 1)).ego_from_lidar.translation[2]
                - own.size[own.actor_id == OWN_ACTOR_ID][0, 2]
            )
    return {
        "LiDAR above its vehicle": float(np.mean(heights)),
        "calib, shift": float(np.max(shifts)),
        "calib, turn": float(np.max(turns)),
    }


def _sizes(scenarios: Sequence[ScenarioFolder]) -> Numbers:
    """Mean sizes of files, kB; of images only those of the pole, at the frames whose clouds are
    measured.
    """
    frames = [
        (s, agent, frame)
        for s in scenarios
        for agent in AGENTS
        for frame in range(1, _frames(s) + 1)
    ]
    paths = {
        "label": [s.label_path(agent, frame) for s, agent, frame in frames],
        "calib": [s.calib_path(agent, frame) for s, agent, frame in frames],
        "LiDAR": [s.channel_path(agent, LIDAR, frame) for s, agent, frame in _clouded(scenarios)],
        "image": [
            path
            for s in scenarios
            for path in sorted(s.kind_folder(INFRASTRUCTURE, "Camera_Front").rglob("*.jpg"))
        ],
    }
    return {
        f"kB, {kind}": mean(path.stat().st_size for path in each) / 1000
        for kind, each in paths.items()
    }


def _speed(labels: Labels) -> FloatArray:
    return np.asarray(np.hypot(*labels.velocity.T))


def _percentile(values: FloatArray, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else 0.0


_ROWS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("scenarios, frames of each", "{:.0f}, {:.0f}", ("scenarios", "frames")),
    ("four-wheelers that drive", "{:.1f}", ("four-wheelers that drive",)),
    ("motorcycles and cyclists", "{:.1f}", ("two-wheelers",)),
    ("pedestrians", "{:.1f}", ("pedestrians",)),
    ("parked vehicles", "{:.1f}", ("parked",)),
    (
        "speed of moving vehicles: median, 95 % (m/s)",
        "{:.1f}, {:.1f}",
        ("speed, median", "speed, 95 %"),
    ),
    ("speed of moving pedestrians: median (m/s)", "{:.1f}", ("walking, median",)),
    (
        "boxes in a label: mean (least–most)",
        "{:.0f} ({:.0f}–{:.0f})",
        ("boxes, mean", "boxes, least", "boxes, most"),
    ),
    (
        "distance of boxes: 10, 50, 90, 100 % (m)",
        "{:.0f}, {:.0f}, {:.0f}, {:.0f}",
        tuple(f"distance, {share} %" for share in (10, 50, 90, 100)),
    ),
    ("rows without an id (−1)", "{:.2%}", ("untracked",)),
    ("boxes without points", "{:.0%}", ("without points",)),
    *((f"… at {name} m", "{:.0%}", (f"without points {name}",)) for name in _BINS),
    ("boxes in view of a camera", "{:.0%}", ("visible",)),
    *((f"… at {name} m", "{:.0%}", (f"visible {name}",)) for name in _BINS),
    ("points on a car that has any: median, at 0–10 m", "{:.0f}", ("points on a car 0–10",)),
    *((f"… at {name} m", "{:.0f}", (f"points on a car {name}",)) for name in list(_BINS)[1:]),
    ("points on the agent's own box: median", "{:.0f}", ("points on itself",)),
    (
        "counts that differ from a recount; median difference",
        "{:.0%}, {:.1%}",
        ("counts that differ", "counts, by"),
    ),
    *(
        (
            f"{name}: mean (least–most)",
            "{:,.0f} ({:,.0f}–{:,.0f})",
            tuple(f"{name}, {key}" for key in _ENDS),
        )
        for name in ("points of a vehicle's cloud", "points of the pole's cloud")
    ),
    ("LiDAR above its vehicle's box height (m)", "{:.2f}", ("LiDAR above its vehicle",)),
    ("calib, from frame to frame: greatest shift (mm)", "{:.2f}", ("calib, shift",)),
    (
        "calib, from frame to frame: greatest change of an element of a rotation",
        "{:.0e}",
        ("calib, turn",),
    ),
    ("label file (kB)", "{:.1f}", ("kB, label",)),
    ("calib file (kB)", "{:.1f}", ("kB, calib",)),
    ("LiDAR file (kB)", "{:.0f}", ("kB, LiDAR",)),
    ("image of the pole's front camera, 1600×900 (kB)", "{:.0f}", ("kB, image",)),
)
"""The rows of the table: heading, format of a cell, and the numbers in it."""
_SCALE = {"calib, shift": 1000.0}


def table(real: Numbers, generated: Numbers) -> str:
    """The table of the real scenario and the generated ones, one number in each row."""
    lines = ["| | real | generated |", "|---|---|---|"]
    for heading, form, keys in _ROWS:
        cells = [
            form.format(*(_SCALE.get(key, 1.0) * numbers[key] for key in keys)).replace("%", " %")
            for numbers in (real, generated)
        ]
        lines.append(f"| {heading} | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)
