"""Dots of a calibration board: found, named, and located in every microimage."""
