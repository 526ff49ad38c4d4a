"""A model is a sum of effects; simulated, it gives the trajectory of a trial."""
