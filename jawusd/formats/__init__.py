"""The file formats of jawusd: per format one dataclass with reader and writer.

May import only base, numpy, pydantic and the standard library.
"""
