"""Two local pages: recordings become an experiment, and a model is tried on its trials until the error falls."""
