"""Properties of camera and image: lens, light, noise, scale, rigid motion."""
