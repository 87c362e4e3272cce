"""A CARLA-free generator of complete synthetic releases in the official on-disk layout.

The world is simulated in its own right-handed coordinate frame, `ground`: the junction at the origin, metres, z up. One
rigid transform, `world_from_ground`, places it in a town. The parts, lowest layer first: `solids` and `shapes` (what
things are made of), `roads` and `stage` (what stands still), `actors`, `collision` and `traffic` (what moves), `spec`
(scenario files, with the twelve designs), `config` and `plan` (which scenarios a release has), `scenario` (all that
happens in one), `sensors` (what the agents record), `recording` and `generate` (the files).
"""

from deepaccident_devkit.synth.generate import make_release
from deepaccident_devkit.synth.plan import SynthConfig

__all__ = ["SynthConfig", "make_release"]
