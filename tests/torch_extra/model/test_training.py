"""Training: schedules, steps, runs that are killed and go on, several processes, and faults."""

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
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file
from support.expected_errors import assert_raises
from torch_extra.model import small_model
from torch_extra.model.small_model import (
    RUN,
    small_both_config,
    small_config,
    small_lidar_config,
    small_released_config,
    train_small_model,
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
    drop_partners,
    learning_rate,
    make_generator,
    make_optimizer,
    positions,
    training_batch,
)
from deepaccident_devkit.training.torch import AllEgosDataset, collate_all_egos

TWO_STEPS = replace(RUN, steps=2, validation=None, save_every=1)
TESTS_FOLDER = Path(__file__).parents[2]


def run_python(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(TESTS_FOLDER), *sys.path]),
        "OMP_NUM_THREADS": "1",
    }
    return subprocess.run(
        [sys.executable, *arguments], env=environment, check=False, capture_output=True, timeout=600
    )


def assert_equal(values: Any, expected: Any) -> None:
    """Check that tensors, or lists and dicts of tensors, are the same bit for bit."""
    torch.testing.assert_close(values, expected, rtol=0, atol=0, equal_nan=True)


def load_batch(da: DeepAccident, tokens: list[str], config: ModelConfig) -> dict[str, Any]:
    inputs = config.inputs("all", boxes="sample", labels=config.labels)
    return collate_all_egos(list(AllEgosDataset(da, tokens, inputs)))


def read_comparable_log(folder: Path) -> list[dict[str, Any]]:
    """Read the log without the numbers that depend on the machine's speed."""
    rows = read_log(folder)
    for row in rows:
        row.pop("seconds", None)
        row.pop("waiting", None)
    return rows


# --- the schedule


@given(st.integers(1, 400), st.floats(0, 1))
def test_the_rate_rises_and_falls_to_zero(steps: int, warm_up: float) -> None:
    config = TrainConfig(steps=steps, warm_up=warm_up, learning_rate=0.5)
    rates = [learning_rate(step, config) for step in range(steps + 1)]

    num_rising = round(warm_up * steps)
    rising = np.arange(1, num_rising + 1) / max(num_rising, 1)
    falling = (1 + np.cos(np.linspace(0, np.pi, steps - num_rising + 1))) / 2
    np.testing.assert_allclose(rates, 0.5 * np.concatenate([rising, falling]), atol=1e-12)
    assert min(rates[:-1]) > 0


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 30), st.integers(0, 5))
def test_processes_share_each_epoch_and_go_on_in_its_middle(
    count: int, ranks: int, first: int, seed: int
) -> None:
    config = TrainConfig(seed=seed)
    length = 3 * count

    all_numbers = list(islice(positions(count, config, start=0), length * ranks))

    for start in range(0, length * ranks, count):
        epoch_numbers = all_numbers[start : start + count]
        assert sorted(epoch_numbers) == list(range(start, start + count))

    for rank in range(ranks):
        rank_numbers = positions(count, config, start=0, rank=rank, ranks=ranks)
        expected = all_numbers[rank::ranks]
        assert list(islice(rank_numbers, length)) == expected

        resumed = positions(count, config, start=first, rank=rank, ranks=ranks)
        assert list(islice(resumed, max(length - first, 0))) == expected[first:]


@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.floats(0.05, 0.95),
    st.integers(0, 40),
    st.integers(1, 3),
)
def test_two_sources_come_by_turns_each_in_its_own_order(
    first_count: int, second_count: int, mix: float, first: int, ranks: int
) -> None:
    config = TrainConfig(seed=3)
    counts = (first_count, second_count)
    first_source, second_source = (
        MagicMock(model=None, data=None, **{"__len__.return_value": count}) for count in counts
    )
    moments = MixedMoments((first_source, second_source), mix)

    pairs = list(islice(moments.numbers(config, start=0), 60 * ranks))

    assert abs(sum(source for source, _ in pairs) - mix * len(pairs)) <= 1
    for source, count in enumerate(counts):
        numbers = [number for pair_source, number in pairs if pair_source == source]
        assert numbers == list(islice(positions(count, config, start=0), len(numbers)))

    rank = ranks - 1
    resumed = moments.numbers(config, start=first, rank=rank, ranks=ranks)
    expected = pairs[rank::ranks][first:]
    assert list(islice(resumed, len(expected))) == expected


# --- a step


@pytest.fixture(scope="module")
def batch(da: DeepAccident, moment: list[str], config: ModelConfig) -> dict[str, Any]:
    return load_batch(da, moment, config)


@pytest.fixture(scope="module")
def inputs(batch: dict[str, Any]) -> ModelInputs:
    return model_inputs(batch)


def test_partners_are_dropped_but_never_the_ego(inputs: ModelInputs) -> None:
    config = replace(RUN, partner_dropout=0.3, alone=0.2)
    egos = torch.eye(5).bool()
    draws = [
        drop_partners(inputs, config, make_generator(0, number)).partners for number in range(800)
    ]

    is_heard = torch.stack(draws)
    assert is_heard[:, egos].all()
    partners = is_heard[:, ~egos].view(800, 5, 4)
    shares = [
        events.float().mean().item() for events in (partners, ~partners.any(2), partners.all(2))
    ]
    assert shares == pytest.approx([0.7 * 0.8, 0.2 + 0.8 * 0.3**4, 0.8 * 0.7**4], abs=0.02)

    with_absent_agent = replace(inputs, partners=inputs.partners & (egos | (torch.arange(5) != 2)))
    for dropout, alone, expected in (
        (0, 0, with_absent_agent.partners),
        (1, 0, egos),
        (0, 1, egos),
    ):
        config = replace(RUN, partner_dropout=dropout, alone=alone)
        heard = drop_partners(with_absent_agent, config, make_generator(0))
        assert torch.equal(heard.partners, expected)


def test_egos_are_drawn_from_every_moment(
    da: DeepAccident, moment: list[str], config: ModelConfig
) -> None:
    later = [token.replace("/004", "/006") for token in moment[3:]]
    batch = load_batch(da, [*moment, *later], config)
    all_pairs = [tuple(row) for row in batch["ego_rows"].tolist()]
    two_egos = replace(RUN, egos=2)
    counts = Counter[tuple[int, int]]()

    for seed in range(60):
        inputs, targets = training_batch(batch, config, two_egos, make_generator(seed))

        pairs = [tuple(row) for row in inputs.ego_rows.tolist()]
        assert Counter(sample for sample, _ in pairs) == {0: 2, 1: 2}
        assert len(set(pairs)) == 4
        counts.update(pairs)
        rows = [all_pairs.index(pair) for pair in pairs]
        for name in ("boxes", "categories", "velocity_known"):
            assert_equal(
                list(getattr(targets, name)),
                [batch[name][row] for row in rows],
            )
        assert_equal(targets.motion.segmentation, batch["segmentation"][rows])

    assert all(10 < counts[0, agent] < 40 for agent in range(5))


def test_frames_beyond_the_recording_are_not_learned(
    da: DeepAccident, moment: list[str], config: ModelConfig
) -> None:
    """The released rule leaves out all frames of a sample without its past, too."""
    tokens = [moment[0].replace("/004", frame) for frame in ("/001", "/004", "/005", "/006")]
    batch = load_batch(da, tokens, config)

    _, targets = training_batch(batch, config, replace(RUN, egos=None), make_generator(0))

    assert targets.motion.frame_mask.tolist() == [
        [False] * 3,
        [True] * 3,
        [True, True, False],
        [True, False, False],
    ]


@pytest.mark.parametrize(
    "make_config", [small_config, small_released_config, small_both_config, small_lidar_config]
)
@pytest.mark.parametrize("frame", ["/001", "/004"])
def test_every_parameter_has_a_gradient_at_every_moment(
    da: DeepAccident, moment: list[str], make_config: Callable[[], ModelConfig], frame: str
) -> None:
    """Several processes wait for all gradients, even where a moment without a past gives zeros."""
    config = make_config()
    step = TrainingStep(V2XFormer(config))
    batch = load_batch(da, [token.replace("/004", frame) for token in moment], config)

    losses = step(*training_batch(batch, config, RUN, make_generator(0)))
    torch.stack(list(losses.values())).sum().backward()

    for name, weight in step.model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.isfinite().all(), name


# --- frozen parameters


def test_frozen_parameters_stay_bit_for_bit(da: DeepAccident, tmp_path: Path) -> None:
    torch.manual_seed(RUN.seed)
    before = V2XFormer(small_config()).state_dict()
    config = replace(TWO_STEPS, freeze=("img_", "transformer.depthnet"))

    after = read_weights(train_small_model(da, tmp_path, config)).tensors

    for name, _ in V2XFormer(small_config()).named_parameters():
        assert torch.equal(before[name], after[name]) == name.startswith(config.freeze), name


# --- runs


@pytest.fixture(scope="module")
def complete_run(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an undisturbed run with curves."""
    folder = tmp_path_factory.mktemp("runs") / "complete"
    messages: list[str] = []
    weights = train_small_model(da, folder, curves=True, say=messages.append)
    assert weights == folder / BEST_FILE
    assert [message.split(":")[0] for message in messages] == ["step 4", "step 6"]
    return folder


def test_a_run_leaves_its_files(complete_run: Path) -> None:
    names = {path.name for path in complete_run.iterdir()}
    assert names == {"run.json", "log.jsonl", "curves.png", BEST_FILE, STATE_FILE}

    log = read_log(complete_run)
    assert [row["step"] for row in log] == [1, 2, 3, 4, 5, 6]
    assert [row["step"] for row in log if "validation" in row] == [4, 6]
    for row in log:
        assert row["loss"] == pytest.approx(sum(row["losses"].values()))
        assert row["rate"] == learning_rate(row["step"] - 1, RUN)

    notes = read_weights(complete_run).meta
    assert notes["step"] == 4  # the first of two equal scores
    assert notes["training"] == json.loads(json.dumps(RUN.as_dict()))


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, 4])
def test_a_killed_run_goes_on_as_if_it_had_not_been_killed(
    da: DeepAccident, complete_run: Path, tmp_path: Path, step: int
) -> None:
    """The last step is in the log, but in no checkpoint; step 4 is also validated."""
    folder = tmp_path / "killed"
    code = (
        f"from torch_extra.model.small_model import train_and_die; "
        f"train_and_die({str(da.dataroot)!r}, {str(folder)!r}, {step})"
    )

    process = run_python("-c", code)
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()
    assert [row["step"] for row in read_log(folder)] == list(range(1, step + 1))
    assert read_weights(folder / STATE_FILE).meta["step"] == 2

    train_small_model(da, folder)
    assert read_comparable_log(folder) == read_comparable_log(complete_run)
    for name in (STATE_FILE, BEST_FILE):
        assert_equal(load_file(folder / name), load_file(complete_run / name))


def test_other_options_in_the_same_folder_are_refused(
    da: DeepAccident, complete_run: Path, tmp_path: Path
) -> None:
    before = {path.name: path.read_bytes() for path in complete_run.iterdir()}
    assert_raises(
        (
            lambda: train_small_model(da, complete_run, replace(RUN, seed=1)),
            ConfigError,
            (
                "run.json: belongs to another run",
                "training/seed: 0, asked for 1",
                "use the same options",
            ),
        ),
        (
            lambda: train_small_model(da, complete_run, weights=complete_run / BEST_FILE),
            ConfigError,
            ("belongs to another run", "from: ", BEST_FILE),
        ),
    )
    assert {path.name: path.read_bytes() for path in complete_run.iterdir()} == before

    for content, fault in (("[]", "belongs to another run"), ('{"preset": ', "cannot be read")):
        (tmp_path / "run.json").write_text(content)
        assert_raises(
            (lambda: train_small_model(da, tmp_path), ConfigError, rf"run\.json: {fault}")
        )


@pytest.mark.parametrize(
    "write",
    [
        lambda path, _: path.write_bytes(b""),
        lambda path, _: path.write_bytes(b"no weights"),
        lambda path, _: path.mkdir(),
        lambda path, run: path.write_bytes((run / BEST_FILE).read_bytes()),
    ],
    ids=["empty", "text", "folder", "only weights"],
)
def test_a_checkpoint_of_another_run_is_refused(
    da: DeepAccident, complete_run: Path, tmp_path: Path, write: Any
) -> None:
    write(tmp_path / STATE_FILE, complete_run)
    assert_raises(
        (
            lambda: train_small_model(da, tmp_path),
            ConfigError,
            r"last\.safetensors.*: (is not |weights cannot be read)",
        )
    )


def scale_tensor(name: str, factor: float) -> Any:
    """Return a change that multiplies one tensor of a checkpoint."""
    return lambda tensors, _: tensors.update({name: tensors[name] * factor})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _, notes: notes.update(step="6"), r"expected `int`, got `str` - at `\$\.step`"),
        (lambda _, notes: notes.update(step=-1), r"expected `int` >= 0 - at `\$\.step`"),
        (lambda _, notes: notes.update(step=10**30), r"at `\$\.step`|has 10+ steps"),
        (lambda _, notes: notes.update(step=7), "it has 7 steps, but the run has 6"),
        (lambda _, notes: notes.pop("step"), "missing required field `step`"),
        (lambda _, notes: notes.update(best=[1]), r"got `array` - at `\$\.best`"),
        (lambda _, notes: notes.update(best=1e300), r"at `\$\.best`"),
        (
            lambda tensors, _: tensors.update({"optimizer.x.step": torch.ones(())}),
            r"'optimizer\.x\.step' is missing or unex",
        ),
        (
            lambda tensors, _: tensors.update({"x" * 10**6: torch.ones(())}),
            r"'x{10,60} … x{10,60}' is missing or unex",
        ),
        (
            lambda tensors, _: tensors.pop("optimizer.0.exp_avg"),
            r"'optimizer\.0\.exp_avg' is missing",
        ),
        (lambda tensors, _: tensors.pop(next(iter(tensors))), "is missing or unexpected"),
        (
            lambda tensors, _: tensors.update({"optimizer.0.exp_avg": torch.ones(3)}),
            r"optimizer\.0\.exp_avg is \(3,\) of",
        ),
        (
            lambda tensors, _: tensors.update(
                {"optimizer.0.step": torch.ones((), dtype=torch.int8)}
            ),
            r"of torch\.int8, not \(\)",
        ),
        (
            scale_tensor("optimizer.0.step", -1),
            r"its optimizer has made -\d+\.0 steps, but the run has made 6",
        ),
        (scale_tensor("optimizer.0.step", float("nan")), "its optimizer has made nan steps"),
        (scale_tensor("optimizer.0.step", 100), "its optimizer has"),
    ],
)
def test_a_changed_checkpoint_is_refused(
    complete_run: Path, tmp_path: Path, change: Any, message: str
) -> None:
    weights = read_weights(complete_run / STATE_FILE)
    tensors, notes = dict(weights.tensors), dict(weights.meta)
    change(tensors, notes)
    write_weights(tmp_path / STATE_FILE, tensors, notes)

    model = V2XFormer(small_config())
    load = partial(load_state, tmp_path, model, make_optimizer(model, RUN), RUN.steps)
    assert_raises(
        (load, ConfigError, rf"last\.safetensors: is not a checkpoint of this run \(.*{message}"),
        (load, ConfigError, r"\A.{,600}\Z"),
    )


@pytest.mark.parametrize("name", ["run.json", "log.jsonl"])
def test_too_large_files_of_a_run_are_refused(
    da: DeepAccident, complete_run: Path, tmp_path: Path, name: str
) -> None:
    folder = shutil.copytree(complete_run, tmp_path / "run")
    (folder / name).write_bytes(b" " * (65 << 20))
    assert_raises(
        (
            lambda: train_small_model(da, folder),
            ConfigError,
            rf"{name}: .*; remove ",
        )
    )


def test_a_run_begins_from_weights(da: DeepAccident, complete_run: Path, tmp_path: Path) -> None:
    weights = complete_run / BEST_FILE
    config = replace(TWO_STEPS, learning_rate=1e-30, weight_decay=0)  # changes nothing
    messages: list[str] = []

    train_small_model(da, tmp_path, config, weights=weights, say=messages.append)

    assert re.match(rf"{weights}: .* tensors loaded", messages[0])
    initial, final = load_file(weights), load_file(tmp_path / FINAL_FILE)
    for name, _ in V2XFormer(small_config()).named_parameters():
        assert_equal(final[name], initial[name])


def test_the_best_weights_are_kept(da: DeepAccident, tmp_path: Path) -> None:
    scores = [0.2, 0.6, 0.5]
    states: list[dict[str, torch.Tensor]] = []

    def validate(model: V2XFormer, *_: Any) -> dict[str, float]:
        states.append({name: values.clone() for name, values in model.state_dict().items()})
        return {"score": scores[len(states) - 1]}

    config = replace(RUN, steps=3, validate_every=1, save_every=3)
    with patch.object(training, "validate_model", validate):
        weights = read_weights(train_small_model(da, tmp_path, config))

    assert (weights.meta["step"], weights.meta["score"]) == (2, 0.6)
    assert read_weights(tmp_path / STATE_FILE).meta["best"] == 0.6
    assert_equal(dict(weights.tensors), states[1])


def test_workers_and_epochs_give_the_same_moments(da: DeepAccident, config: ModelConfig) -> None:
    """A moment's augmentation depends on its number, which runs on through the epochs."""
    moments = Moments(da, config, replace(RUN, egos=None))
    assert len(moments) == 2 * 6
    numbers = [3, 15, 4]  # 3 and 15 are the same moment in two epochs

    loaded = list(batches(moments, numbers, replace(RUN, moments=1)))

    assert loaded[0]["egos"] == loaded[1]["egos"] == list(moments.data.egos[3])
    assert not torch.equal(loaded[0]["augmentation"], loaded[1]["augmentation"])
    for number, batch in zip(numbers, loaded, strict=True):
        expected = collate_all_egos([moments[number]])
        assert_equal(batch["augmentation"], expected["augmentation"])


@pytest.mark.slow
def test_two_processes_train_one_model(da: DeepAccident, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")

    process = run_python(*torchrun, small_model.__file__, str(da.dataroot), str(folder))
    assert process.returncode == 0, process.stderr.decode()[-3000:]

    first, second = (
        torch.load(folder / f"rank_{rank}.pth", weights_only=True) for rank in range(2)
    )
    assert_equal(first, second)
    tensors = load_file(folder / FINAL_FILE)
    for name, parameter in first.items():
        assert_equal(parameter.detach(), tensors[name])
    assert [row["step"] for row in read_log(folder)] == [1, 2]
    names = {path.name for path in folder.iterdir()}
    run_files = {"run.json", "log.jsonl", STATE_FILE, FINAL_FILE}
    assert names == {*run_files, "rank_0.pth", "rank_1.pth"}


# --- faults


def test_the_log_is_read_up_to_a_line_that_is_cut_off(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []
    for step in range(1, 4):
        add_to_log(tmp_path, {"step": step})
    path = tmp_path / "log.jsonl"
    path.write_bytes(path.read_bytes() + b'{"step": 4, "lo')
    assert [row["step"] for row in read_log(tmp_path)] == [1, 2, 3]

    cut_log(tmp_path, 2)
    assert path.read_bytes() == b'{"step": 1}\n{"step": 2}\n'

    message = r"log\.jsonl:2: expected a JSON object with a step \(.*; remove the line"
    for line in (
        b"no json\n",
        b"[1]\n",
        b'{"loss": 1}\n',
        b'{"step": "1"}\n',
        b'{"step": 1, "losses": [1]}\n',
    ):
        path.write_bytes(b'{"step": 1}\n' + line)
        assert_raises((lambda: read_log(tmp_path), ConfigError, message))


@pytest.mark.parametrize("make_link", [Path.symlink_to, Path.hardlink_to])
def test_a_run_adds_nothing_to_a_file_elsewhere(
    tmp_path: Path, make_link: Callable[[Path, Path], None]
) -> None:
    target, folder = tmp_path / "elsewhere.jsonl", tmp_path / "run"
    folder.mkdir()
    target.write_bytes(b'{"step": 1}\n')
    make_link(folder / "log.jsonl", target)

    cut_log(folder, 9)  # as at the beginning of a run
    add_to_log(folder, {"step": 2})

    assert [row["step"] for row in read_log(folder)] == [1, 2]
    assert target.read_bytes() == b'{"step": 1}\n'


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
    assert_raises((lambda: TrainConfig(**changes), error, message))


@pytest.mark.parametrize(
    ("variables", "facts"),
    [
        *(
            (f"WORLD_SIZE={value}", (f"WORLD_SIZE={value}",))
            for value in ("abc", "0", "-1", "1.5", "", "9" * 5000)
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
    for variable in variables.split(" "):
        name, value = variable.split("=")
        monkeypatch.setenv(name, value)

    def begin() -> None:
        with processes("cpu"):
            pass

    shortened_facts = [fact[:40] for fact in facts]
    assert_raises((begin, ConfigError, (*shortened_facts, "torchrun", "unset WORLD_SIZE")))


def test_unknown_devices_and_releases_without_samples_are_refused(
    da: DeepAccident, tmp_path: Path
) -> None:
    facts = ("cannot be used", "choose cpu")
    absent_split, unknown_split = replace(TWO_STEPS, split="test"), replace(TWO_STEPS, split="exam")
    assert_raises(
        (lambda: checked_device("cuda:99"), ConfigError, ("device", "cuda:99", *facts)),
        (lambda: checked_device("gpu"), ConfigError, ("device", "gpu", *facts)),
        (
            lambda: train_small_model(da, tmp_path / "a", absent_split),
            NotAvailableError,
            "test: no scenario of this split",
        ),
        (lambda: train_small_model(da, tmp_path / "b", unknown_split), ChoiceError, "split"),
        (
            lambda: train_small_model(da, tmp_path / "c", replace(TWO_STEPS, freeze=("",))),
            ConfigError,
            "no parameter is left to train",
        ),
    )
    assert checked_device("cpu") == "cpu"
    assert checked_device("auto") in ("cpu", "cuda")
