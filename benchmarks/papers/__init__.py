"""The papers' claims: one to three modules a paper, each claim with its verdict.

`ledger` holds what a claim is measured with, `manoeuvres` the drives and plots of the control
papers, `theory` what needs no simulation.
"""
