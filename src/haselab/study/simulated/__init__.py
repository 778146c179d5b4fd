"""What is known of a simulated bench: true parameters and noise-free results."""
