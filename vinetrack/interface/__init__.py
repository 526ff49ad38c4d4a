"""The Python interface: load, fit, diagnose and compare, for trials from any source."""
