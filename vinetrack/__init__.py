"""vinetrack: from recordings of everting vine robots to the physics that a model of them lacks."""

__version__ = "0.1.0"
