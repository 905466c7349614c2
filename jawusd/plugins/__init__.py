"""Code that runs inside other programs: a Blender add-on, a reader, and recipes for Maya, Houdini and Unreal.

`extension` packages this code as files that work without jawusd. It may import base, geometry, formats and evaluator;
the Blender add-on also uses the names of `rig` that its stubs list.
"""
