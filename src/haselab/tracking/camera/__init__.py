"""Properties of camera and picture: lens, light, noise, scale, rigid motion."""
