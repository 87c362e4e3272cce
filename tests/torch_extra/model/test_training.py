"""Training: schedules, steps, runs that are killed and go on, several processes, and what is
refused.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused
from safetensors.torch import load_file
from torch_extra.model import small_model
from torch_extra.model.small_model import (
    RUN,
    small,
    small_both,
    small_lidar,
    small_released,
    trained,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    DeepAccidentError,
    NotAvailableError,
)
from deepaccident_devkit.plugins.model import training_loop as training
from deepaccident_devkit.plugins.model.checkpoint import (
    BEST_FILE,
    FINAL_FILE,
    STATE_FILE,
    read_weights,
    write_weights,
)
from deepaccident_devkit.plugins.model.inputs import ModelInputs, model_inputs
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.training_run import (
    TrainConfig,
    add_to_log,
    checked_device,
    cut_log,
    load_state,
    processes,
    read_log,
)
from deepaccident_devkit.plugins.model.training_step import (
    MixedMoments,
    Moments,
    TrainingStep,
    batches,
    generator_of,
    learning_rate,
    optimizer_of,
    positions,
    training_batch,
    with_dropped_partners,
)
from deepaccident_devkit.training.torch import AllEgosDataset, collate_all_egos

SHORT = replace(RUN, steps=2, validation=None, save_every=1)
TESTS = Path(__file__).parents[2]


def tensors(folder: Path, name: str = STATE_FILE) -> dict[str, torch.Tensor]:
    return load_file(folder / name)


def other_process(*words: str) -> subprocess.CompletedProcess[bytes]:
    """Python with these words, on one thread."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path]),
        "OMP_NUM_THREADS": "1",
    }
    return subprocess.run(
        [sys.executable, *words], env=environment, check=False, capture_output=True, timeout=600
    )


def assert_equal(found: Any, expected: Any) -> None:
    """Tensors, and what stands in lists and dicts of them, are the same bits."""
    torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)


def learned(da: DeepAccident, tokens: list[str], config: ModelConfig) -> dict[str, Any]:
    """The batch of moments with the targets of these egos."""
    given = config.inputs("all", boxes="sample", labels=config.labels)
    return collate_all_egos(list(AllEgosDataset(da, tokens, given)))


def rows(folder: Path) -> list[dict[str, Any]]:
    """The log without what depends on the machine's speed."""
    return [
        {name: each for name, each in row.items() if name not in ("seconds", "waiting")}
        for row in read_log(folder)
    ]


# --- the schedule


@given(st.integers(1, 400), st.floats(0, 1))
def test_the_rate_rises_and_falls_to_nothing(steps: int, warm_up: float) -> None:
    config = TrainConfig(steps=steps, warm_up=warm_up, learning_rate=0.5)
    rates = [learning_rate(step, config) for step in range(steps + 1)]
    rising = round(warm_up * steps)
    falling = (1 + np.cos(np.linspace(0, np.pi, steps - rising + 1))) / 2
    expected = np.concatenate([np.arange(1, rising + 1) / max(rising, 1), falling]) * 0.5
    np.testing.assert_allclose(rates, expected, atol=1e-12)
    assert min(rates[:-1]) > 0


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 30), st.integers(0, 5))
def test_processes_share_each_epoch_and_go_on_in_its_middle(
    count: int, ranks: int, first: int, seed: int
) -> None:
    config = TrainConfig(seed=seed)
    length = 3 * count
    whole = list(islice(positions(count, config, start=0), length * ranks))
    for epoch in range(3 * ranks):
        assert sorted(whole[epoch * count : (epoch + 1) * count]) == list(
            range(epoch * count, (epoch + 1) * count)
        )
    parts = [
        list(islice(positions(count, config, start=0, rank=rank, ranks=ranks), length))
        for rank in range(ranks)
    ]
    assert [part[index] for index in range(length) for part in parts] == whole
    for rank, part in enumerate(parts):
        rest = list(islice(positions(count, config, start=first, rank=rank, ranks=ranks), length))
        assert rest[: max(length - first, 0)] == part[first:]


@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.floats(0.05, 0.95),
    st.integers(0, 40),
    st.integers(1, 3),
)
def test_two_sources_come_by_turns_each_in_its_own_order(
    one: int, other: int, mix: float, first: int, ranks: int
) -> None:
    config = TrainConfig(seed=3)
    sources = [type("Counted", (SimpleNamespace,), {"__len__": lambda _, count=count: count})(model=None, data=None)  # noqa: E501
               for count in (one, other)]  # fmt: skip
    moments = MixedMoments((sources[0], sources[1]), mix)
    whole = list(islice(moments.numbers(config, start=0), 60 * ranks))
    assert abs(sum(source for source, _ in whole) - mix * len(whole)) <= 1
    for source, count in enumerate((one, other)):
        own = [number for of, number in whole if of == source]
        assert own == list(islice(positions(count, config, start=0), len(own)))
    rank = ranks - 1
    mine = list(
        islice(moments.numbers(config, start=first, rank=rank, ranks=ranks), 60 - min(first, 59))
    )
    assert mine[: max(60 - first, 0)] == whole[rank::ranks][first:]


# --- a step


@pytest.fixture(scope="module")
def batch(da: DeepAccident, moment: list[str], config: ModelConfig) -> dict[str, Any]:
    """One moment with the targets of all egos."""
    return learned(da, moment, config)


@pytest.fixture(scope="module")
def inputs(batch: dict[str, Any]) -> ModelInputs:
    return model_inputs(batch)


def test_partners_are_dropped_but_never_the_ego(inputs: ModelInputs) -> None:
    config = replace(RUN, partner_dropout=0.3, alone=0.2)
    egos = torch.eye(5).bool()
    heard = torch.stack(
        [with_dropped_partners(inputs, config, generator_of(0, n)).partners for n in range(800)]
    )
    assert heard[:, egos].all()
    partners = heard[:, ~egos].view(800, 5, 4)
    shares = [
        found.float().mean().item() for found in (partners, ~partners.any(2), partners.all(2))
    ]
    assert shares == pytest.approx([0.7 * 0.8, 0.2 + 0.8 * 0.3**4, 0.8 * 0.7**4], abs=0.02)
    absent = replace(inputs, partners=inputs.partners & (egos | (torch.arange(5) != 2)))
    for dropout, alone, kept in ((0, 0, absent.partners), (1, 0, egos), (0, 1, egos)):
        changed = replace(config, partner_dropout=dropout, alone=alone)
        assert torch.equal(with_dropped_partners(absent, changed, generator_of(0)).partners, kept)


def test_egos_are_drawn_from_every_moment(
    da: DeepAccident, moment: list[str], config: ModelConfig
) -> None:
    joined = learned(da, [*moment, *(each.replace("/004", "/006") for each in moment[3:])], config)
    whole, seen = joined["ego_rows"].tolist(), Counter[tuple[int, int]]()
    for number in range(60):
        chosen, targets = training_batch(joined, config, replace(RUN, egos=2), generator_of(number))
        pairs = [tuple(row) for row in chosen.ego_rows.tolist()]
        assert (Counter(moment for moment, _ in pairs), len(set(pairs))) == ({0: 2, 1: 2}, 4)
        seen.update(pairs)
        sources = [whole.index(list(pair)) for pair in pairs]
        for name in ("boxes", "categories", "velocity_known"):
            assert_equal(list(getattr(targets, name)), [joined[name][source] for source in sources])
        assert_equal(targets.motion.segmentation, joined["segmentation"][sources])
    assert all(10 < seen[0, agent] < 40 for agent in range(5))


def test_frames_beyond_the_recording_are_not_learned(
    da: DeepAccident, moment: list[str], config: ModelConfig
) -> None:
    """By the released rule, nor is any of a sample without its past."""
    tokens = [moment[0].replace("/004", frame) for frame in ("/001", "/004", "/005", "/006")]
    _, targets = training_batch(
        learned(da, tokens, config), config, replace(RUN, egos=None), generator_of(0)
    )
    masks = [[False] * 3, [True] * 3, [True, True, False], [True, False, False]]
    assert targets.motion.frame_mask.tolist() == masks


@pytest.mark.parametrize("make", [small, small_released, small_both, small_lidar])
@pytest.mark.parametrize("frame", ["/001", "/004"])
def test_every_parameter_has_a_gradient_at_every_moment(
    da: DeepAccident, moment: list[str], make: Callable[[], ModelConfig], frame: str
) -> None:
    """Though it may be 0, where a moment has no past and so no motion to learn: several processes
    wait for all.
    """
    step = TrainingStep(V2XFormer(make()))
    batch = learned(da, [each.replace("/004", frame) for each in moment], step.model.config)
    losses = step(*training_batch(batch, step.model.config, RUN, generator_of(0)))
    torch.stack(list(losses.values())).sum().backward()
    gradients = {name: each.grad for name, each in step.model.named_parameters()}
    assert [
        name for name, each in gradients.items() if each is None or not each.isfinite().all()
    ] == []


# --- what is trained


def test_frozen_parameters_stay_bit_for_bit(da: DeepAccident, tmp_path: Path) -> None:
    torch.manual_seed(RUN.seed)
    before = V2XFormer(small()).state_dict()
    config = replace(SHORT, freeze=("img_", "transformer.depthnet"))
    after = read_weights(trained(da, tmp_path, config)).tensors
    for name, parameter in V2XFormer(small()).named_parameters():
        assert torch.equal(before[name], after[name]) == name.startswith(config.freeze), (
            name,
            parameter.shape,
        )


# --- runs


@pytest.fixture(scope="module")
def whole(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run, with curves."""
    folder, said = tmp_path_factory.mktemp("runs") / "whole", list[str]()
    assert trained(da, folder, curves=True, say=said.append) == folder / BEST_FILE
    assert [each.split(":")[0] for each in said] == ["step 4", "step 6"]
    return folder


def test_a_run_leaves_its_files(whole: Path) -> None:
    assert {path.name for path in whole.iterdir()} == {
        "run.json",
        "log.jsonl",
        "curves.png",
        BEST_FILE,
        STATE_FILE,
    }
    log = read_log(whole)
    assert [(row["step"], "validation" in row) for row in log] == [
        (step, step in (4, 6)) for step in range(1, 7)
    ]
    for row in log:
        assert row["loss"] == pytest.approx(sum(row["losses"].values()))
        assert row["rate"] == learning_rate(row["step"] - 1, RUN)
    notes = read_weights(whole).meta  # of the first of two equal scores
    assert (notes["step"], notes["training"]) == (4, json.loads(json.dumps(RUN.as_dict())))


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, 4])
def test_a_killed_run_goes_on_as_if_nothing_had_been(
    da: DeepAccident, root: str, whole: Path, tmp_path: Path, step: int
) -> None:
    """Bit for bit: killed after a step in the log that is in no checkpoint, the second time at a
    validation.
    """
    folder = tmp_path / "killed"
    code = (
        f"from torch_extra.model.small_model import killed_run; "
        f"killed_run({root!r}, {str(folder)!r}, {step})"
    )
    ended = other_process("-c", code)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    assert [row["step"] for row in read_log(folder)] == list(range(1, step + 1))
    assert read_weights(folder / STATE_FILE).meta["step"] == 2
    trained(da, folder)
    assert rows(folder) == rows(whole)
    for name in (STATE_FILE, BEST_FILE):
        assert_equal(tensors(folder, name), tensors(whole, name))


def test_other_options_in_the_same_folder_are_refused(
    da: DeepAccident, whole: Path, tmp_path: Path
) -> None:
    before = {path.name: path.read_bytes() for path in whole.iterdir()}
    seed = ("run.json: is of another run", "training/seed: 0, asked for 1", "give the same options")
    assert_refused(
        (lambda: trained(da, whole, replace(RUN, seed=1)), ConfigError, seed),
        (
            lambda: trained(da, whole, weights=whole / BEST_FILE),
            ConfigError,
            ("is of another run", "from: ", BEST_FILE),
        ),
    )
    assert {path.name: path.read_bytes() for path in whole.iterdir()} == before
    for content, said in (("[]", "is of another run"), ('{"preset": ', "cannot be read")):
        (tmp_path / "run.json").write_text(content)
        assert_refused((lambda: trained(da, tmp_path), ConfigError, rf"run\.json: {said}"))


@pytest.mark.parametrize(
    "put",
    [
        lambda path, _: path.write_bytes(b""),
        lambda path, _: path.write_bytes(b"no weights"),
        lambda path, _: path.mkdir(),
        lambda path, whole: path.write_bytes((whole / BEST_FILE).read_bytes()),
    ],
    ids=["empty", "text", "folder", "weights alone"],
)
def test_a_checkpoint_of_another_run_is_refused(
    da: DeepAccident, whole: Path, tmp_path: Path, put: Any
) -> None:
    put(tmp_path / STATE_FILE, whole)
    assert_refused(
        (
            lambda: trained(da, tmp_path),
            ConfigError,
            r"last\.safetensors.*: (is no |weights cannot be read)",
        )
    )


def scaled(name: str, factor: float) -> Any:
    return lambda held, _: held.update({name: held[name] * factor})


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda _, notes: notes.update(step="6"), r"expected `int`, got `str` - at `\$\.step`"),
        (lambda _, notes: notes.update(step=-1), r"expected `int` >= 0 - at `\$\.step`"),
        (lambda _, notes: notes.update(step=10**30), r"at `\$\.step`|has 10+ steps"),
        (lambda _, notes: notes.update(step=7), "it has 7 steps, and the run 6"),
        (lambda _, notes: notes.pop("step"), "missing required field `step`"),
        (lambda _, notes: notes.update(best=[1]), r"got `array` - at `\$\.best`"),
        (lambda _, notes: notes.update(best=1e300), r"at `\$\.best`"),
        (
            lambda held, _: held.update({"optimizer.x.step": torch.ones(())}),
            r"'optimizer\.x\.step' is missing, or should",
        ),
        (
            lambda held, _: held.update({"x" * 10**6: torch.ones(())}),
            r"'x{10,60} … x{10,60}' is missing, or should",
        ),
        (lambda held, _: held.pop("optimizer.0.exp_avg"), r"'optimizer\.0\.exp_avg' is missing"),
        (lambda held, _: held.pop(next(iter(held))), "is missing, or should not be there"),
        (
            lambda held, _: held.update({"optimizer.0.exp_avg": torch.ones(3)}),
            r"optimizer\.0\.exp_avg is \(3,\) of",
        ),
        (
            lambda held, _: held.update({"optimizer.0.step": torch.ones((), dtype=torch.int8)}),
            r"of torch\.int8, not \(\)",
        ),
        (scaled("optimizer.0.step", -1), r"its optimizer has -\d+\.0 steps of 6"),
        (scaled("optimizer.0.step", float("nan")), "its optimizer has nan steps"),
        (scaled("optimizer.0.step", 100), "its optimizer has"),
    ],
)
def test_a_changed_checkpoint_is_refused(
    whole: Path, tmp_path: Path, change: Any, told: str
) -> None:
    weights = read_weights(whole / STATE_FILE)
    held, notes = dict(weights.tensors), dict(weights.meta)
    change(held, notes)
    write_weights(tmp_path / STATE_FILE, held, notes)
    model, told = V2XFormer(small()), rf"last\.safetensors: is no checkpoint of this run \(.*{told}"
    load = partial(load_state, tmp_path, model, optimizer_of(model, RUN), RUN.steps)
    assert_refused((load, ConfigError, told), (load, ConfigError, r"\A.{,600}\Z"))


@pytest.mark.parametrize("name", ["run.json", "log.jsonl"])
def test_too_large_files_of_a_run_are_refused(
    da: DeepAccident, whole: Path, tmp_path: Path, name: str
) -> None:
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / name).write_bytes(b" " * (65 << 20))
    assert_refused((lambda: trained(da, folder), ConfigError, rf"{name}: .*; remove "))


def test_a_run_begins_from_weights(da: DeepAccident, whole: Path, tmp_path: Path) -> None:
    said: list[str] = []
    trained(
        da,
        tmp_path,
        replace(SHORT, learning_rate=1e-30, weight_decay=0),
        weights=whole / BEST_FILE,
        say=said.append,
    )
    assert re.match(rf"{whole / BEST_FILE}: .* tensors loaded", said[0])
    names = [name for name, _ in V2XFormer(small()).named_parameters()]
    assert_equal(
        *[
            [held[name] for name in names]
            for held in (tensors(tmp_path, FINAL_FILE), tensors(whole, BEST_FILE))
        ]
    )


def test_the_best_weights_are_kept(da: DeepAccident, tmp_path: Path) -> None:
    scores, states = iter([0.2, 0.6, 0.5]), []

    def validated(model: V2XFormer, *_: Any) -> dict[str, float]:
        states.append({name: each.clone() for name, each in model.state_dict().items()})
        return {"score": next(scores)}

    with patch.object(training, "validated", validated):
        weights = read_weights(
            trained(da, tmp_path, replace(RUN, steps=3, validate_every=1, save_every=3))
        )
    assert (
        weights.meta["step"],
        weights.meta["score"],
        read_weights(tmp_path / STATE_FILE).meta["best"],
    ) == (2, 0.6, 0.6)
    assert_equal(dict(weights.tensors), states[1])


def test_workers_and_epochs_give_the_same_moments(da: DeepAccident, config: ModelConfig) -> None:
    """A moment's augmentation is that of its number, which runs on through the epochs."""
    moments = Moments(da, config, replace(RUN, egos=None))
    assert len(moments) == 2 * 6
    numbers = [3, 15, 4]
    read = list(batches(moments, numbers, replace(RUN, moments=1)))
    assert [each["egos"] for each in read[:2]] == [list(moments.data.egos[3])] * 2
    drawn = [each["augmentation"] for each in read]
    assert not torch.equal(*drawn[:2])
    assert_equal([collate_all_egos([moments[number]])["augmentation"] for number in numbers], drawn)


@pytest.mark.slow
def test_two_processes_train_one_model(root: str, tmp_path: Path) -> None:
    """Under `torchrun` as users start it: equal weights at the end, and one log."""
    folder = tmp_path / "run"
    command = (
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node=2",
        small_model.__file__,
    )
    ended = other_process(*command, root, str(folder))
    assert ended.returncode == 0, ended.stderr.decode()[-3000:]
    first, second = (
        torch.load(folder / f"rank_{rank}.pth", weights_only=True) for rank in range(2)
    )
    assert_equal(first, second)
    stored = tensors(folder, FINAL_FILE)
    assert_equal(
        {name: each.detach() for name, each in first.items()},
        {name: stored[name] for name in first},
    )
    assert [row["step"] for row in read_log(folder)] == [1, 2]
    assert {path.name for path in folder.iterdir()} == {
        "run.json", "log.jsonl", STATE_FILE, FINAL_FILE, "rank_0.pth", "rank_1.pth",
    }  # fmt: skip


# --- what is refused


def test_the_log_is_read_up_to_a_line_that_is_cut_off(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []
    for step in range(1, 4):
        add_to_log(tmp_path, {"step": step})
    path = tmp_path / "log.jsonl"
    path.write_bytes(path.read_bytes() + b'{"step": 4, "lo')
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3]
    cut_log(tmp_path, 2)
    assert path.read_bytes() == b'{"step": 1}\n{"step": 2}\n'
    told = r"log\.jsonl:2: expected a JSON object with a step \(.*; remove the line"
    for line in (
        b"no json\n",
        b"[1]\n",
        b'{"loss": 1}\n',
        b'{"step": "1"}\n',
        b'{"step": 1, "losses": [1]}\n',
    ):
        path.write_bytes(b'{"step": 1}\n' + line)
        assert_refused((lambda: read_log(tmp_path), ConfigError, told))


@pytest.mark.parametrize("linked", [Path.symlink_to, Path.hardlink_to])
def test_a_run_adds_nothing_to_a_file_elsewhere(
    tmp_path: Path, linked: Callable[[Path, Path], None]
) -> None:
    elsewhere, folder = tmp_path / "elsewhere.jsonl", tmp_path / "run"
    folder.mkdir()
    elsewhere.write_bytes(b'{"step": 1}\n')
    linked(folder / "log.jsonl", elsewhere)
    cut_log(folder, 9)  # as a run begins
    add_to_log(folder, {"step": 2})
    assert [row["step"] for row in read_log(folder)] == [1, 2]
    assert elsewhere.read_bytes() == b'{"step": 1}\n'


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"steps": 0}, ConfigError, "steps: expected a whole number from 1, found 0"),
        ({"moments": 1.5}, ConfigError, "moments: expected a whole number from 1"),
        ({"egos": 0}, ConfigError, "egos: expected a whole number from 1"),
        ({"seed": -1}, ConfigError, "seed: expected a whole number from 0"),
        ({"save_every": 0}, ConfigError, "save_every"),
        (
            {"partner_dropout": 1.1},
            ConfigError,
            r"partner_dropout: expected a share from 0 to 1, found 1\.1",
        ),
        ({"alone": -0.1}, ConfigError, "alone: expected a share from 0 to 1"),
        ({"warm_up": float("nan")}, ConfigError, "warm_up: expected a share"),
        ({"learning_rate": 0.0}, ConfigError, "learning_rate: expected a number above 0"),
        ({"learning_rate": float("inf")}, ConfigError, "learning_rate: expected a number above 0"),
        ({"clip": -1}, ConfigError, "clip: expected a number above 0"),
        ({"weight_decay": -1.0}, ConfigError, "weight_decay: expected a number from 0"),
        ({"weight_decay": "much"}, ConfigError, "weight_decay: expected a number"),
        ({"samples": "some"}, ChoiceError, "samples: expected one of"),
    ],
)
def test_wrong_options_are_named(
    changes: dict[str, Any], error: type[DeepAccidentError], message: str
) -> None:
    assert_refused((lambda: TrainConfig(**changes), error, message))


@pytest.mark.parametrize(
    ("variables", "facts"),
    [
        *(
            (f"WORLD_SIZE={word}", (f"WORLD_SIZE={word}",))
            for word in ("abc", "0", "-1", "1.5", "", "9" * 5000)
        ),
        ("WORLD_SIZE=2 RANK=2 LOCAL_RANK=0", ("RANK=2",)),
        ("WORLD_SIZE=2 RANK=one", ("RANK=one",)),
        (
            "WORLD_SIZE=99999999999999999999 RANK=0 MASTER_ADDR=127.0.0.1 MASTER_PORT=1",
            ("WORLD_SIZE=9999",),
        ),
        ("WORLD_SIZE=2 RANK=0", ("WORLD_SIZE=2", "MASTER_ADDR")),
        ("WORLD_SIZE=2 RANK=0 MASTER_ADDR=127.0.0.1 MASTER_PORT=high", ("WORLD_SIZE=2", "high")),
    ],
    ids=lambda value: value[:60] if isinstance(value, str) else "",
)
def test_a_wrong_environment_is_refused(
    variables: str, facts: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, _, word in (each.partition("=") for each in variables.split(" ")):
        monkeypatch.setenv(name, word)

    def begin() -> None:
        with processes("cpu"):
            pass

    assert_refused(
        (begin, ConfigError, (*(fact[:40] for fact in facts), "torchrun", "unset WORLD_SIZE"))
    )


def test_unknown_devices_and_releases_without_samples_are_refused(
    da: DeepAccident, tmp_path: Path
) -> None:
    absent, unknown = replace(SHORT, split="test"), replace(SHORT, split="exam")
    assert_refused(
        (
            lambda: checked_device("cuda:99"),
            ConfigError,
            ("device", "cuda:99", "cannot be used", "choose cpu"),
        ),
        (
            lambda: checked_device("gpu"),
            ConfigError,
            ("device", "gpu", "cannot be used", "choose cpu"),
        ),
        (
            lambda: trained(da, tmp_path / "a", absent),
            NotAvailableError,
            "test: no scenario of this split",
        ),
        (lambda: trained(da, tmp_path / "b", unknown), ChoiceError, "split"),
        (
            lambda: trained(da, tmp_path / "c", replace(SHORT, freeze=("",))),
            ConfigError,
            "nothing is left to train",
        ),
    )
    assert (checked_device("cpu"), checked_device("auto") in ("cpu", "cuda")) == ("cpu", True)
