"""What a campaign will take, from a short calibration of this machine: time, memory and disk."""
