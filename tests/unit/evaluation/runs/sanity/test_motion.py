"""Maps and heads with a mistake are named as exactly that, noisy ones too; good and bad ones without one are not."""

import functools
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS, AccidentReading
from deepaccident_devkit.evaluation.metrics.motion import MOTION_PROTOCOLS, MotionEvaluator
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput, instances_of
from deepaccident_devkit.evaluation.metrics.warning import WARNING_PROTOCOLS
from deepaccident_devkit.evaluation.runs.sanity.facts import facts_of, ids_kept, path_warnings
from deepaccident_devkit.evaluation.runs.sanity.foregrounds import foreground_warnings, post_processing_of
from deepaccident_devkit.evaluation.runs.sanity.motion import motion_suspicions, motion_tallies
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, candidates_of
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels

pytestmark = pytest.mark.slow

Labels = dict[str, MotionLabels]
Change = Callable[[AnyArray], AnyArray]


@pytest.fixture(scope="module")
def few_labels(da_motion: DeepAccident) -> Labels:
    """Of five samples at the present, 2 s before the accident."""
    tokens = da_motion.samples("train", "evaluate")[::4]
    return {token: da_motion.motion_labels(token).to_present("bilinear") for token in tokens}


def scaled(maps: AnyArray, scale: float) -> AnyArray:
    """Maps (…, 200, 200) with all so many times as far from the middle; what leaves them is lost."""
    cell = np.floor((np.arange(200) - 99.5) / scale + 100).astype(int)
    there = (cell >= 0) & (cell < 200)
    inside = np.where(there, cell, 0)
    return np.where(there[:, None] & there, maps[..., inside[:, None], inside], 0)


MISTAKES: dict[str, Change] = {
    "mirrored x": lambda maps: maps[..., ::-1],
    "mirrored y": lambda maps: maps[..., ::-1, :],
    "transposed": lambda maps: maps.swapaxes(-1, -2),
    "anti-transposed": lambda maps: maps[..., ::-1, ::-1].swapaxes(-1, -2),
    "turned by 90°": lambda maps: np.rot90(maps, -1, axes=(-2, -1)),  # rows rise to the left, not down
    "turned by 180°": lambda maps: maps[..., ::-1, ::-1],
    "turned by 270°": lambda maps: np.rot90(maps, 1, axes=(-2, -1)),
    "one step late": lambda maps: np.concatenate([maps[:1], maps[:-1]]),
    "one step early": lambda maps: np.concatenate([maps[1:], maps[-1:]]),
    "two steps late": lambda maps: np.concatenate([maps[:1], maps[:1], maps[:-2]]),
    "frames reversed": lambda maps: maps[::-1],
    "actors and background swapped": lambda maps: np.where(maps > 0, 0, 1).astype(np.int32),
    **{name: lambda maps, scale=scale: scaled(maps, scale) for name, scale in SCALES.items()},
}


@functools.lru_cache(maxsize=64)
def rolled_out(label: MotionLabels, speed: float = 1.0) -> AnyArray:
    """(T, H, W) where everybody would be who goes on as from the first frame to the second, so many times as fast."""
    result = np.zeros_like(label.instance)
    for name in np.unique(label.instance[0][label.instance[0] > 0]):
        cells = np.argwhere(label.instance[0] == name)
        then = np.argwhere(label.instance[1] == name)
        step = then.mean(axis=0) - cells.mean(axis=0) if len(then) else np.zeros(2)
        for frame in range(len(result)):
            row, column = (cells + np.round(frame * speed * step).astype(int)).T
            inside = (row >= 0) & (row < result.shape[1]) & (column >= 0) & (column < result.shape[2])
            result[frame, row[inside], column[inside]] = name
    return result


def shifted(maps: AnyArray, rows: int, columns: int) -> AnyArray:
    """Maps (…, H, W) with all so many cells further; what leaves them is lost."""
    result = np.zeros_like(maps)
    height, width = maps.shape[-2:]
    there = tuple(slice(max(0, by), min(size, size + by)) for by, size in ((rows, height), (columns, width)))
    here = tuple(slice(max(0, -by), min(size, size - by)) for by, size in ((rows, height), (columns, width)))
    result[(..., *there)] = maps[(..., *here)]
    return result


def uncertain(
    maps: AnyArray, seed: int, cells: float = 2.0, missing: float = 0.2, false: float = 0.2, parts: int = 1
) -> AnyArray:
    """Each instance (T, H, W) some cells off, some missing or in parts, and false ones that stand between them."""
    source = np.random.default_rng([seed, int(maps.sum())])
    result, names = np.zeros_like(maps), np.unique(maps[maps > 0])
    part = np.arange(maps.shape[-1]) // 3 % parts
    for name in names:
        if source.uniform() >= missing:
            moved = shifted(maps == name, *np.round(source.normal(0, cells, 2)).astype(int))
            result[moved] = (name + 1000 * part * np.ones(maps.shape, dtype=int))[moved]
    for row, column in source.integers(0, 190, (int(np.ceil(false * len(names))), 2)):
        result[:, row : row + 4, column : column + 9] = 5000 + row
    return result


def noisy(maps: AnyArray, seed: int) -> AnyArray:
    """A tenth of the cells is lost, and as many of the others are taken for somebody."""
    source = np.random.default_rng(seed)
    lost = source.uniform(size=maps.shape) < 0.1
    extra = source.uniform(size=maps.shape) < 0.1 * (maps > 0).mean()
    return np.where(extra, 1, np.where(lost, 0, maps)).astype(np.int32)


GOOD: dict[str, Callable[[MotionLabels], AnyArray]] = {
    "perfect": lambda label: label.instance,
    "constant velocity": rolled_out,
    "noisy": lambda label: noisy(rolled_out(label), 0),
    "uncertain": lambda label: uncertain(label.instance, 1),
    "more uncertain": lambda label: uncertain(label.instance, 2, 3.0, 0.4, 0.5),
    "half missing": lambda label: uncertain(label.instance, 3, 0.0, 0.5, 0.0),
    "in parts": lambda label: uncertain(label.instance, 4, 0.5, 0.1, 0.1, parts=2),
    "false ones": lambda label: uncertain(label.instance, 5, 0.5, 0.0, 1.0),
}
SPEEDS = (0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.65, 0.7, 0.75, 0.8, 1.25, 1.5)
BAD: dict[str, Callable[[MotionLabels], AnyArray]] = {
    "empty": lambda label: np.zeros_like(label.instance),
    "nobody moves": lambda label: label.instance[:1].repeat(5, axis=0),
    "nobody moves, uncertain": lambda label: uncertain(label.instance[:1].repeat(5, axis=0), 6),
    "half as fast": lambda label: rolled_out(label)[[0, 0, 1, 1, 2]],
    "a quarter as fast": lambda label: rolled_out(label)[[0, 0, 1, 1, 1]],
    "a quarter as fast, rounded down": lambda label: rolled_out(label)[[0, 0, 0, 0, 1]],
    "slow at first": lambda label: rolled_out(label)[[0, 0, 1, 2, 2]],
    "half as fast, uncertain": lambda label: uncertain(rolled_out(label)[[0, 0, 1, 1, 2]], 7),
    **{f"{speed:g} times as fast": lambda label, speed=speed: rolled_out(label, speed) for speed in SPEEDS},
    "twice as fast": lambda label: rolled_out(label)[[0, 2, 4, 4, 4]],
    **{f"random {seed}": lambda label, seed=seed: noisy(np.zeros_like(label.instance) + 1, seed) for seed in (1, 2)},
    **{
        f"anywhere {seed}": lambda label, seed=seed: np.roll(
            label.instance, np.random.default_rng([seed, label.instance.sum()]).integers(20, 180, 2), axis=(1, 2)
        )
        for seed in (1, 2)
    },
}


def suspected(labels: Labels, predict: Callable[[MotionLabels], AnyArray]) -> list[str]:
    tallies = [motion_tallies(instances_of(predict(label), label.config.grid), label) for label in labels.values()]
    return [each.name for each in candidates_of(motion_suspicions("devkit", heads=False), tallies) if each.suspected]


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("prediction", ["perfect", "constant velocity", "uncertain"])
def test_each_mistake_is_named_as_exactly_that(crossing_labels: Labels, prediction: str, mistake: str) -> None:
    change, good = MISTAKES[mistake], GOOD[prediction]
    assert suspected(crossing_labels, lambda label: change(good(label))) == [mistake]


@pytest.mark.parametrize("prediction", ["perfect", "uncertain"])
def test_frames_that_were_not_warped_are_named(da_motion: DeepAccident, prediction: str) -> None:
    tallies = []
    for token in da_motion.samples("train", "evaluate")[:4]:
        label = da_motion.motion_labels(token)
        tallies.append(motion_tallies(instances_of(GOOD[prediction](label), label.config.grid), label))
    found = [each.name for each in candidates_of(motion_suspicions("devkit", heads=False), tallies) if each.suspected]
    assert found == ["frames not warped"]


def test_nobody_who_drives_along_is_taken_for_frames_that_were_not_warped(da_motion: DeepAccident) -> None:
    tallies = []
    for token in da_motion.samples("train", "evaluate")[:4]:
        label = da_motion.motion_labels(token)
        tallies.append(motion_tallies(instances_of(label.instance[:1].repeat(5, axis=0), label.config.grid), label))
    assert not any(each.suspected for each in candidates_of(motion_suspicions("devkit", heads=False), tallies))


@pytest.mark.parametrize("prediction", [*GOOD, *BAD])
def test_nothing_else_is_suspected(crossing_labels: Labels, prediction: str) -> None:
    assert suspected(crossing_labels, (GOOD | BAD)[prediction]) == []


def backward_flow(instance: AnyArray) -> AnyArray:
    """(T - 1, 2, H, W) from each instance's centre to its centre in the frame before, from the second frame on."""
    flow = np.zeros((len(instance) - 1, 2, *instance.shape[1:]), dtype=np.float32)
    for vectors, before, now in zip(flow, instance, instance[1:], strict=False):
        for name in np.intersect1d(before[before > 0], now[now > 0]):
            centers = [np.argwhere(maps == name).mean(axis=0) for maps in (before, now)]
            vectors[:, now == name] = (centers[0] - centers[1])[:, None]
    return flow


def test_a_flow_to_the_previous_frame_is_named(da_motion: DeepAccident) -> None:
    """Seen from the infrastructure, which stands still: labels of 0.5 s earlier begin with the previous frame."""
    tallies = []
    tokens = [
        token for token in da_motion.samples("train", "evaluate", "paper", scope="all") if "/infrastructure/" in token
    ]
    for token in tokens[::3]:
        recording, frame = token.rsplit("/", 1)
        earlier = da_motion.motion_labels(f"{recording}/{int(frame) - 5:03d}", MotionLabelConfig(future_frames=5))
        label = da_motion.motion_labels(token).to_present("bilinear")
        flow = backward_flow(earlier.to_present("bilinear").instance)
        heads = replace(MotionHeads.from_labels(label), ignore_index=None, flow=flow)
        tallies.append(motion_tallies(MotionOutput(grid=label.config.grid, heads=(heads,)), label))
    (found,) = (each for each in candidates_of(motion_suspicions("devkit", heads=True), tallies) if each.suspected)
    assert found.name == "flow: both channels negated"
    assert found.description.startswith("the flow leads to the instance's centre in the previous frame, or both its")


def channels(heads: MotionHeads, head: str, change: Change) -> MotionHeads:
    return replace(heads, **{head: change(getattr(heads, head))})


HEADS = ("segmentation", "centerness", "offset", "flow")
SIGNS = np.array([-1, 1])[:, None, None]
VECTORS: dict[str, Callable[[MotionHeads], MotionHeads]] = {
    "offset: its channels swapped": lambda heads: channels(heads, "offset", lambda maps: maps[:, ::-1]),
    "offset: both channels negated": lambda heads: channels(heads, "offset", lambda maps: -maps),
    "offset: channel 0 negated": lambda heads: channels(heads, "offset", lambda maps: maps * SIGNS),
    "flow: its channels swapped": lambda heads: channels(heads, "flow", lambda maps: maps[:, ::-1]),
    "flow: both channels negated": lambda heads: channels(heads, "flow", lambda maps: -maps),
    "flow: channel 1 negated": lambda heads: channels(heads, "flow", lambda maps: -maps * SIGNS),
    "flow: its channels swapped, then channel 0 negated": lambda heads: channels(
        heads, "flow", lambda maps: maps[:, ::-1] * SIGNS
    ),
    "offset and flow swapped": lambda heads: replace(heads, offset=heads.flow, flow=heads.offset),
    "actors and background swapped": lambda heads: channels(heads, "segmentation", lambda maps: maps[:, ::-1]),
    "two steps late": lambda heads: replace(
        heads,
        **{name: np.concatenate([getattr(heads, name)[:1]] * 2 + [getattr(heads, name)[:-2]]) for name in HEADS},
    ),
    "frames reversed": lambda heads: replace(heads, **{name: getattr(heads, name)[::-1] for name in HEADS}),
}


def rough(heads: MotionHeads) -> MotionHeads:
    """Vectors more than a cell off, a tenth of the cells on the wrong side."""
    source = np.random.default_rng(int(heads.segmentation.sum()))
    off = {name: getattr(heads, name) + source.normal(0, 1.2, heads.flow.shape) for name in ("offset", "flow")}
    wrong = source.uniform(size=heads.segmentation[:, :1].shape) < 0.1 * (heads.segmentation[:, 1:] > 0)
    return replace(heads, segmentation=np.where(wrong, heads.segmentation[:, ::-1], heads.segmentation), **off)


RIGHT_VECTORS: dict[str, Callable[[MotionHeads], MotionHeads]] = {
    "perfect": lambda heads: heads,
    "noisy": rough,
    "no flow": lambda heads: channels(rough(heads), "flow", lambda maps: 0 * maps),
    "no offset": lambda heads: channels(rough(heads), "offset", lambda maps: 0 * maps),
    "short": lambda heads: channels(channels(heads, "flow", lambda maps: maps / 2), "offset", lambda maps: 0.7 * maps),
    "a cell aside": lambda heads: channels(heads, "flow", lambda maps: maps + 1),
}


def suspected_heads(labels: Labels, change: Callable[[MotionHeads], MotionHeads]) -> list[str]:
    tallies = []
    for label in labels.values():
        heads = change(replace(MotionHeads.from_labels(label), ignore_index=None))
        tallies.append(motion_tallies(MotionOutput(grid=label.config.grid, heads=(heads,)), label))
    return [each.name for each in candidates_of(motion_suspicions("devkit", heads=True), tallies) if each.suspected]


@pytest.mark.parametrize("base", ["perfect", "noisy"])
@pytest.mark.parametrize("mistake", VECTORS)
def test_heads_with_a_mistake_are_named(few_labels: Labels, mistake: str, base: str) -> None:
    assert suspected_heads(few_labels, lambda heads: VECTORS[mistake](RIGHT_VECTORS[base](heads))) == [mistake]


@pytest.mark.parametrize("heads", RIGHT_VECTORS)
def test_other_heads_are_not_suspected(few_labels: Labels, heads: str) -> None:
    assert suspected_heads(few_labels, RIGHT_VECTORS[heads]) == []


def path_sentences(labels: Labels, predict: Callable[[MotionLabels], MotionOutput]) -> list[str]:
    given, perfect = MotionEvaluator(), MotionEvaluator()
    for token, label in labels.items():
        output = predict(label)
        given.update(token, output, label)
        truth = instances_of(label.instance, label.config.grid)
        heads = MotionOutput(grid=label.config.grid, heads=(MotionHeads.from_labels(label),))
        perfect.update(token, truth if output.heads is None else heads, label)
    return path_warnings(given.compute(), perfect.compute())


@pytest.mark.parametrize("prediction", [*GOOD, *BAD])
def test_paths_are_not_told_to_be_lost_where_few_are(crossing_labels: Labels, prediction: str) -> None:
    predict = (GOOD | BAD)[prediction]
    assert path_sentences(crossing_labels, lambda label: instances_of(predict(label), label.config.grid)) == []


def test_lost_paths_are_told(few_labels: Labels) -> None:
    def without_centers(label: MotionLabels) -> MotionOutput:
        heads = MotionHeads.from_labels(label)
        near = abs(np.arange(200) - 100) < 15
        heads = replace(heads, centerness=heads.centerness * near)
        return MotionOutput(grid=label.config.grid, heads=(heads,))

    (warning,) = path_sentences(few_labels, without_centers)
    matched, every, perfect = (int(number) for number in re.findall(r"\d+", warning))
    assert 0 < 2 * matched < perfect <= every
    assert warning == (
        f"only {matched} of {every} true paths have a match ({perfect} if the truth is predicted): minADE, minFDE and "
        "the miss rate are of these alone"
    )


def soft(heads: MotionHeads, turn: Callable[[AnyArray], AnyArray], spread: float = 1.0) -> MotionHeads:
    """Heads of an uncertain model; `turn` makes the two channels of the logit of an actor (T, H, W)."""
    source = np.random.default_rng(int(heads.segmentation.sum()))
    actor = heads.segmentation[:, 1] > heads.segmentation[:, 0]
    logit = np.where(actor, 3.0, -6.0) + source.normal(0, spread, actor.shape)
    return replace(heads, segmentation=turn(logit).astype(np.float32))


def both_sides(logit: AnyArray) -> AnyArray:
    return np.stack([-logit / 2, logit / 2], axis=1)


def probabilities(logit: AnyArray) -> AnyArray:
    actor = 1 / (1 + np.exp(-logit))
    return np.stack([1 - actor, actor], axis=1)


RIGHT_LOGITS: dict[str, Callable[[MotionHeads], MotionHeads]] = {
    **RIGHT_VECTORS,
    "logits": lambda heads: soft(heads, both_sides),
    "uncertain logits": lambda heads: soft(heads, both_sides, 2.0),
    "no actor": lambda heads: soft(heads, lambda logit: both_sides(-abs(logit) - 3)),
    "a single actor": lambda heads: channels(heads, "segmentation", lambda maps: maps * (np.arange(200) < 1) - 5),
}
WRONG_LOGITS: dict[str, Callable[[MotionHeads], MotionHeads]] = {
    "probabilities": lambda heads: soft(heads, probabilities),
    "actor's logit 0 in the background": lambda heads: soft(
        heads, lambda logit: np.stack([np.maximum(-logit, 0), np.maximum(logit, 0)], axis=1)
    ),
    "both low": lambda heads: soft(heads, lambda logit: both_sides(logit) - 6),
}


def foreground_sentences(
    labels: Labels, change: Callable[[MotionHeads], MotionHeads], rules: object = MOTION_PROTOCOLS["released"]
) -> list[str]:
    facts, settings = [], post_processing_of(rules)
    for label in labels.values():
        heads = change(replace(MotionHeads.from_labels(label), ignore_index=None))
        facts.append(facts_of(MotionOutput(grid=label.config.grid, heads=(heads,)), label, settings))
    return foreground_warnings(facts, settings)


@pytest.mark.parametrize("heads", RIGHT_LOGITS)
def test_logits_of_both_sides_are_read_alike(few_labels: Labels, heads: str) -> None:
    assert foreground_sentences(few_labels, RIGHT_LOGITS[heads]) == []


@pytest.mark.parametrize("heads", WRONG_LOGITS)
def test_heads_that_the_rule_of_accidents_reads_in_another_way_are_told(few_labels: Labels, heads: str) -> None:
    (warning,) = foreground_sentences(few_labels, WRONG_LOGITS[heads])
    by_rule, by_argmax = (float(share) for share in re.findall(r"([\d.]+) %", warning))
    assert by_argmax < 3
    assert by_rule == 0 if heads == "both low" else by_rule > 90
    assert "where sigmoid(actor's logit) is above 0.4, whatever the background's logit is. Write logits" in warning


def test_only_rules_that_take_sigmoid_read_heads_in_another_way(few_labels: Labels) -> None:
    def told(rules: object) -> bool:
        return bool(foreground_sentences(few_labels, WRONG_LOGITS["probabilities"], rules))

    by_sigmoid = AccidentReading(foreground="sigmoid")
    paper, boxes = PROTOCOLS["paper"], PROTOCOLS["boxes"]
    assert [told(rules) for rules in (PROTOCOLS["released"], *MOTION_PROTOCOLS.values())] == [True, True, True]
    assert [told(rules) for rules in (paper, boxes, WARNING_PROTOCOLS["clean"], None)] == [False] * 4
    assert [told(replace(rules, reading=by_sigmoid)) for rules in (paper, boxes)] == [True, True]
    paths = replace(MOTION_PROTOCOLS["released"].paths, foreground="argmax")
    assert not told(replace(MOTION_PROTOCOLS["released"], paths=paths))


def test_maps_longer_than_wide_cannot_be_turned_by_90_degrees(da_motion: DeepAccident) -> None:
    grid = BevGrid((-40.0, 40.0, 0.5), (-20.0, 20.0, 0.5), "fiery")
    label = da_motion.motion_labels(da_motion.samples("train", "evaluate")[0], MotionLabelConfig(grid=grid))
    at_present = label.to_present()
    tallies = [motion_tallies(instances_of(at_present.instance[:, :, ::-1], grid), label)]
    found = candidates_of(motion_suspicions("fiery", heads=False), tallies)
    assert [each.name for each in found if each.suspected] == ["mirrored y"]
    assert [each.name for each in found if each.score is None] == [
        "transposed",
        "anti-transposed",
        "turned by 90°",
        "turned by 270°",
    ]


def test_ids_are_counted_that_stay_from_frame_to_frame(few_labels: Labels) -> None:
    label = next(iter(few_labels.values()))
    kept, pairs = ids_kept(instances_of(label.instance, label.config.grid), label)
    assert kept == pairs > 10
    anew = label.instance + 100 * np.arange(5)[:, None, None] * (label.instance > 0)
    assert ids_kept(instances_of(anew, label.config.grid), label) == [0, pairs]
    heads = MotionOutput(grid=label.config.grid, heads=(MotionHeads.from_labels(label),))
    assert ids_kept(heads, label) == [0, 0]
