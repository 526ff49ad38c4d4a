"""An experiment set up from a folder of recordings: its sheet and settings, by a local page or without one."""
