"""Measured positions: read from files of other programs, their noise, and the timing of their frames."""
