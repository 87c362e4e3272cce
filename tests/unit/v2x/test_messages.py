import math
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, MissingFileError
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import Link, PoseNoise
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.messages import message_bytes, messages, traffic

EGO_BEHIND = AGENTS[1]


@pytest.fixture
def sample(da_b: DeepAccident) -> str:
    return f"{da_b.scenario[0]['token']}/ego_vehicle/004"


def calls_with_links(da: DeepAccident) -> tuple[Callable[..., object], ...]:
    return (
        da.cooperative_boxes,
        da.visible_instances,
        da.aggregate_point_cloud,
        da.message_sizes,
    )


def test_a_latency_that_is_no_multiple_of_a_frame_names_the_two_nearest() -> None:
    assert [Link(latency=frames / 10).latency_frames for frames in range(12)] == list(range(12))
    assert Link(latency=0.1 + 0.2).latency_frames == 3
    assert_raises(
        (
            lambda: Link(latency=0.25),
            ConfigError,
            r"0\.25 s is not a multiple of a frame \(0\.1 s\); the nearest are 0\.2 s and 0\.3",
        ),
        *[
            (partial(Link, latency=latency), ConfigError, r"latency: .* is not possible")
            for latency in (-0.1, math.nan, math.inf)
        ],
    )


def test_a_latency_longer_than_the_past_names_the_longest_possible(
    da_b: DeepAccident, sample: str
) -> None:
    options = {"agents": ["infrastructure"], "link": Link(latency=0.5)}
    message = r"from frame 004 .*longest possible latency is 0\.3 s; .* frame 006 or a later"

    assert len(da_b.cooperative_boxes(sample, link=Link(latency=0.3))) > 0
    assert_raises(
        *[
            (partial(call, sample, **options), ConfigError, message)
            for call in calls_with_links(da_b)
        ]
    )


def test_link_settings_that_are_not_possible() -> None:
    assert_raises(
        (lambda: Link(packet_loss=2), ConfigError, "packet_loss: 2 is not a probability"),
        (lambda: PoseNoise(std=-1), ConfigError, "std is -1; choose a finite number"),
    )
    message = "pose_noise: expected metres or a PoseNoise, found 'much'"
    with pytest.raises(ConfigError, match=message):
        Link(pose_noise="much")  # type: ignore[arg-type]
    assert Link(pose_noise=0.3) == Link(pose_noise=PoseNoise(mean=0.3, std=0.02, heading_std=0))
    assert pickle.loads(pickle.dumps(Link(pose_noise=0.3))) == Link(pose_noise=0.3)


def test_a_draw_depends_only_on_seed_scenario_partner_and_frame(
    da_b: DeepAccident, sample: str
) -> None:
    def read_pose_errors(agents: list[str] | None, link: Link) -> dict[str, bytes]:
        received = [
            message for message in messages(da_b, sample, agents, link) if message.pose_error
        ]
        return {message.agent: message.pose_error.matrix.tobytes() for message in received}

    all_errors = read_pose_errors(None, Link(pose_noise=0.3, seed=7))
    assert len(set(all_errors.values())) == len(AGENTS) - 1
    lossy_link = Link(pose_noise=0.3, packet_loss=0.4, seed=7)
    for agent in AGENTS[:0:-1]:
        assert read_pose_errors([agent], lossy_link) in ({}, {agent: all_errors[agent]})

    other_errors = read_pose_errors(None, Link(pose_noise=0.3, seed=8))
    assert not set(other_errors.values()) & set(all_errors.values())


def test_the_egos_own_data_are_never_disturbed(da_b: DeepAccident, sample: str) -> None:
    link = Link(latency=0.2, pose_noise=0.5, packet_loss=1)
    undisturbed = da_b.cooperative_boxes(sample, agents="single", link=None)
    own_boxes = da_b.cooperative_boxes(sample, agents="single", link=link)
    for boxes in (own_boxes, da_b.cooperative_boxes(sample, link=link)):
        assert_array_equal(boxes.center, undisturbed.center)
        assert_array_equal(boxes.actor_id, undisturbed.actor_id)

    lost_boxes = da_b.cooperative_boxes(sample, agents=["infrastructure"], link=link)
    assert (len(lost_boxes), lost_boxes.frame) == (0, "world")
    assert da_b.visible_instances(sample, agents=["infrastructure"], link=link) == []


def test_pose_noise_moves_all_of_a_partners_boxes_by_the_same_distance(
    da_b: DeepAccident, sample: str
) -> None:
    pole = ["infrastructure"]
    boxes = da_b.cooperative_boxes(sample, agents=pole)
    noisy_boxes = da_b.cooperative_boxes(sample, agents=pole, link=Link(pose_noise=0.4))
    shift = noisy_boxes.center - boxes.center

    assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=1e-9)
    assert shift[0, 2] == pytest.approx(0, abs=1e-9)
    assert np.hypot(*shift[0, :2]) == pytest.approx(0.4, abs=0.1)


def test_a_wrong_heading_turns_about_the_partner(da_b: DeepAccident, sample: str) -> None:
    pole = da_b.world_from(sample.replace("ego_vehicle", "infrastructure"), "ego").translation
    link = Link(pose_noise=PoseNoise(std=0, heading_std=0.1))
    boxes = da_b.cooperative_boxes(sample, agents=["infrastructure"])
    turned_boxes = da_b.cooperative_boxes(sample, agents=["infrastructure"], link=link)

    distances = np.linalg.norm(boxes.center - pole, axis=1)
    turned_distances = np.linalg.norm(turned_boxes.center - pole, axis=1)
    assert_allclose(distances, turned_distances, atol=1e-9)
    turns = np.angle(np.exp(1j * (turned_boxes.yaw - boxes.yaw)))
    assert_allclose(turns, turns[0], atol=1e-6)
    assert abs(turns[0]) > 1e-3


def test_a_late_partner_sends_its_earlier_boxes(da_b: DeepAccident, sample: str) -> None:
    pole = ["infrastructure"]
    late_boxes = da_b.cooperative_boxes(sample, agents=pole, link=Link(latency=0.2))
    earlier_boxes = da_b.cooperative_boxes(sample.replace("/004", "/002"), agents=pole)
    assert_array_equal(late_boxes.center, earlier_boxes.center)
    assert_array_equal(late_boxes.actor_id, earlier_boxes.actor_id)


def test_a_sweep_arrives_as_it_did_when_it_was_the_present(da_b: DeepAccident, sample: str) -> None:
    """Each of four sweeps is what its own frame received, as far as the latency lets anything
    arrive there.
    """
    link = Link(latency=0.1, pose_noise=0.3, packet_loss=0.4, seed=5)

    def read_messages(token: str, sweeps: int) -> list[tuple[str, str, bytes]]:
        return [
            (message.agent, message.sample, message.pose_error.matrix.tobytes())
            for message in messages(da_b, token, list(AGENTS[1:]), link, sweeps=sweeps)
        ]

    expected = []
    for frame in ("004", "003", "002"):
        expected += read_messages(sample.replace("004", frame), 1)
    assert read_messages(sample, 4) == expected


@pytest.mark.parametrize("value", ["0.2", None, [0.2], (0.1, 0.02), 1j])
def test_a_value_that_is_no_number_is_refused(value: object) -> None:
    assert_raises(
        *[
            (partial(Link, **{name: value}), ConfigError, f"{name}: expected .*, found")
            for name in ("latency", "packet_loss")
        ],
        *[
            (
                partial(PoseNoise, **{name: value}),
                ConfigError,
                f"pose noise: {name}: expected a number from 0, found",
            )
            for name in ("mean", "std", "heading_std")
        ],
    )
    if value is not None:
        assert_raises(
            (
                lambda: Link(pose_noise=value),
                ConfigError,
                "pose_noise: expected metres or a PoseNoise, found",
            ),
        )


def test_seeds_are_whole_numbers() -> None:
    assert_raises(
        *[
            (partial(Link, seed=seed), ConfigError, "seed: expected a whole number, found")
            for seed in (1.5, "a", None, 1.0)
        ],
    )
    assert Link(seed=-1) != Link(seed=1)


def test_equal_links_draw_alike_whatever_the_types_of_their_numbers() -> None:
    links = [
        Link(latency=0.3, pose_noise=0.5, packet_loss=0.5, seed=1),
        Link(
            latency=0.1 + 0.2,
            pose_noise=np.float32(0.5),
            packet_loss=np.float16(0.5),
            seed=np.int64(1),
        ),
        Link(
            latency=np.float32(0.3),
            pose_noise=np.array(0.5),
            packet_loss=np.float64(0.5),
            seed=True,
        ),
    ]
    assert len(set(links)) == 1
    for link in links:
        assert type(link.latency) is float
        assert type(link.packet_loss) is float
        assert type(link.seed) is int
        assert type(link.pose_noise.mean) is float

    pose_errors = [link.pose_error("scenario", "agent", 4, np.zeros(3)) for link in links]
    assert len({pose_error.matrix.tobytes() for pose_error in pose_errors}) == 1
    one_metre = Link(pose_noise=1.0)
    assert Link(pose_noise=np.int64(1)) == one_metre
    assert Link(pose_noise=PoseNoise(mean=np.uint8(1))) == one_metre


@pytest.mark.parametrize("link", [{"latency": 0.2}, "a", 0.2, Link])
def test_every_call_refuses_a_link_that_is_none(
    da_b: DeepAccident, sample: str, link: object
) -> None:
    assert_raises(
        *[
            (
                partial(call, sample, link=link),
                ConfigError,
                r"link: expected a Link, such as Link\(latency=0\.2, .* found",
            )
            for call in calls_with_links(da_b)
        ],
    )


def test_likely_mistakes_of_units_are_named() -> None:
    assert_raises(
        (
            lambda: Link(latency=200),
            ConfigError,
            r"latency: 200 s is longer than any scenario; if .* milliseconds, give 0\.2",
        ),
        (
            lambda: PoseNoise(heading_std=5.0),
            ConfigError,
            r"heading_std is 5 radians, .*; if these are degrees, give 0\.08727",
        ),
    )
    assert Link(latency=20).latency_frames == 200


def test_the_ends_of_each_range() -> None:
    assert [Link(packet_loss=loss).packet_loss for loss in (0, 1)] == [0, 1]
    assert Link(latency=0.1 + 0.9e-7).latency == Link(latency=0.1 - 0.9e-7).latency == 0.1
    assert PoseNoise(mean=0, std=0, heading_std=math.pi).heading_std == math.pi
    assert_raises(
        (
            lambda: Link(packet_loss=-0.01),
            ConfigError,
            "packet_loss: -0.01 is not a probability; choose a number from 0",
        ),
        (lambda: Link(packet_loss=1.01), ConfigError, "packet_loss: 1.01 is not a probability"),
        (
            lambda: Link(latency=0.1 + 1.1e-7),
            ConfigError,
            r"is not a multiple of a frame .* nearest are 0\.1 s and 0\.2 s",
        ),
        (
            lambda: Link(latency=20.1),
            ConfigError,
            r"20\.1 s is longer than any scenario; .* give 0\.0201",
        ),
        (
            lambda: PoseNoise(heading_std=3.15),
            ConfigError,
            r"heading_std is 3\.15 radians, .*; .* give 0\.05498",
        ),
        (
            lambda: PoseNoise(mean=math.inf),
            ConfigError,
            "mean is inf; choose a finite number of at least 0",
        ),
    )
    assert Link(latency=0.3).frame_sent("scenario", 4) == 1
    assert_raises(
        (
            lambda: Link(latency=0.3).frame_sent("scenario", 3),
            ConfigError,
            (
                r"from frame 003 .* of scenario; the longest possible latency is 0\.2 s; .* "
                r"frame 004 or a later one"
            ),
        ),
    )


def read_box_bytes(da: DeepAccident, sample: str) -> dict[str, int]:
    """Return the bytes of each partner's boxes, in the order of the partners."""
    sizes = da.message_sizes(sample, clouds=False)
    del sizes[sample.split("/")[2]]
    return {agent: size.boxes for agent, size in sizes.items()}


def list_senders(
    da: DeepAccident, sample: str, link: Link, agents: object = "all", sweeps: int = 1
) -> list[str]:
    received = messages(da, sample, agents, link, sweeps=sweeps)  # type: ignore[arg-type]
    return [message.agent for message in received]


def test_within_a_budget_each_partner_sends_that_still_fits(
    da_b: DeepAccident, sample: str
) -> None:
    sizes = read_box_bytes(da_b, sample)
    total = sum(sizes.values())
    for budget in (1, min(sizes.values()) - 1, *sizes.values(), total - 1, total):
        expected = ["ego_vehicle"]
        bytes_left = budget
        for agent, size in sizes.items():
            if size <= bytes_left:
                expected.append(agent)
                bytes_left -= size
        expected_traffic = (budget - bytes_left, len(expected) - 1)

        link = Link(budget=budget, payload="boxes")
        assert list_senders(da_b, sample, link) == expected
        assert list(da_b.message_sizes(sample, link=link, clouds=False)) == expected
        assert traffic(da_b, sample, "all", link, "boxes") == expected_traffic
    assert list_senders(da_b, sample, link) == ["ego_vehicle", *sizes]


def test_a_message_that_does_not_fit_does_not_keep_a_smaller_one_out(
    da_b: DeepAccident, sample: str
) -> None:
    sizes = read_box_bytes(da_b, sample)
    large_agent = max(sizes, key=sizes.__getitem__)
    small_agent = min(sizes, key=sizes.__getitem__)
    link = Link(budget=sizes[small_agent], payload="boxes")
    assert sizes[small_agent] < sizes[large_agent]
    assert list_senders(da_b, sample, link, [large_agent, small_agent]) == [small_agent]


def test_a_budget_applies_to_each_frame_and_to_arriving_messages(
    da_b: DeepAccident, sample: str
) -> None:
    one_partner = {"budget": 1500, "payload": 1000}
    senders = list_senders(da_b, sample, Link(**one_partner), sweeps=2)
    assert senders == ["ego_vehicle", "ego_vehicle_behind"] * 2

    scenario = da_b.scenario[0]["token"]
    links = [Link(packet_loss=0.5, seed=seed) for seed in range(20)]
    losing_links = [link for link in links if link.loses(scenario, EGO_BEHIND, 4)]
    assert losing_links
    for link in losing_links:
        limited_link = replace(link, **one_partner)
        assert list_senders(da_b, sample, limited_link) == list_senders(da_b, sample, link)[:2]


def test_a_partner_that_does_not_fit_is_not_heard(da_b: DeepAccident, sample: str) -> None:
    link = Link(budget=1, payload="bev")
    own_actors = seen_actors(da_b, sample, agents="single")
    limited_actors = seen_actors(da_b, sample, agents="all", link=link)
    all_actors = seen_actors(da_b, sample, agents="all")
    assert_array_equal(limited_actors.boxes.actor_id, own_actors.boxes.actor_id)
    assert len(all_actors.boxes) > len(own_actors.boxes)


def test_bytes_of_a_message_agree_with_its_sizes(da: DeepAccident, da_b: DeepAccident) -> None:
    token = da.get_sample(da.scenario[0], "infrastructure", 3)["token"]
    sizes = asdict(da.message_sizes(token, agents="single")["infrastructure"])
    assert sizes
    for kind, num_bytes in sizes.items():
        assert message_bytes(da, token, kind) == num_bytes, kind  # type: ignore[arg-type]
    assert message_bytes(da, token, 70) == 70
    assert message_bytes(da, token, None) == 0

    blind_sample = f"{da_b.scenario[0]['token']}/infrastructure/003"
    assert_raises((lambda: message_bytes(da_b, blind_sample, "cloud"), MissingFileError, "lidar01"))
    assert message_bytes(da_b, blind_sample, "boxes") == 24 + 45 * len(da_b.boxes(blind_sample))


def test_traffic_is_that_of_partners_after_latency_and_loss(
    da_b: DeepAccident, sample: str
) -> None:
    num_bytes = sum(read_box_bytes(da_b, sample).values())
    earlier_bytes = sum(read_box_bytes(da_b, sample.replace("/004", "/002")).values())
    late_link = Link(latency=0.2, pose_noise=0.3)

    assert traffic(da_b, sample, "all", None, "boxes") == (num_bytes, 4)
    assert traffic(da_b, sample, "all", late_link, "boxes") == (earlier_bytes, 4)
    assert traffic(da_b, sample, "all", Link(packet_loss=1), "boxes") == (0, 0)
    assert traffic(da_b, sample, "single", None, "boxes") == (0, 0)
    assert traffic(da_b, sample, ["infrastructure"], None, 70) == (70, 1)


def test_budgets_and_payloads_that_are_refused() -> None:
    expected = r"expected a whole number from 1 to 1,125,899,906,842,624 \(bytes"
    assert_raises(
        *[
            (
                partial(Link, budget=budget, payload="boxes"),
                ConfigError,
                f"budget: {expected} per frame\\), found",
            )
            for budget in (0, -1, 1.5, "many", True, 2**50 + 1)
        ],
        *[
            (
                partial(Link, payload=payload),
                ConfigError,
                f"payload: {expected} of every message\\), found",
            )
            for payload in (0, 2.5, ["boxes"])
        ],
        (
            lambda: Link(payload="pictures"),
            ChoiceError,
            "payload: expected one of images, cloud, boxes, bev, or None",
        ),
        (
            lambda: Link(budget=9),
            ConfigError,
            "budget: needs the kind of data .* give payload='boxes' or another of",
        ),
    )
    assert Link(budget=np.int64(2**50), payload=np.int64(1)) == Link(budget=2**50, payload=1)
    assert Link(payload="bev").payload == "bev"
