"""Engines for many videos: processes of this machine or a Ray cluster, and the loop that schedules tasks."""
