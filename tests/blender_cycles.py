"""Runs in Blender: node groups of exported scripts, rendered by Cycles on the CPU. FOLDER SIZE, for FOLDER/*.py and *.blend.

Each script's group is shown on a plane that gives it the normals of the sphere, exact at every pixel; a .blend is rendered as it is.
"""

import sys
from pathlib import Path

import bpy

SOURCE = """
def sphere_normals(group):
    place = Value(building.nodes.new("ShaderNodeNewGeometry").outputs["Position"], "vec3")
    x, y = place.x, place.y
    radius = max(length(vec3(x, y, 0.0)), 1.0)
    x, y = x / radius, y / radius
    z = pow(max(1.0 - x * x - y * y, 0.0), 0.5)
    tree = add("ShaderNodeGroup", vec3(x, y, z), node_tree=group)
    emission = add("ShaderNodeEmission", Value(tree, "vec3"))
    building.links.new(emission, building.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])

material = bpy.data.materials.new("check")
building = material.node_tree
building.nodes.clear()
sphere_normals(unshade)
"""


def draw(path: Path, size: int) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 1
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 0.01
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_depth = "16"
    scene.render.dither_intensity = 0.0
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def plane() -> bpy.types.Object:
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.mesh.primitive_plane_add(size=4.0)
    found = bpy.context.object
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.0, (0.0, 0.0, 4.0)
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return found


def main() -> None:
    folder, size = Path(sys.argv[-2]), int(sys.argv[-1])
    shape = plane()
    for script in sorted(folder.glob("*.py")):
        space: dict = {"__name__": "tree", "__builtins__": __builtins__}
        exec(compile(script.read_text(encoding="utf-8"), script.name, "exec"), space)
        exec(SOURCE, space)
        shape.data.materials.clear()
        shape.data.materials.append(space["material"])
        draw(folder / f"{script.stem}.png", size)
    for file in sorted(folder.glob("*.blend")):
        bpy.ops.wm.open_mainfile(filepath=str(file))
        draw(folder / f"{file.stem}.png", size)


if __name__ == "__main__":
    main()
