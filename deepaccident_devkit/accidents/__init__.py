"""Accidents as their labels tell them: who collides, when replays touch, what braking makes of it, and their twins."""
