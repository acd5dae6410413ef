"""The papers' claims: one to three modules a paper, each claim with its verdict.

`ledger` holds what a claim is measured with, `manoeuvres` the drives and plots, `theory` what needs
no simulation. Claims are formatted by hand: each a paragraph, each part a line.
"""
