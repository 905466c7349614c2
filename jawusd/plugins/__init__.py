"""Code that runs inside other programs: a Blender add-on, a reader, and recipes for Maya, Houdini and Unreal."""
