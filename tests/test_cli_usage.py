"""An option that changes nothing in a call is refused, and the message says why."""

import pytest
from click.testing import CliRunner, Result

from deepaccident_devkit.cli import deepaccident

BASELINE = "predict constant_velocity release --out out"
EVALUATE = "evaluate {} release --results results"
CASES = [
    (EVALUATE.format("motion") + " --overwrite", "--overwrite changes nothing without --out"),
    (EVALUATE.format("motion") + " --include-results", "--include-results changes nothing without --out"),
    (EVALUATE.format("warning") + " --threshold-by quiet", "--threshold-by changes nothing without --threshold-from"),
    (
        EVALUATE.format("warning") + " --threshold-from runs/train --switch threshold=0.5",
        "--threshold-from sets the threshold that --switch threshold=… sets; give one of them",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --resamples 100",
        "--resamples changes nothing with --protocol field, which has no intervals",
    ),
    (
        EVALUATE.format("warning") + " --protocol field --prevented",
        "--prevented needs the scores of whole recordings, which --protocol field does not have; give --protocol clean",
    ),
    (EVALUATE.format("detection") + " --samples all --horizon 3", "--horizon changes nothing with --samples all"),
    ("evaluate check results --split val", "--split changes nothing without --dataroot"),
    ("evaluate check results --on-error raise", "--on-error changes nothing without --dataroot"),
    (BASELINE + " --latency 0.2", "--latency changes nothing with --agents single"),
    (
        "predict constant_velocity release --out out --agents all --seed 3",
        "--seed changes nothing without --pose-noise",
    ),
    (
        "predict constant_velocity release --out out --samples all --scope all",
        "--scope changes nothing with --samples all",
    ),
    ("render bev release --out a.png --pose-noise 0.3", "--pose-noise changes nothing without --agents"),
    ("render bev release --out a.png --agents all --seed 3", "--seed changes nothing without --pose-noise"),
    ("export mcap release --out a.mcap --channels Camera_Front --points 3", "--points changes nothing without the cha"),
    ("validate release --json --all", "--all changes nothing with --json"),
    ("split release --seed 3 --out mine.txt", "--seed changes nothing with --where or a split file"),
    ("split release --overwrite", "--overwrite changes nothing without --out"),
    ("synth out --design mine.yaml --unplanned 0.5", "--unplanned changes nothing with a scenario file or --view"),
    ("predict tiny release --out out --horizon 3", "--horizon changes nothing with a trained model"),
    (BASELINE + " --device cpu", "--device changes nothing with a baseline"),
    ("results pyproject.toml release --out out --method me", "--method changes nothing without --truth"),
    ("results pyproject.toml release --truth pyproject.toml --out out", "give DATAROOT for detections of a nuScenes"),
    ("safety describe release --out .", "--out: . is a folder; give a file, such as ./stories.jsonl"),
    ("safety twins release --replays 3", "--replays changes nothing with twins"),
    ("safety report release --json", "--json changes nothing with report"),
    ("info release --out out", "--out changes nothing without --statistics"),
]


def run(*words: str) -> Result:
    return CliRunner().invoke(deepaccident, words)


@pytest.mark.parametrize(("words", "sentence"), CASES)
def test_an_option_that_changes_nothing_is_refused(words: str, sentence: str) -> None:
    result = run(*words.split())
    assert (result.exit_code, sentence in result.stderr) == (2, True), result.output
