"""The command line: `main` runs, compares and tunes, `data` has what reads logs and pictures.

`policies` has what makes and drives policies, `live` the live loop; all take options of `common`.
"""
