"""Recordings, and positions measured elsewhere, become a track: where the leading edge was at each frame."""
