"""Training: from a release to weights, with a log, curves, validation and resumption (`train.train`)."""
