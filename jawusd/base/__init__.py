"""The foundation of all layers: exceptions, version, safe readers of npz and tables, input checks, the schema's path.

May import only the standard library and numpy.
"""
