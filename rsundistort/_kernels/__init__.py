"""Compiled kernels: arrays and scalars in, arrays out, codes instead of exceptions."""
