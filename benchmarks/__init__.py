"""Scripts that measure: speed, accuracy, calibration, real frames. No part of the package."""
