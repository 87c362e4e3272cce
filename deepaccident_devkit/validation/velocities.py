"""In which frame are the labels' velocities? Every hypothesis of format.md, tried against displacements."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, IntArray
from deepaccident_devkit.tables import Finding
from deepaccident_devkit.taxonomy import STATIC_ACTOR_ID
from deepaccident_devkit.validation.subject import Subject

HYPOTHESES: dict[str, str] = {
    "lidar": "the recording agent's LiDAR frame, as the dataset's author says",
    "world": "the world frame",
    "turned-wrong": "the world frame turned by the agent's yaw with the wrong sign",
}
_LEAST_SPEED = 1.0
"""m/s; slower actors tell nothing."""
_FITS = (0.5, 0.15)
"""m/s, and as a share of the speed, within which a velocity fits."""
_LEAST_BOXES = 20
_LEAST_SHARE = 0.5
_ACTOR_OFF = (3, 0.8)
"""Boxes of an actor, and the share of them, that must not fit before its velocities are said to be off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityFit:
    """How many boxes' velocities fit their displacement under each hypothesis; adds up over scenarios.

    Attributes:
        boxes: moving, tracked boxes of others that have both velocities.
        fits: hypothesis → boxes that fit.
    """

    boxes: int
    fits: Mapping[str, int]

    @property
    def best(self) -> str | None:
        """The hypothesis that fits most boxes; None if there are too few, or none fits half of them."""
        name = max(self.fits, key=lambda hypothesis: self.fits[hypothesis])
        return name if self.boxes >= _LEAST_BOXES and self.fits[name] >= _LEAST_SHARE * self.boxes else None


def fit_velocities(subject: Subject) -> VelocityFit:
    """Try every hypothesis on a scenario."""
    rows, fits = _fitting(subject)
    return VelocityFit(boxes=len(rows), fits={name: int(fit.sum()) for name, fit in fits.items()})


def _fitting(subject: Subject) -> tuple[IntArray, dict[str, BoolArray]]:
    """The boxes (M,) that tell something, and which of them fit each hypothesis."""
    rows = np.flatnonzero(subject.seen & (subject.label_id < STATIC_ACTOR_ID))
    moved, said = subject.velocity[rows, :2], subject.boxes.labels.velocity[rows]
    speed = np.linalg.norm(moved, axis=1)
    known = (speed > _LEAST_SPEED) & np.isfinite(said).all(axis=1)
    rows, moved, said, speed = rows[known], moved[known], said[known], speed[known]
    pose = subject.boxes.world_from_lidar[subject.boxes.sample[rows]]
    yaw = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    fits = {}
    for hypothesis, angle in {"lidar": yaw, "world": np.zeros_like(yaw), "turned-wrong": -yaw}.items():
        cos, sin = np.cos(angle), np.sin(angle)
        in_world = np.column_stack([cos * said[:, 0] - sin * said[:, 1], sin * said[:, 0] + cos * said[:, 1]])
        off = np.linalg.norm(in_world - moved, axis=1)
        fits[hypothesis] = off < _FITS[0] + _FITS[1] * speed
    return rows, fits


def total_fit(fits: list[VelocityFit]) -> VelocityFit:
    """The sum over scenarios."""
    return VelocityFit(
        boxes=sum(fit.boxes for fit in fits), fits={name: sum(fit.fits[name] for fit in fits) for name in HYPOTHESES}
    )


def check_velocities(subject: Subject, fit: VelocityFit) -> Iterator[Finding]:
    """Say that another frame than the author's fits, that none does, or which actors' velocities do not fit."""
    if fit.boxes < _LEAST_BOXES:
        return
    if fit.best is not None:
        yield from _actors_off(subject, fit.best)
    if fit.fits["lidar"] >= _LEAST_SHARE * fit.boxes:
        return
    shares = ", ".join(f"{name} {count / fit.boxes:.0%}" for name, count in fit.fits.items())
    code = "velocity-frame" if fit.best else "velocity-unexplained"
    yield subject.finding(code, subject.token, f"of {fit.boxes} moving boxes fit: {shares}")


def _actors_off(subject: Subject, hypothesis: str) -> Iterator[Finding]:
    """The tracks most of whose velocities do not fit the hypothesis that fits the rest."""
    rows, fits = _fitting(subject)
    tracks, track = np.unique(
        np.column_stack([subject.boxes.agent[rows], subject.label_id[rows]]), axis=0, return_inverse=True
    )
    track = track.reshape(-1)
    count = np.bincount(track, minlength=len(tracks))
    wrong = np.bincount(track[~fits[hypothesis]], minlength=len(tracks))
    least, share = _ACTOR_OFF
    off = (wrong >= least) & (wrong >= share * count)
    wrong_rows = subject.mask(rows[off[track] & ~fits[hypothesis]])
    yield from subject.label_findings("velocity-off", wrong_rows, "velocities do not fit the displacement")
