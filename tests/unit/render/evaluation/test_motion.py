"""Panels of motion results: what they draw is what the counts say."""

import numpy as np
from drawing import new_axes, words
from numpy.testing import assert_allclose

from deepaccident_devkit.evaluation import MotionEvaluator
from deepaccident_devkit.render.evaluation import render_quality_by_time


def moving() -> MotionEvaluator:
    """Two samples, of two frames and of one."""
    evaluator = MotionEvaluator("paper")
    for token, frames in {"a": 2, "b": 1}.items():
        vpq = [[[0.8] * frames, [1] * frames, [0, 2][:frames], [0] * frames], [[0.0] * frames] * 4]
        counts = {
            "samples": 1,
            "frames": frames,
            "instance_maps": 0,
            "cells": [[3, 1, 0], [0, 0, 0]],
            "vpq": vpq,
            "paths": None,
        }
        evaluator.add(token, counts)
    return evaluator


def test_motion_is_drawn_by_frame() -> None:
    ax = render_quality_by_time(moving(), ax=new_axes())
    assert_allclose(ax.lines[0].get_xydata(), [(0, 80), (0.5, 40)])
    assert np.isnan(ax.lines[1].get_ydata()).all()
    assert "nothing to count" in words(render_quality_by_time(MotionEvaluator(), ax=new_axes()))
