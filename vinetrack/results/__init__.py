"""A results folder: what each file is called, what it holds, and reading it back."""
