"""The thin layer that reads and writes files around the pure functions of the lower rooms, one module a stage."""
