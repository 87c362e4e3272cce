"""The moving road users: they drive, follow, yield and walk, simulated at 50 Hz."""
