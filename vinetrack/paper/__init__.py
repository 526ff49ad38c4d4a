"""Comparison of the published numbers of the paper with ours."""
