"""Runs in Blender: MatCaps as its Workbench shows them on a sphere. FOLDER SIZE, for FOLDER/*.exr and FOLDER/*.png.

Writes FOLDER/shown/NAME.png for each; Workbench draws with OpenGL, so that there must be a display, which may be Xvfb.
"""

import sys
from pathlib import Path

import bpy


def sphere() -> None:
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=256, ring_count=128)
    bpy.ops.object.shade_smooth()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.0, (0.0, 0.0, 4.0)
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera


def main() -> None:
    folder, size = Path(sys.argv[-2]), int(sys.argv[-1])
    sphere()
    scene, shading = bpy.context.scene, bpy.context.scene.display.shading
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.display.render_aa = "OFF"
    shading.color_type, shading.single_color = "SINGLE", (1.0, 1.0, 1.0)
    shading.show_cavity = shading.show_object_outline = shading.show_shadows = False
    shading.show_specular_highlight = True
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_depth = "16"
    scene.render.dither_intensity = 0.0
    for file in sorted(path for path in folder.iterdir() if path.suffix in (".exr", ".png")):
        light = bpy.context.preferences.studio_lights.load(str(file), "MATCAP")
        shading.light = "MATCAP"
        shading.studio_light = light.name
        scene.render.filepath = str(folder / "shown" / f"{file.stem}.png")
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
