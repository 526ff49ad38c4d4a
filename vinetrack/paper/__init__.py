"""The paper's published numbers set beside ours."""
