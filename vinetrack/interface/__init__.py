"""What a user calls from Python: load, fit, diagnose and compare, from any source of trials."""
