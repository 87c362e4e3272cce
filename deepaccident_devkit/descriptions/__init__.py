"""What happens in a scenario: facts, sentences, which agents saw it, and when to brake."""

from deepaccident_devkit.descriptions.avoidability import (
    Avoidability,
    avoidability,
    avoidability_of,
)
from deepaccident_devkit.descriptions.observation import (
    ObservationRule,
    coalition_leads,
    observed_actors,
    shapley_values,
)
from deepaccident_devkit.descriptions.stories import (
    Story,
    describe,
    scenario_facts,
    stories,
    story_text,
)

__all__ = [
    "Avoidability",
    "ObservationRule",
    "Story",
    "avoidability",
    "avoidability_of",
    "coalition_leads",
    "describe",
    "observed_actors",
    "scenario_facts",
    "shapley_values",
    "stories",
    "story_text",
]
