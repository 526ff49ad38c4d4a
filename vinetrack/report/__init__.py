"""Everything a person wants to see of an experiment, in one HTML file that opens anywhere."""
