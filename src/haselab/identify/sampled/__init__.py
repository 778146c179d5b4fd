"""Models in discrete time: difference equations and state models."""
