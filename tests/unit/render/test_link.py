"""What a link does to boxes and clouds: arrows are as long as the error, and legends report it."""

from typing import Any

import numpy as np
import pytest
from matplotlib.quiver import Quiver
from support.rendered_pixels import collections_of_kind, read_legend
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.bev import link_words
from deepaccident_devkit.render.link import render_link, shared_boxes
from deepaccident_devkit.v2x import Link, PoseNoise

NOISE = Link(pose_noise=PoseNoise(mean=0.5, std=0.0))


@pytest.fixture(scope="module")
def moving_sample(da_motion: DeepAccident) -> Any:
    """A sample of the ego, 1.5 s before the impact."""
    return da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 20)


def draw_link(da: DeepAccident, sample: Any, link: Link, **options: Any) -> Any:
    figure = detached_figure((12, 5))
    assert render_link(da, sample, link, fig=figure, **options) is figure
    return figure


def test_arrows_are_as_long_as_the_pose_error(da_motion: DeepAccident, moving_sample: Any) -> None:
    figure = draw_link(
        da_motion,
        moving_sample,
        NOISE,
        agents=["ego_vehicle", "other_vehicle"],
        layers=["boxes"],
    )
    (ax,) = figure.axes
    (arrows,) = collections_of_kind(ax, Quiver)

    boxes = da_motion.cooperative_boxes(moving_sample, agents=["other_vehicle"], frame="ego")
    distances = np.linalg.norm(arrows.XY[:, None] - boxes.center[:, :2], axis=-1)
    assert distances.min(axis=1).max() < 1e-9
    lengths = np.hypot(arrows.U, arrows.V)
    # the agents may stand on a slope, 10 % at most
    np.testing.assert_allclose(lengths, 0.5, atol=2.5e-3)
    assert read_legend(figure)[0] == "other: 0.50 m"


def test_the_two_largest_visible_errors_are_magnified(
    da_motion: DeepAccident, moving_sample: Any
) -> None:
    figure = draw_link(da_motion, moving_sample, Link(latency=0.2), layers=["boxes"])
    (ax,) = figure.axes
    shared = shared_boxes(da_motion, moving_sample, Link(latency=0.2))
    starts, ends = map(np.concatenate, zip(*[boxes.shifts for boxes in shared], strict=True))

    positions = np.stack([starts, ends])
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    is_visible = ((low < positions) & (positions < high)).all(axis=(0, 2))
    errors = np.where(is_visible, np.linalg.norm(ends - starts, axis=1), 0)
    for letter, inset in zip("AB", ax.child_axes, strict=True):
        low, high = np.array([inset.get_xlim(), inset.get_ylim()]).T
        is_magnified = ((low < positions) & (positions < high)).all(axis=(0, 2))
        assert is_magnified[errors.argmax()]
        assert inset.texts[0].get_text().startswith(f"{letter}: {errors.max():.2f} m, ×")
        errors[is_magnified] = 0
    first, second = (inset.get_position() for inset in ax.child_axes)
    assert not first.overlaps(second)

    exact = draw_link(da_motion, moving_sample, Link(), layers=["boxes"])
    assert exact.axes[0].child_axes == []


def test_latency_moves_only_what_moves(da_motion: DeepAccident, moving_sample: Any) -> None:
    link = Link(latency=0.5)
    (shared,) = shared_boxes(da_motion, moving_sample, link, ["infrastructure"])
    start, end = shared.shifts
    distances = np.linalg.norm(end - start, axis=1)

    actor_ids = shared.true.actor_id
    is_parked = actor_ids[np.isin(actor_ids, shared.received.actor_id)] >= 20000
    np.testing.assert_allclose(distances[is_parked], 0, atol=1e-6)
    assert distances.max() > 1.0


def test_the_legend_reports_a_lost_message(da_motion: DeepAccident, moving_sample: Any) -> None:
    link = Link(packet_loss=1.0)
    figure = draw_link(da_motion, moving_sample, link, agents="+behind", layers=["boxes"])
    assert read_legend(figure)[0] == "ego behind: nothing arrived"
    assert collections_of_kind(figure.axes[0], Quiver) == []


def test_clouds_are_side_by_side(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 5)
    link = Link(latency=0.2)
    _, now, late = draw_link(da, sample, link, agents="+other", view_range=50.0).axes

    for ax, cloud_link in ((now, None), (late, link)):
        cloud = da.aggregate_point_cloud(
            sample, agents=["other_vehicle"], frame="ego", link=cloud_link
        )
        points = cloud.xyz[:, :2]
        visible_points = points[(np.abs(points) < 50).all(axis=1)]
        drawn_clouds = [np.asarray(shape.get_offsets()) for shape in ax.collections]
        assert len(ax.images) == 1  # the road
        assert any(
            drawn.shape == visible_points.shape and np.allclose(drawn, visible_points)
            for drawn in drawn_clouds
        )


@pytest.mark.parametrize(
    ("layers", "medium", "num_panels"),
    [(["boxes"], None, 1), (None, None, 3), (None, "slide", 2), (None, "cvpr-column", 1)],
)
def test_all_partners_are_in_one_panel(
    da: DeepAccident, layers: Any, medium: Any, num_panels: int
) -> None:
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 5)
    with style(medium):
        figure = draw_link(da, sample, NOISE, layers=layers)
    assert len(figure.axes) == num_panels
    names = {words.split(":")[0] for words in read_legend(figure)}
    assert not missing_parts(names, "ego behind", "other", "other behind", "infrastructure")


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
    assert not missing_parts(link_words(link), *facts)
