"""What every package stands on: records, units, tables, problems, the terminal."""
