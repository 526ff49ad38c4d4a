"""The user's input: trial sheet, settings, experiment folder, and the provenance record of what was read."""
