"""Runs in Blender: says which one it is."""

import bpy

print("THIS IS Blender", bpy.app.version_string)
