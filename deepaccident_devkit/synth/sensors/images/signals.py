"""Which lamps of the traffic lights shine."""

from collections.abc import Mapping

from deepaccident_devkit.synth.roads import Arm
from deepaccident_devkit.synth.solids import Color
from deepaccident_devkit.synth.stage import LAMP_COLORS, World


def lit_lamps(world: World, signals: Mapping[Arm, int]) -> dict[int, Color]:
    """Rows of the lamps among `World.props` that shine, and their colours.

    Args:
        world: where the lights stand.
        signals: of each arm: 0 red, 1 amber, 2 green, as in `traffic.signals`; arms that are not there are dark.
    """
    states = {head: signals[head.arm] for head in world.signals if head.arm in signals}
    return {head.rows[state]: LAMP_COLORS[state] for head, state in states.items()}
