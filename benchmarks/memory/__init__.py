"""Kinds of memory by how much more they cost than the optimum: cases, measurements, the suite."""
