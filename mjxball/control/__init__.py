"""Controllers that run unchanged on NumPy and JAX arrays. The lowest layer: imports nothing above it.

Every function takes arrays of any leading batch shape and works in the namespace of its inputs
(`x.__array_namespace__()`), so the jitted environment and the laptop call the same code.
"""
