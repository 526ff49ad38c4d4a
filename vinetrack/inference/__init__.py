"""Fits of the model to trajectories: a nonlinear mixed-effects model, its optimiser and its errors."""
