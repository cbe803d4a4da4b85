"""Self-calibration: disparities between cameras, measured with particles, and the camera movements that explain them."""
