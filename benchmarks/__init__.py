"""How fast the devkit is, as ratios to stated bounds: `python -m benchmarks [NAME…] [--json]`, from
a checkout.
"""
