"""The experiment on cooperation: trains the small model alone and with partners, and counts what differs."""
