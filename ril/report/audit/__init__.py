"""Where the paper contradicts itself."""
