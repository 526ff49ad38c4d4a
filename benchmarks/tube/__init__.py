"""Recordings of a pressure-driven everting tube made by others, put to the package as an experiment of its own."""
