"""The papers' claims: one or two modules a paper, each claim with its verdict.

`ledger` holds what a claim is measured with, `manoeuvres` the drives. Claims are formatted by hand:
each a paragraph, each part a line.

Args:
    seeds: Seeds of a simulation, which are run one after the other.
"""
