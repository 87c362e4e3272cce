"""What a link does to boxes and clouds: arrows are as long as the error, and the legend says so."""

from typing import Any

import numpy as np
import pytest
from drawing import legend_words, of_kind
from matplotlib.quiver import Quiver
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.bev import link_words
from deepaccident_devkit.render.link import render_link, shared_boxes
from deepaccident_devkit.v2x import Link, PoseNoise

NOISE = Link(pose_noise=PoseNoise(mean=0.5, std=0.0))


@pytest.fixture(scope="module")
def moving(da_motion: DeepAccident) -> Any:
    """A sample of the ego, 1.5 s before the impact."""
    return da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 20)


def drawn(da: DeepAccident, sample: Any, link: Link, **how: Any) -> Any:
    figure = detached_figure((12, 5))
    assert render_link(da, sample, link, fig=figure, **how) is figure
    return figure


def test_arrows_are_as_long_as_the_poses_are_off(da_motion: DeepAccident, moving: Any) -> None:
    figure = drawn(
        da_motion, moving, NOISE, agents=["ego_vehicle", "other_vehicle"], layers=["boxes"]
    )
    (ax,) = figure.axes
    (found,) = of_kind(ax, Quiver)
    true = da_motion.cooperative_boxes(moving, agents=["other_vehicle"], frame="ego").center[:, :2]
    assert np.linalg.norm(found.XY[:, None] - true, axis=-1).min(axis=1).max() < 1e-9
    np.testing.assert_allclose(
        np.hypot(found.U, found.V), 0.5, atol=2.5e-3
    )  # the agents may stand on a slope, 10 % at most
    assert ax.get_title() == "boxes, off by at most 0.50 m"


def test_latency_moves_only_what_moves(da_motion: DeepAccident, moving: Any) -> None:
    (shared,) = shared_boxes(da_motion, moving, Link(latency=0.5), ["infrastructure"])
    start, end = shared.shifts
    parked = shared.true.actor_id[np.isin(shared.true.actor_id, shared.received.actor_id)] >= 20000
    apart = np.linalg.norm(end - start, axis=1)
    np.testing.assert_allclose(apart[parked], 0, atol=1e-6)
    assert apart.max() > 1.0


def test_a_lost_message_is_said(da_motion: DeepAccident, moving: Any) -> None:
    figure = drawn(da_motion, moving, Link(packet_loss=1.0), agents="+behind", layers=["boxes"])
    assert (legend_words(figure)[0], of_kind(figure.axes[0], Quiver)) == (
        "ego behind: nothing arrived",
        [],
    )


def test_clouds_are_side_by_side(da: DeepAccident) -> None:
    sample, link = da.get_sample(da.scenario[0], "ego_vehicle", 5), Link(latency=0.2)
    _, now, late = drawn(da, sample, link, agents="+other", view_range=50.0).axes
    for ax, through in ((now, None), (late, link)):
        cloud = da.aggregate_point_cloud(
            sample, agents=["other_vehicle"], frame="ego", link=through
        ).xyz[:, :2]
        shown = cloud[(np.abs(cloud) < 50).all(axis=1)]
        drawn_ = [np.asarray(each.get_offsets()) for each in ax.collections]
        assert any(each.shape == shown.shape and np.allclose(each, shown) for each in drawn_)


@pytest.mark.parametrize(
    ("layers", "place", "panels"),
    [(["boxes"], None, 1), (None, None, 3), (None, "slide", 2), (None, "cvpr-column", 1)],
)
def test_all_partners_are_in_one_panel(
    da: DeepAccident, layers: Any, place: Any, panels: int
) -> None:
    with style(place):
        figure = drawn(da, da.get_sample(da.scenario[0], "ego_vehicle", 5), NOISE, layers=layers)
    assert len(figure.axes) == panels
    names = {words.split(":")[0] for words in legend_words(figure)}
    assert not lacking(names, "ego behind", "other", "other behind", "infrastructure")


@pytest.mark.parametrize(
    ("link", "facts"),
    [
        (Link(latency=0.2), ["0.2 s"]),
        (
            Link(pose_noise=PoseNoise(mean=0.3, heading_std=0.1), packet_loss=0.1),
            ["0.3 m", "5.7°", "10 %"],
        ),
        (Link(budget=12_000, payload="boxes"), ["12,000 bytes"]),
    ],
)
def test_a_link_in_words(link: Link, facts: list[str]) -> None:
    assert not lacking(link_words(link), *facts)
