"""`WarningResult`: the base of the results of both warning protocols."""

from typing import ClassVar

from deepaccident_devkit.evaluation.task import Row, TaskResult


class WarningResult(TaskResult):
    """Base of the results of the task `warning`; it defines the rows of both protocols."""

    __slots__ = ()

    rows: ClassVar[tuple[Row, ...]] = (
        Row("groups/*/auc_ahead", "share", "higher", name="auc_ahead *"),
        Row("groups/*/twin_wins", "share", "higher", name="twin_wins *"),
        Row("groups/*/average_precision", "share", "higher", name="AP *"),
        Row("groups/*/operating/precision", "share", "higher", name="precision *"),
        Row("groups/*/operating/time_in_alarm", "share", name="time_in_alarm *"),
        Row("groups/*/operating/recall", "share", "higher", name="recall *"),
        Row("groups/*/operating/tta0", "s", "higher", name="tta0 *"),
        Row("figures/*/average_precision", "share", "higher", name="AP *"),
        Row("figures/*/mean_time", "s", "higher", name="mTTA *"),
        Row("figures/*/time_at_r80", "s", "higher", name="TTA@R80 *"),
        Row("area_under_curve", "share", "higher", is_headline=False),
        Row("mean_time", "s", "higher", is_headline=False),
        Row("precision", "share", "higher", is_headline=False),
        Row("recall", "share", "higher", is_headline=False),
        Row("time_in_alarm", "share", is_headline=False),
        Row("early_share", "share", is_headline=False),
        Row("alarm_seconds_per_minute", "1/min", is_headline=False),
        Row("episodes_per_minute", "1/min", is_headline=False),
        Row("tta_hit", "s", "higher", is_headline=False),
        Row("tta0", "s", "higher", is_headline=False),
        Row("tta0_after/*", "s", "higher", is_headline=False),
        Row("precision_at_r80", "share", "higher", is_headline=False),
        Row("precision_at_half", "share", "higher", is_headline=False),
        Row("recall_at_half", "share", "higher", is_headline=False),
        Row("time_at_half", "s", "higher", is_headline=False),
    )
