"""tie-vision's claims: estimation, control with Table II and its margins, convergence, appendix."""
