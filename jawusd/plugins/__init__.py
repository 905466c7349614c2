"""Code that runs inside other programs: a Blender add-on, a reader, and recipes for Maya, Houdini and Unreal.

`extension` packages it as files that work without jawusd. May import base, geometry, formats and evaluator; the stubs
of the Blender add-on list the names that it needs from `rig`.
"""
