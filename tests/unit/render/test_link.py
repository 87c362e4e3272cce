"""What a link does to boxes and clouds: arrows are as long as the error, and the legend says so."""

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.quiver import Quiver
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.bev import link_words
from deepaccident_devkit.render.link import render_link, shared_boxes
from deepaccident_devkit.render.styles import AGENT_COLORS, TRUE_PLACE_COLOR
from deepaccident_devkit.v2x import Link, PoseNoise

NOISE = Link(pose_noise=PoseNoise(mean=0.5, std=0.0))


def drawn(da: DeepAccident, sample: Any, link: Link, **how: Any) -> Any:
    figure = detached_figure((12, 5))
    assert render_link(da, sample, link, fig=figure, **how) is figure
    return figure


def legend(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def arrows(ax: Any) -> list[Quiver]:
    return [each for each in ax.collections if isinstance(each, Quiver)]


def test_arrows_are_as_long_as_the_poses_are_off(da_motion: DeepAccident) -> None:
    sample = da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 20)
    figure = drawn(da_motion, sample, NOISE, agents=["ego_vehicle", "other_vehicle"], layers=["boxes"])
    (ax,) = figure.axes
    (found,) = arrows(ax)
    true = da_motion.cooperative_boxes(sample, agents=["other_vehicle"], frame="ego")
    for place in found.XY:
        assert np.linalg.norm(true.center[:, :2] - place, axis=1).min() < 1e-9
    assert_allclose(np.hypot(found.U, found.V), 0.5, atol=2.5e-3)  # the agents may stand on a slope, 10 % at most
    assert ax.get_title().startswith("other: ")
    assert ax.get_title().endswith("\noff by 0.50 m\n(at most 0.50 m)")
    hues = {to_hex(color) for each in ax.collections for color in each.get_edgecolor()}
    assert {AGENT_COLORS["other_vehicle"], TRUE_PLACE_COLOR} <= hues
    assert legend(figure)[-1] == "the error"


def test_latency_moves_only_what_moves(da_motion: DeepAccident) -> None:
    sample = da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 20)
    (shared,) = shared_boxes(da_motion, sample, Link(latency=0.5), ["infrastructure"])
    start, end = shared.shifts
    parked = shared.true.actor_id[np.isin(shared.true.actor_id, shared.received.actor_id)] >= 20000
    apart = np.linalg.norm(end - start, axis=1)
    assert_allclose(apart[parked], 0, atol=1e-6)
    assert apart.max() > 1.0


def test_a_lost_message_is_said(da_motion: DeepAccident) -> None:
    sample = da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 20)
    figure = drawn(da_motion, sample, Link(packet_loss=1.0), agents="+behind", layers=["boxes"])
    assert figure.axes[0].get_title() == "ego behind: nothing arrived"
    assert arrows(figure.axes[0]) == []


def test_clouds_are_side_by_side(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 5)
    figure = drawn(da, sample, Link(latency=0.2), agents="+other")
    assert [ax.get_title() for ax in figure.axes[1:]] == ["clouds without the link", "clouds with the link"]
    late = da.aggregate_point_cloud(sample, agents=["other_vehicle"], frame="ego", link=Link(latency=0.2)).xyz[:, :2]
    now = da.aggregate_point_cloud(sample, agents=["other_vehicle"], frame="ego").xyz[:, :2]
    for cloud, ax in ((now, figure.axes[1]), (late, figure.axes[2])):
        shown = cloud[(np.abs(cloud) < 50).all(axis=1)]
        assert any(
            len(each.get_offsets()) == len(shown) and np.allclose(each.get_offsets(), shown) for each in ax.collections
        )


@pytest.mark.parametrize(("layers", "panels"), [(["boxes"], 4), (None, 6)])
def test_each_partner_has_a_panel_of_its_own(da: DeepAccident, layers: Any, panels: int) -> None:
    figure = drawn(da, da.get_sample(da.scenario[0], "ego_vehicle", 5), NOISE, layers=layers)
    assert len(figure.axes) == panels
    names = {ax.get_title().split(":")[0] for ax in figure.axes}
    assert names >= {"ego behind", "other", "other behind", "infrastructure"}


def test_a_link_in_words() -> None:
    assert link_words(Link(latency=0.2)) == "latency 0.2 s"
    said = link_words(Link(pose_noise=PoseNoise(mean=0.3, heading_std=0.1), packet_loss=0.1))
    assert said == "latency 0 s, poses off by 0.3 m (σ 0.02 m), headings by σ 5.7°, 10 % of messages lost"
