"""Volumes from images by SMART (Eq. 5), for one frame or for both frames of a pair."""
