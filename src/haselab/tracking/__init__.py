"""From video frames to displacements and strain."""

from haselab.tracking.camera.noise import NoiseLaw, measure_noise
from haselab.tracking.options import TrackOptions
from haselab.tracking.particles.detect import (
    DotProfile,
    Particles,
    detect_fiducials,
    detect_particles,
    find_profile,
    locate_particles,
)
from haselab.tracking.particles.link import Trajectories, link_particles
from haselab.tracking.points import PointTracker, track_frames
from haselab.tracking.rest import frames_at_rest
from haselab.tracking.strain import (
    GaugeStrain,
    Homogeneity,
    StrainField,
    gauge_strain,
    homogeneity,
    strain_field,
)
from haselab.tracking.tracks import FrameTracks, LossReason, Tracks, TrackState

__all__ = [
    "DotProfile",
    "FrameTracks",
    "GaugeStrain",
    "Homogeneity",
    "LossReason",
    "NoiseLaw",
    "Particles",
    "PointTracker",
    "StrainField",
    "TrackOptions",
    "TrackState",
    "Tracks",
    "Trajectories",
    "detect_fiducials",
    "detect_particles",
    "find_profile",
    "frames_at_rest",
    "gauge_strain",
    "homogeneity",
    "link_particles",
    "locate_particles",
    "measure_noise",
    "strain_field",
    "track_frames",
]
