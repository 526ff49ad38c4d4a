"""Virtual experiments whose truth is known: for tests, benchmarks and the demonstration, never for the analysis."""
