"""Volumes of a time series, each frame from those before and after it."""
