"""A local page to do the story: see where the model fails, add an effect, refit, and watch the error fall."""
