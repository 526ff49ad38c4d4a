"""Foundations of all packages: records, units, tables, problems, terminal output."""
