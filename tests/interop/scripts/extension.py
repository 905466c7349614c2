"""Install the extension from its zip like "Install from Disk", in separate folders, inside Blender's Python."""

import importlib
import os

import bpy


def install(archive, folder):
    """Install and enable the extension; return its module."""
    repository = os.path.join(folder, "extensions")
    os.makedirs(repository, exist_ok=True)
    repositories = bpy.context.preferences.extensions.repos
    for found in list(repositories):
        repositories.remove(found)
    made = repositories.new(name="Test", module="test_repository", custom_directory=repository)
    bpy.ops.extensions.package_install_files(filepath=archive, repo=made.module, enable_on_install=True)
    return importlib.import_module(f"bl_ext.{made.module}.jawusd_blender")
