"""Experiments with the identified physical model, in a session of their own."""
