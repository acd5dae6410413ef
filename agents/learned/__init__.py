"""A learned policy as one safetensors file with a card, run by NumPy; the shipped ones.

`forward` has dense layers, cells and moving averages, `network` a whole network and its file,
`policy` the card and the controller.
"""
