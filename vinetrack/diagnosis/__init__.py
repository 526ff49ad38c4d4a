"""Model against measurement: where a model fails, and by how much more than repeated trials differ."""
