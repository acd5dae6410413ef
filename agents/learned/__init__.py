"""A learned policy as one safetensors file with a card, run by NumPy; the shipped ones."""
