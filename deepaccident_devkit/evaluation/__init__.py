"""The official metrics, and those that the paper describes: motion, accidents, detection."""
