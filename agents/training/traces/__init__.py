"""Running means that a network remembers with: by torch, and as observations of an env."""
