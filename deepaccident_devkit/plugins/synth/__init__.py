"""A CARLA-free generator of complete synthetic releases in the official on-disk layout.

The world is simulated in its own right-handed coordinate frame, `ground`: the junction at the
origin, metres, z up. One rigid transform, `world_from_ground`, places it in a town. The modules,
lowest layer first: `solids` and `shapes` (the geometry of things), `roads` and `world` (the static
world), `actors` and `traffic` (the moving road users), `spec` (scenario files, with the twelve
designs), `plan` (settings, and the scenarios of a release), `sensors` (the recordings of the
agents), `scenario` (the course of one scenario, and its files) and `generate` (the release).
"""

from deepaccident_devkit.plugins.synth.generate import make_release
from deepaccident_devkit.plugins.synth.plan import SynthConfig

__all__ = ["SynthConfig", "make_release"]
