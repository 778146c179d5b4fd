"""Cameras of a real bench behind `haselab.rig.Camera`: GenICam, V4L2, a folder or a video file."""
