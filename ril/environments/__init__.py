"""One environment: what it is, what is checked of it, and its goal."""
