"""A local page to do the summary: see where the model fails, add an effect, refit, and watch the error fall."""
