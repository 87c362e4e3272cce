"""A CARLA-free generator of complete synthetic releases in the official on-disk layout.

The world is simulated in a right-handed frame of its own, `ground`: the junction at the origin, the road at z = 0.
One rigid transform, `world_from_ground`, sets it on a gentle slope somewhere in a town. The parts, from below:
`solids`, `shapes`, `bodies` (what things are made of), `roads` and `world` (what stands still), `actors`, `collision`
and `traffic` (what moves), `design` (the accident), `scenario` (all of it together), `scene` and `caster` (one moment,
and rays into it), `look` and `shadows` (its light), `agents` (who records), `lidar`, `camera`, `bev`, `annotate` (what
they record), `recording` and `generate` (the files).
"""

from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.generate import make_release

__all__ = ["SynthConfig", "make_release"]
