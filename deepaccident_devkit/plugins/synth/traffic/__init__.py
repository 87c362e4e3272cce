"""What moves: road users that drive, follow, yield and walk, simulated at 50 Hz until something happens."""
