"""What a vine not yet built will do, and how to build it: prediction with its uncertainty, and design."""
