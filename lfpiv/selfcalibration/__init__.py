"""Self-calibration: how far apart cameras show the same particles, and the cameras' movements that explain it."""
