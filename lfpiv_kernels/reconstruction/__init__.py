"""Projection, back projection and SMART's update (Warp)."""
