"""What every other layer stands on: exceptions, version, safe arrays from files, paths, the schema's place.

Imports the standard library and numpy alone.
"""
