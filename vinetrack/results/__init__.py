"""Results folders: names and content of the files, and reading them."""
