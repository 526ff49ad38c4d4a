"""What a user brings: the trial sheet, the settings, the folder, and where they were read from."""
