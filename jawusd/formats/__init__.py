"""File formats of jawusd: for each format a dataclass, a reader and a writer.

This package may import only base, numpy, pydantic and the standard library.
"""
