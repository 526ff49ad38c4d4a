"""A track becomes velocity, a steady window, x_ss, and the damping law F = B·x_ssⁿ."""
