"""Cameras of a real bench as `haselab.rig.Camera`: GenICam, V4L2, a folder or a video file."""
