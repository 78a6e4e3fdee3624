"""Errors of trajectories, images and meshes."""
