"""Self-calibration: measure how far apart cameras show the same particles, and the movements that explain it."""
