"""Checks over the frames of a scenario: poses, velocities, and boxes without a track."""

from collections.abc import Callable, Iterator

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.boxes import LEAST_BOXES, VelocityFit, velocities_that_fit
from deepaccident_devkit.tables.build import ROTATION_TOLERANCE, TRANSLATION_TOLERANCE
from deepaccident_devkit.taxonomy import (
    CAMERAS,
    CATEGORIES,
    FRAME_PERIOD,
    RELEASED_VELOCITY_FRAME,
    UNTRACKED_ID,
    VELOCITY_FRAMES,
)
from deepaccident_devkit.validation.agreement import SAME_PLACE
from deepaccident_devkit.validation.subject import Subject, frames_text, near_pairs

CAMERA_YAW = dict(zip(CAMERAS, (0.0, 55.0, -55.0, 180.0, 110.0, -110.0), strict=True))
"""Degrees to the left of the agent's front."""
CAMERA_FIELD = {**dict.fromkeys(CAMERAS, 70.0), "Camera_Back": 110.0}
"""Horizontal field of view, degrees."""
_YAW_TOLERANCE = 5.0
_FIELD_TOLERANCE = 0.02
# Metres from the LiDAR: a truck's front is up to 4.8 m from its middle, the release's poles have theirs at 5.1 m.
_FURTHEST_CAMERA = 5.5
_TILT = np.sin(np.radians(10.0))
# Metres between a camera's height and that of the others.
_CAMERA_HEIGHTS = 0.4
_LIDAR_HEIGHTS = (0.8, 4.5)
_POLE_MOUNT = 0.01
_POLE_CHANGE = 0.02
# Metres off the middle of the frames around.
_JUMP = 0.75
# The blow can be up to three frames before the last; what follows it fits no displacement. Of fewer than eight frames
# the first half is judged all the same.
_LAST_FRAMES = 4
# m/s, and as a share of the speed, between a label's first line and the displacement around it.
_SPEED_DIFFERENCE = (1.0, 0.2)
# How many boxes of an actor, and which share of them, must not fit for a finding.
_ACTOR_OFF = (3, 0.8)
# Metres within which a vehicle that the agent saw is not too far away to be tracked.
_TRACKING_RADIUS = 15.0
# The number of boxes that must show it: the tracking of a single one comes and goes.
_LEAST_BOXES = 2
_VEHICLES = tuple(CATEGORIES.index(name) for name in ("car", "truck", "van"))


def check_poses(subject: Subject) -> Iterator[Finding]:
    """All findings in the calib files of a scenario and the labels' first lines."""
    for agent in range(len(subject.agents)):
        for check in _CHECKS:
            yield from check(subject, agent)


def _frames_of(subject: Subject, agent: int) -> slice:
    return slice(agent * subject.num_frames, (agent + 1) * subject.num_frames)


def _intrinsics(subject: Subject, agent: int) -> Iterator[Finding]:
    intrinsic = subject.files.calibs.intrinsic[_frames_of(subject, agent)]
    focal = intrinsic[..., (0, 1), (0, 1)]
    rest = np.abs(intrinsic[..., (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] - (0.0, 0.0, 0.0, 0.0, 1.0))
    pinhole: BoolArray = np.asarray((focal > 0).all(axis=-1) & (rest < 1e-6).all(axis=-1))
    ratio = focal[..., 0] / np.where(intrinsic[..., 0, 2] > 0, intrinsic[..., 0, 2], np.nan)
    expected = 1 / np.tan(np.radians([CAMERA_FIELD[camera] for camera in CAMERAS]) / 2)
    square = (
        np.abs(focal[..., 1] / np.where(focal[..., 0] > 0, focal[..., 0], np.nan) - 1)
        < _FIELD_TOLERANCE
    )
    odd = pinhole & ~((np.abs(ratio / expected - 1) < _FIELD_TOLERANCE) & square)
    yield from _camera_findings(
        subject, agent, "intrinsic-form", ~pinhole, "is no pinhole camera's K"
    )
    yield from _camera_findings(
        subject, agent, "intrinsic-odd", odd, "its f does not fit its field of view"
    )


def _cameras(subject: Subject, agent: int) -> Iterator[Finding]:
    pose = subject.files.calibs.camera_from_lidar[_frames_of(subject, agent)]
    forward = pose[..., 2, :3]  # the optical axis in the LiDAR frame
    yaw = np.degrees(np.arctan2(forward[..., 1], forward[..., 0]))
    off = np.abs((yaw - [CAMERA_YAW[camera] for camera in CAMERAS] + 180) % 360 - 180)
    position = -np.einsum("...ji,...j->...i", pose[..., :3, :3], pose[..., :3, 3])
    height = position[..., 2]
    far = np.linalg.norm(position, axis=-1) > _FURTHEST_CAMERA
    if not subject.is_pole(agent):  # a pole's may look down
        far |= (np.abs(pose[..., 0, 2]) > _TILT) | (
            np.abs(forward[..., 2]) > _TILT
        )  # rolled or pitched
    far |= np.abs(height - np.median(height, axis=-1, keepdims=True)) > _CAMERA_HEIGHTS
    bad: BoolArray = (off > _YAW_TOLERANCE) | far
    yield from _camera_findings(
        subject, agent, "camera-misplaced", bad, "looks another way, or is far from the LiDAR"
    )


def _camera_findings(
    subject: Subject, agent: int, code: str, bad: BoolArray, what: str
) -> Iterator[Finding]:
    """A finding a camera for a mask (F, 6)."""
    for camera, frames in zip(CAMERAS, bad.T, strict=True):
        if frames.any():
            where = f"{subject.calib_where(agent)}: {camera}"
            yield subject.finding(code, where, f"{what}, {frames_text(np.flatnonzero(frames) + 1)}")


def _mounts(subject: Subject, agent: int) -> Iterator[Finding]:
    calibs, frames = subject.files.calibs, _frames_of(subject, agent)
    lidar = calibs.ego_from_lidar[frames]
    height = lidar[:, 2, 3]
    if subject.is_pole(agent):
        odd = np.abs(lidar - np.eye(4)).max(axis=(1, 2)) > _POLE_MOUNT
        expected = "expected the identity on a pole"
    else:
        odd = (height < _LIDAR_HEIGHTS[0]) | (height > _LIDAR_HEIGHTS[1])
        expected = "expected {} to {} m above the road".format(*_LIDAR_HEIGHTS)
    if odd.any():
        yield subject.finding(
            "lidar-height",
            subject.calib_where(agent),
            f"{expected}, {frames_text(np.flatnonzero(odd) + 1)}",
        )
    for name, pose in {
        "lidar_to_ego": lidar,
        "lidar_to_Camera": calibs.camera_from_lidar[frames],
    }.items():
        change = np.abs(pose - np.median(pose, axis=0))
        moved = change[..., :3, 3].reshape(len(pose), -1).max(axis=1)
        turned = change[..., :3, :3].reshape(len(pose), -1).max(axis=1)
        off = (moved > TRANSLATION_TOLERANCE) | (turned > ROTATION_TOLERANCE)
        if off.any():
            what = f"{name} changes by up to {1000 * moved.max():.0f} mm and {turned.max():.2g} in its rotation"
            yield subject.finding(
                "calib-changes",
                subject.calib_where(agent),
                f"{what}, {frames_text(np.flatnonzero(off) + 1)}",
            )
    intrinsic = calibs.intrinsic[frames]
    if (np.abs(intrinsic - intrinsic[0]) > 1.0).any():
        yield subject.finding("calib-changes", subject.calib_where(agent), "intrinsics change")


def _path(subject: Subject, agent: int) -> Iterator[Finding]:
    position = subject.positions[agent]
    where = subject.calib_where(agent)
    up = subject.files.calibs.world_from_ego[_frames_of(subject, agent), 2, 2]
    if (up < np.cos(np.radians(45))).any():
        tilted = np.flatnonzero(up < np.cos(np.radians(45))) + 1
        yield subject.finding("pose-tilted", where, f"over 45° in {frames_text(tilted)}")
    if subject.is_pole(agent):
        pose = subject.files.calibs.world_from_ego[_frames_of(subject, agent)]
        moved = np.abs(pose - np.median(pose, axis=0)).max(axis=(1, 2)) > _POLE_CHANGE
        if moved.any():
            yield subject.finding("pole-moves", where, frames_text(np.flatnonzero(moved) + 1))
        return
    bend = np.linalg.norm(position[2:] - 2 * position[1:-1] + position[:-2], axis=1) / 2
    jumps = np.flatnonzero(bend > _JUMP) + 2
    jumps = jumps[jumps <= subject.num_frames - 1 - _LAST_FRAMES]
    if len(jumps):
        yield subject.finding(
            "pose-jump", where, f"over {_JUMP} m off the frames around at {frames_text(jumps)}"
        )


def _speed(subject: Subject, agent: int) -> Iterator[Finding]:
    """A label's first line against the agent's displacement: central differences, but not in the last frames."""
    name = subject.agents[agent]
    if name not in subject.files.scan.labelled:
        return
    start = list(subject.files.scan.labelled).index(name) * subject.num_frames
    said = subject.files.labels.agent_velocity[start : start + subject.num_frames]
    moved = _central(subject.positions[agent, :, :2])
    least, share = _SPEED_DIFFERENCE
    off = ~(
        np.linalg.norm(said - moved, axis=1) <= least + share * np.linalg.norm(moved, axis=1)
    )  # NaN is off too
    off[max(subject.num_frames // 2, subject.num_frames - _LAST_FRAMES) :] = False
    if off.any():
        what = f"the first line is over {least:.0f} m/s off the displacement, {frames_text(np.flatnonzero(off) + 1)}"
        yield subject.finding("speed-off", subject.label_where(agent), what)


def _central(position: FloatArray) -> FloatArray:
    """(F, 2) m/s from positions (F, 2) at 10 Hz; one-sided at the ends, 0 for a single frame."""
    if len(position) < 2:
        return np.zeros_like(position)
    return np.asarray(np.gradient(position, FRAME_PERIOD, axis=0))


_CHECKS: tuple[Callable[[Subject, int], Iterator[Finding]], ...] = (
    _intrinsics,
    _cameras,
    _mounts,
    _path,
    _speed,
)


def check_velocities(subject: Subject, fit: VelocityFit) -> Iterator[Finding]:
    """Say that another frame than the release's fits, that none does, or which actors' velocities do not fit."""
    if fit.boxes < LEAST_BOXES:
        return
    if fit.best is not None:
        yield from _actors_off(subject, fit.best)
    if fit.best == RELEASED_VELOCITY_FRAME:
        return
    shares = ", ".join(f"{name} {count / fit.boxes:.0%}" for name, count in fit.fits.items())
    code = "velocity-frame" if fit.best else "velocity-unexplained"
    found = f"they are in {VELOCITY_FRAMES[fit.best]}; " if fit.best else ""
    yield subject.finding(code, subject.token, f"{found}of {fit.boxes} moving boxes fit: {shares}")


def _actors_off(subject: Subject, frame: str) -> Iterator[Finding]:
    """The tracks most of whose velocities do not fit the frame that fits the rest."""
    rows, fits = velocities_that_fit(subject.boxes, subject.velocity)
    tracks, track = np.unique(
        np.column_stack([subject.boxes.agent[rows], subject.label_id[rows]]),
        axis=0,
        return_inverse=True,
    )
    track = track.reshape(-1)
    count = np.bincount(track, minlength=len(tracks))
    wrong = np.bincount(track[~fits[frame]], minlength=len(tracks))
    least, share = _ACTOR_OFF
    off = (wrong >= least) & (wrong >= share * count)
    wrong_rows = subject.mask(rows[off[track] & ~fits[frame]])
    yield from subject.label_findings(
        "velocity-off", wrong_rows, "velocities do not fit the displacement"
    )


def check_untracked(subject: Subject) -> Iterator[Finding]:
    """Say which labels, or all labels of which agents, lost their ids."""
    agents, frames = len(subject.agents), subject.num_frames
    untracked = subject.label_id == UNTRACKED_ID
    tracked = np.bincount(subject.boxes.sample[subject.seen], minlength=agents * frames).reshape(
        agents, frames
    )
    rows = np.flatnonzero(untracked & (tracked == 0)[subject.boxes.agent, subject.boxes.frame - 1])
    rows = rows[_trackable(subject, rows)]
    shown = np.bincount(subject.boxes.sample[rows], minlength=agents * frames).reshape(
        agents, frames
    )
    for agent in range(agents):
        lost = np.flatnonzero(shown[agent] >= _LEAST_BOXES) + 1
        if not tracked[agent].any() and shown[agent].sum() >= _LEAST_BOXES:
            what = f"every id of its labels is {UNTRACKED_ID}, also of {shown[agent].sum()} boxes that can be tracked"
            yield subject.finding("ids-untracked", subject.label_where(agent), what)
        elif len(lost):
            what = f"every id is {UNTRACKED_ID}, also of actors that can be tracked, {frames_text(lost)}"
            yield subject.finding("ids-untracked", subject.label_where(agent), what)


def _trackable(subject: Subject, rows: IntArray) -> BoolArray:
    """Which untracked boxes (M,) of what their agent saw are near vehicles, or tracked by an agent no nearer."""
    labels, boxes = subject.boxes.labels, subject.boxes
    distance = np.linalg.norm(labels.center[:, :2], axis=1)
    found: BoolArray = np.isin(labels.category[rows], _VEHICLES) & (
        distance[rows] < _TRACKING_RADIUS
    )
    others = np.flatnonzero(subject.seen)
    if len(rows) and len(others):
        both = np.concatenate([rows, others])
        pairs, _ = near_pairs(subject.centers[both], boxes.frame[both], SAME_PLACE)
        pairs = np.sort(pairs, axis=1)
        pairs = pairs[(pairs[:, 0] < len(rows)) & (pairs[:, 1] >= len(rows))]
        no_nearer = distance[both[pairs[:, 1]]] >= distance[both[pairs[:, 0]]]
        found[pairs[no_nearer, 0]] = True
    return found & ((labels.num_lidar_pts[rows] > 0) | labels.camera_visible[rows])
