"""The papers' claims: one module a paper, each claim with its verdict.

`ledger` holds what a claim is measured with, `theory` what needs no simulation, `tie_vision` that
paper's own four modules.
"""
