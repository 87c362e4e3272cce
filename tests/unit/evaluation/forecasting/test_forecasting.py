"""Every default and constant of forecasting, against what is written out here."""

from support.default_values import package_values

from deepaccident_devkit.evaluation.forecasting.evaluator import (
    FORECASTING_PROTOCOLS,
    ForecastingEvaluator,
)

EXPECTED_VALUES = {
    "evaluator.TOGETHER": "'together'",
    "evaluator.FORECASTING_PROTOCOLS": (
        "mappingproxy({'clean': ForecastingProtocol(horizons=(3.0, 1.0, 2.0, 5.0), "
        "modes=(6, 1), miss_distance=2.0)})"
    ),
    "evaluator.ForecastingProtocol": "horizons=(3.0, 1.0, 2.0, 5.0), modes=(6, 1), "
    "miss_distance=2.0",
    "metrics.MISS_DISTANCE": "2.0",
    "metrics.COLLISION_DISTANCE": "1.0",
    "metrics.SAME_TIME": "0.001",
    "metrics.misses": "miss_distance=2.0",
    "metrics.miss_rate": "miss_distance=2.0",
    "metrics.actor_errors": "miss_distance=2.0",
    "metrics.collisions": "distance=1.0",
    "of_motion.forecasts_of": "step=0.5, labels='released'",
    "truth.PATH_SECONDS": "5.0",
    "truth.MOVING_SPEED": "0.5",
    "truth.EVERYBODY": "'all'",
    "truth.CLASS_LABELS": (
        "('class car', 'class truck', 'class van', 'class cyclist', 'class "
        "motorcycle', 'class pedestrian')"
    ),
    "truth.ROLES": "('collider', 'other')",
    "truth.VIEWERS": "('seen by ego', 'seen by a partner alone', 'seen by nobody')",
    "truth.TO_IMPACT": (
        "('0–1 s to impact', '1–2 s to impact', '2–3 s to impact', '3–4 s to "
        "impact', '4–5 s to impact', 'normal')"
    ),
    "truth.MOTIONS": "('moving', 'standing')",
    "truth.forecasting_truth": "seconds=5.0",
}


def test_every_default_and_constant_written_out() -> None:
    assert package_values("deepaccident_devkit.evaluation.forecasting") == EXPECTED_VALUES
    assert ForecastingEvaluator.needs_whole_recordings is True
    assert ForecastingEvaluator.needs_meta is False
    assert [*FORECASTING_PROTOCOLS] == ["clean"]
