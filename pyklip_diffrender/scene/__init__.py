"""Stars and planets, observed frames, and simulated frames."""
