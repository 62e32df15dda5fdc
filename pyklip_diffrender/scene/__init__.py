"""What is observed: stars and planets, observed frames, simulated frames."""
