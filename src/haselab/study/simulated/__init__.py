"""Knowledge about a simulated bench: true parameters, noise-free results, simulated steps."""
