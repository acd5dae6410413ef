"""The compiler and the kinds of numbers: one text for Python, SIMD lanes, NumPy, torch and CasADi.

`jit` compiles a plain function, `as_python` rebuilds its text for another kind of numbers.
`primitives` and `arrays` are what such texts may call; `elementary` and `random` are built from
them. Nothing of sideslip is imported here, and every other room may import this one.
"""
