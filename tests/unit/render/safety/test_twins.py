from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.safety import render_twins
from deepaccident_devkit.safety import Parting, twin_diff


def test_both_recordings_from_above_and_their_speeds(da_motion: DeepAccident) -> None:
    diff = twin_diff(da_motion, da_motion.find(collision=True)[0])
    figure = render_twins(diff)
    parting, impact, speeds = figure.axes
    assert impact.get_title() == f"impact: {(diff.num_frames[0] - 1) / 10:.1f} s"
    assert parting.get_title() == f"they part: {(diff.parting_frame - 1) / 10:.1f} s"
    lines = [line for line in speeds.lines if len(line.get_xdata()) == diff.speeds.shape[-1]]
    drawn = np.array([line.get_ydata() for line in lines])
    np.testing.assert_array_equal(drawn, [diff.speeds[at, row] for row in diff.pair for at in (0, 1)])
    paths = [line for line in impact.lines if len(line.get_xdata()) == diff.num_frames[0]]
    ends = [line.get_xydata()[-1].tolist() for line in paths]
    assert ends == [diff.poses[at, row, diff.num_frames[0] - 1, :2].tolist() for at in (1, 0) for row in diff.pair]
    places = diff.poses[:, list(diff.pair), diff.num_frames[0] - 1, :2].reshape(-1, 2)
    assert impact.viewLim.contains(*places.mean(axis=0))
    figure.canvas.draw()


def test_twins_that_never_part_on_a_given_figure(da_motion: DeepAccident) -> None:
    diff = twin_diff(da_motion, da_motion.find(collision=True)[0], Parting(distance=1e4, heading=4.0))
    figure = Figure(layout="constrained")
    assert render_twins(diff, fig=figure) is figure
    assert not plt.get_fignums()
    assert figure.axes[0].get_title() == "they never part: 0.0 s"


@pytest.mark.parametrize("missing", [0, 1])
def test_colliders_that_a_recording_lacks(da_motion: DeepAccident, missing: int) -> None:
    diff = twin_diff(da_motion, da_motion.find(collision=True)[0])
    poses = diff.poses.copy()
    poses[missing, list(diff.pair)] = np.nan
    render_twins(replace(diff, poses=poses), fig=Figure(layout="constrained")).canvas.draw()
