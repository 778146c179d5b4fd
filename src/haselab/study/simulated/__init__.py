"""Knowledge about a simulated bench: true parameters and noise-free results."""
