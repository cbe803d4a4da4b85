"""Volumes from images by SMART (Eq. 5), for one instant or for both instants of a pair."""
