import math
import pickle
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, MissingFileError
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import Link, PoseNoise
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.messages import message_bytes, messages, traffic

BEHIND = AGENTS[1]


@pytest.fixture
def sample(da_b: DeepAccident) -> str:
    return f"{da_b.scenario[0]['token']}/ego_vehicle/004"


def test_a_latency_that_is_no_multiple_of_a_frame_names_the_two_nearest() -> None:
    assert [Link(latency=frames / 10).latency_frames for frames in range(12)] == list(range(12))
    assert Link(latency=0.1 + 0.2).latency_frames == 3
    assert_refused(
        (
            lambda: Link(latency=0.25),
            ConfigError,
            r"0\.25 s is no multiple of a frame \(0\.1 s\); the nearest are 0\.2 s and 0\.3",
        ),
        *[
            (partial(Link, latency=wrong), ConfigError, r"latency: .* is not possible")
            for wrong in (-0.1, math.nan, math.inf)
        ],
    )


def test_a_latency_longer_than_the_past_names_what_there_is(
    da_b: DeepAccident, sample: str
) -> None:
    assert len(da_b.cooperative_boxes(sample, link=Link(latency=0.3))) > 0
    assert_refused(
        *[
            (
                partial(call, sample, agents=["infrastructure"], link=Link(latency=0.5)),
                ConfigError,
                (
                    r"from frame 004; the longest possible is 0\.3 s; .* a frame that "
                    r"has 5 others before it"
                ),
            )
            for call in (
                da_b.cooperative_boxes,
                da_b.visible_instances,
                da_b.aggregate_point_cloud,
                da_b.message_sizes,
            )
        ],
    )


def test_settings_that_are_not_possible() -> None:
    assert_refused(
        (lambda: Link(packet_loss=2), ConfigError, "packet_loss: 2 is no probability"),
        (lambda: PoseNoise(std=-1), ConfigError, "std is -1; choose a finite number"),
    )
    with pytest.raises(
        ConfigError, match="pose_noise: expected metres or a PoseNoise, found 'much'"
    ):
        Link(pose_noise="much")  # type: ignore[arg-type]
    assert Link(pose_noise=0.3) == Link(pose_noise=PoseNoise(mean=0.3, std=0.02, heading_std=0))
    assert pickle.loads(pickle.dumps(Link(pose_noise=0.3))) == Link(pose_noise=0.3)


def test_a_draw_depends_on_seed_scenario_partner_and_frame_alone(
    da_b: DeepAccident, sample: str
) -> None:
    link = Link(pose_noise=0.3, packet_loss=0.4, seed=7)

    def errors(agents: list[str] | None, link: Link) -> dict[str, bytes]:
        received = messages(da_b, sample, agents, link)
        return {
            message.agent: message.pose_error.matrix.tobytes()
            for message in received
            if message.pose_error
        }

    together = errors(None, Link(pose_noise=0.3, seed=7))
    assert len(set(together.values())) == len(AGENTS) - 1
    for agent in AGENTS[:0:-1]:
        assert errors([agent], link) in ({}, {agent: together[agent]})
    assert not set(errors(None, Link(pose_noise=0.3, seed=8)).values()) & set(together.values())


def test_the_egos_own_data_are_never_disturbed(da_b: DeepAccident, sample: str) -> None:
    link = Link(latency=0.2, pose_noise=0.5, packet_loss=1)
    alone, through = (
        da_b.cooperative_boxes(sample, agents="single", link=way) for way in (None, link)
    )
    everyone = da_b.cooperative_boxes(sample, link=link)
    for got in (through, everyone):
        assert_array_equal(got.center, alone.center)
        assert_array_equal(got.actor_id, alone.actor_id)
    nobody = da_b.cooperative_boxes(sample, agents=["infrastructure"], link=link)
    assert (len(nobody), nobody.frame) == (0, "world")
    assert da_b.visible_instances(sample, agents=["infrastructure"], link=link) == []


def test_pose_noise_moves_all_of_a_partners_boxes_by_the_same_distance(
    da_b: DeepAccident, sample: str
) -> None:
    pole = ["infrastructure"]
    true, noisy = (
        da_b.cooperative_boxes(sample, agents=pole, link=link)
        for link in (None, Link(pose_noise=0.4))
    )
    off = noisy.center - true.center
    assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-9)
    assert (off[0, 2], np.hypot(*off[0, :2])) == (
        pytest.approx(0, abs=1e-9),
        pytest.approx(0.4, abs=0.1),
    )


def test_a_wrong_heading_turns_about_the_partner(da_b: DeepAccident, sample: str) -> None:
    link = Link(pose_noise=PoseNoise(std=0, heading_std=0.1))
    pole = da_b.world_from(sample.replace("ego_vehicle", "infrastructure"), "ego").translation
    true, noisy = (
        da_b.cooperative_boxes(sample, agents=["infrastructure"], link=way) for way in (None, link)
    )
    assert_allclose(
        *[np.linalg.norm(boxes.center - pole, axis=1) for boxes in (true, noisy)], atol=1e-9
    )
    turned = np.angle(np.exp(1j * (noisy.yaw - true.yaw)))
    assert_allclose(turned, turned[0], atol=1e-6)
    assert abs(turned[0]) > 1e-3


def test_latency_shows_what_the_partner_saw_then(da_b: DeepAccident, sample: str) -> None:
    pole = ["infrastructure"]
    late = da_b.cooperative_boxes(sample, agents=pole, link=Link(latency=0.2))
    then = da_b.cooperative_boxes(sample.replace("/004", "/002"), agents=pole)
    assert_array_equal(late.center, then.center)
    assert_array_equal(late.actor_id, then.actor_id)


def test_a_sweep_arrives_as_it_did_when_it_was_the_present(da_b: DeepAccident, sample: str) -> None:
    """Of four sweeps each is what its own frame received, as far as the latency lets anything
    arrive there.
    """
    link, agents = Link(latency=0.1, pose_noise=0.3, packet_loss=0.4, seed=5), list(AGENTS[1:])

    def facts(token: str, sweeps: int) -> list[tuple[str, str, bytes]]:
        return [
            (message.agent, message.sample, message.pose_error.matrix.tobytes())
            for message in messages(da_b, token, agents, link, sweeps=sweeps)
        ]

    tokens = [sample.replace("/004", f"/{index:03d}") for index in (4, 3, 2)]
    assert facts(sample, 4) == [fact for token in tokens for fact in facts(token, 1)]


@pytest.mark.parametrize("wrong", ["0.2", None, [0.2], (0.1, 0.02), 1j])
def test_what_is_no_number_is_refused(wrong: object) -> None:
    assert_refused(
        *[
            (partial(Link, **{name: wrong}), ConfigError, f"{name}: expected .*, found")
            for name in ("latency", "packet_loss")
        ],
        *[
            (
                partial(PoseNoise, **{name: wrong}),
                ConfigError,
                f"pose noise: {name}: expected a number from 0, found",
            )
            for name in ("mean", "std", "heading_std")
        ],
    )
    if wrong is not None:
        assert_refused(
            (
                lambda: Link(pose_noise=wrong),
                ConfigError,
                "pose_noise: expected metres or a PoseNoise, found",
            ),
        )


def test_seeds_are_whole_numbers() -> None:
    assert_refused(
        *[
            (partial(Link, seed=wrong), ConfigError, "seed: expected a whole number, found")
            for wrong in (1.5, "a", None, 1.0)
        ],
    )
    assert Link(seed=-1) != Link(seed=1)


def test_equal_links_draw_alike_whatever_their_numbers_types() -> None:
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
        assert (type(link.latency), type(link.packet_loss), type(link.seed)) == (float, float, int)
        assert type(link.pose_noise.mean) is float
        assert (
            len(
                {
                    link.pose_error("scenario", "agent", 4, np.zeros(3)).matrix.tobytes()
                    for link in links
                }
            )
            == 1
        )
    assert (
        Link(pose_noise=np.int64(1))
        == Link(pose_noise=1.0)
        == Link(pose_noise=PoseNoise(mean=np.uint8(1)))
    )


@pytest.mark.parametrize("wrong", [{"latency": 0.2}, "a", 0.2, Link])
def test_what_is_no_link_is_refused_by_every_call(
    da_b: DeepAccident, sample: str, wrong: object
) -> None:
    calls = (
        da_b.cooperative_boxes,
        da_b.visible_instances,
        da_b.aggregate_point_cloud,
        da_b.message_sizes,
    )
    assert_refused(
        *[
            (
                partial(call, sample, link=wrong),
                ConfigError,
                r"link: expected a Link, such as Link\(latency=0\.2, .* found",
            )
            for call in calls
        ],
    )


def test_likely_mistakes_of_units_are_named() -> None:
    assert_refused(
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
    assert_refused(
        (
            lambda: Link(packet_loss=-0.01),
            ConfigError,
            "packet_loss: -0.01 is no probability; choose a number from 0",
        ),
        (lambda: Link(packet_loss=1.01), ConfigError, "packet_loss: 1.01 is no probability"),
        (
            lambda: Link(latency=0.1 + 1.1e-7),
            ConfigError,
            r"is no multiple of a frame .* nearest are 0\.1 s and 0\.2 s",
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
    assert_refused(
        (
            lambda: Link(latency=0.3).frame_sent("scenario", 3),
            ConfigError,
            (
                r"of scenario from frame 003; the longest possible is 0\.2 s; .* "
                r"has 3 others before it"
            ),
        ),
    )


def box_bytes(da: DeepAccident, sample: str) -> dict[str, int]:
    """Partner → bytes of its boxes, in their order."""
    sizes = da.message_sizes(sample, clouds=False)
    return {agent: each.boxes for agent, each in sizes.items() if agent != sample.split("/")[2]}


def senders(
    da: DeepAccident, sample: str, link: Link, agents: object = "all", sweeps: int = 1
) -> list[str]:
    return [message.agent for message in messages(da, sample, agents, link, sweeps=sweeps)]  # type: ignore[arg-type]


def test_within_a_budget_each_partner_sends_that_still_fits(
    da_b: DeepAccident, sample: str
) -> None:
    sizes = box_bytes(da_b, sample)
    total = sum(sizes.values())
    for budget in (1, min(sizes.values()) - 1, *sizes.values(), total - 1, total):
        expected, left = ["ego_vehicle"], budget
        for agent, size in sizes.items():
            if size <= left:
                expected.append(agent)
                left -= size
        link = Link(budget=budget, payload="boxes")
        assert senders(da_b, sample, link) == expected
        assert list(da_b.message_sizes(sample, link=link, clouds=False)) == expected
        assert traffic(da_b, sample, "all", link, "boxes") == (budget - left, len(expected) - 1)
    assert senders(da_b, sample, link) == ["ego_vehicle", *sizes]


def test_a_message_that_does_not_fit_does_not_keep_a_smaller_one_out(
    da_b: DeepAccident, sample: str
) -> None:
    sizes = box_bytes(da_b, sample)
    large, small = max(sizes, key=sizes.__getitem__), min(sizes, key=sizes.__getitem__)
    assert sizes[small] < sizes[large]
    assert senders(da_b, sample, Link(budget=sizes[small], payload="boxes"), [large, small]) == [
        small
    ]


def test_a_budget_is_of_each_frame_and_of_what_arrives(da_b: DeepAccident, sample: str) -> None:
    one = {"budget": 1500, "payload": 1000}
    assert senders(da_b, sample, Link(**one), sweeps=2) == ["ego_vehicle", "ego_vehicle_behind"] * 2
    seeds = [
        each
        for each in range(20)
        if Link(packet_loss=0.5, seed=each).loses(da_b.scenario[0]["token"], BEHIND, 4)
    ]
    assert seeds
    for seed in seeds:
        arriving = senders(da_b, sample, Link(packet_loss=0.5, seed=seed))
        assert senders(da_b, sample, Link(packet_loss=0.5, seed=seed, **one)) == arriving[:2]


def test_whoever_does_not_fit_is_not_heard(da_b: DeepAccident, sample: str) -> None:
    alone, limited, everyone = (
        seen_actors(da_b, sample, agents=agents, link=link)
        for agents, link in (
            ("single", None),
            ("all", Link(budget=1, payload="bev")),
            ("all", None),
        )
    )
    assert_array_equal(limited.boxes.actor_id, alone.boxes.actor_id)
    assert len(everyone.boxes) > len(alone.boxes)


def test_bytes_of_a_message_are_those_of_its_sizes(da: DeepAccident, da_b: DeepAccident) -> None:
    token = da.get_sample(da.scenario[0], "infrastructure", 3)["token"]
    sizes = asdict(da.message_sizes(token, agents="single")["infrastructure"])
    assert {kind: message_bytes(da, token, kind) for kind in sizes} == sizes  # type: ignore[arg-type]
    assert [message_bytes(da, token, given) for given in (70, None)] == [70, 0]
    blind = f"{da_b.scenario[0]['token']}/infrastructure/003"
    assert_refused((lambda: message_bytes(da_b, blind, "cloud"), MissingFileError, "lidar01"))
    assert message_bytes(da_b, blind, "boxes") == 24 + 45 * len(da_b.boxes(blind))


def test_traffic_is_that_of_partners_after_latency_and_loss(
    da_b: DeepAccident, sample: str
) -> None:
    sizes, early = box_bytes(da_b, sample), box_bytes(da_b, sample.replace("/004", "/002"))
    assert traffic(da_b, sample, "all", None, "boxes") == (sum(sizes.values()), 4)
    assert traffic(da_b, sample, "all", Link(latency=0.2, pose_noise=0.3), "boxes") == (
        sum(early.values()),
        4,
    )
    assert traffic(da_b, sample, "all", Link(packet_loss=1), "boxes") == (0, 0)
    assert traffic(da_b, sample, "single", None, "boxes") == (0, 0)
    assert traffic(da_b, sample, ["infrastructure"], None, 70) == (70, 1)


def test_budgets_that_are_none() -> None:
    bytes_ = r"expected a whole number from 1 to 1,125,899,906,842,624 \(bytes"
    assert_refused(
        *[
            (
                partial(Link, budget=wrong, payload="boxes"),
                ConfigError,
                f"budget: {bytes_} a frame\\), found",
            )
            for wrong in (0, -1, 1.5, "many", True, 2**50 + 1)
        ],
        *[
            (
                partial(Link, payload=wrong),
                ConfigError,
                f"payload: {bytes_} of every message\\), found",
            )
            for wrong in (0, 2.5, ["boxes"])
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
