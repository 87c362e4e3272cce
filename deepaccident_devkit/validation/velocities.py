"""How the labels' velocities are written, and which actors' do not fit (docs/conventions.md, velocity)."""

from collections.abc import Iterator

import numpy as np

from deepaccident_devkit.tables import Finding
from deepaccident_devkit.tables.velocities import LEAST_BOXES, VelocityFit, velocities_that_fit
from deepaccident_devkit.taxonomy import RELEASED_VELOCITY_FRAME, VELOCITY_FRAMES
from deepaccident_devkit.validation.subject import Subject

_ACTOR_OFF = (3, 0.8)
"""How many boxes of an actor, and which share of them, must not fit for a finding."""


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
        np.column_stack([subject.boxes.agent[rows], subject.label_id[rows]]), axis=0, return_inverse=True
    )
    track = track.reshape(-1)
    count = np.bincount(track, minlength=len(tracks))
    wrong = np.bincount(track[~fits[frame]], minlength=len(tracks))
    least, share = _ACTOR_OFF
    off = (wrong >= least) & (wrong >= share * count)
    wrong_rows = subject.mask(rows[off[track] & ~fits[frame]])
    yield from subject.label_findings("velocity-off", wrong_rows, "velocities do not fit the displacement")
