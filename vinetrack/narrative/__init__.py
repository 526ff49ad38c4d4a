"""Results in words: one text for terminal, report and explorer."""
