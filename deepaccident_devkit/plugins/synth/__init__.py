"""A CARLA-free generator of complete synthetic releases in the official on-disk layout.

The world is simulated in its own right-handed coordinate frame, `ground`: the junction at the origin, metres, z up. One
rigid transform, `world_from_ground`, places it in a town. The parts, lowest layer first: `solids` and `shapes` (what
things are made of), `roads` and `world` (what stands still), `actors` and `traffic` (what moves), `spec` (scenario
files, with the twelve designs), `plan` (settings, and which scenarios a release has), `sensors` (what the agents
record), `scenario` (all that happens in one, and its files) and `generate` (the release).
"""

from deepaccident_devkit.plugins.synth.generate import make_release
from deepaccident_devkit.plugins.synth.plan import SynthConfig

__all__ = ["SynthConfig", "make_release"]
