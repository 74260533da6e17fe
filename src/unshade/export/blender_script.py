"""The part of a Blender script that is the same for every tree: Python arithmetic that builds nodes.

The formulas of `formulas.SOURCE` stand below it in the script as they are; each becomes a node group.
"""

from __future__ import annotations

RUNTIME = '''
import base64
import inspect
import os
import sys
import tempfile

import bpy

building = None  # the node tree that arithmetic adds to


class Value:
    """An output socket. Arithmetic with it adds nodes; numbers and tuples are constants."""

    def __init__(self, socket, kind):
        self.socket, self.kind = socket, kind

    def __add__(self, other): return operate("ADD", self, other)
    def __radd__(self, other): return operate("ADD", other, self)
    def __sub__(self, other): return operate("SUBTRACT", self, other)
    def __rsub__(self, other): return operate("SUBTRACT", other, self)
    def __mul__(self, other): return operate("MULTIPLY", self, other)
    def __rmul__(self, other): return operate("MULTIPLY", other, self)
    def __truediv__(self, other): return operate("DIVIDE", self, other)
    def __rtruediv__(self, other): return operate("DIVIDE", other, self)
    def __neg__(self): return operate("MULTIPLY", self, -1.0)

    @property
    def x(self): return part(self, 0)
    @property
    def y(self): return part(self, 1)
    @property
    def z(self): return part(self, 2)


def add(kind, *values, output=0, **settings):
    """A node with its inputs, and its output."""
    node = building.nodes.new(kind)
    for name, setting in settings.items():
        setattr(node, name, setting)
    for value, socket in zip(values, node.inputs):
        if isinstance(value, Value):
            building.links.new(value.socket, socket)
        elif isinstance(value, tuple) or socket.type == "VALUE":
            socket.default_value = value
        else:
            socket.default_value = (value, value, value)
    return node.outputs[output]


def is_vector(value):
    return isinstance(value, tuple) or isinstance(value, Value) and value.kind == "vec3"


def operate(name, *values):
    if any(map(is_vector, values)):
        return Value(add("ShaderNodeVectorMath", *values, operation=name), "vec3")
    return Value(add("ShaderNodeMath", *values, operation=name), "float")


def scalar(name, *values):
    return Value(add("ShaderNodeMath", *values, operation=name), "float")


def part(value, k):
    if isinstance(value, tuple):
        return value[k]
    # One node for all three parts of a socket.
    for link in value.socket.links:
        if link.to_node.bl_idname == "ShaderNodeSeparateXYZ":
            return Value(link.to_node.outputs[k], "float")
    return Value(add("ShaderNodeSeparateXYZ", value, output=k), "float")


def vec3(*values):
    if len(values) == 1:
        values *= 3
    if not any(isinstance(value, Value) for value in values):
        return tuple(values)
    return Value(add("ShaderNodeCombineXYZ", *values), "vec3")


def dot(a, b): return Value(add("ShaderNodeVectorMath", a, b, operation="DOT_PRODUCT", output=1), "float")
def cross(a, b): return Value(add("ShaderNodeVectorMath", a, b, operation="CROSS_PRODUCT"), "vec3")
def normalize(a): return Value(add("ShaderNodeVectorMath", a, operation="NORMALIZE"), "vec3")
def length(a): return Value(add("ShaderNodeVectorMath", a, operation="LENGTH", output=1), "float")
def max(a, b): return operate("MAXIMUM", a, b)
def min(a, b): return operate("MINIMUM", a, b)
def clamp(a, low, high): return min(max(a, low), high)
def mix(a, b, share): return a + share * (b - a)
def step(edge, a): return scalar("GREATER_THAN", a, edge)
def abs(a): return scalar("ABSOLUTE", a)
def exp(a): return scalar("EXPONENT", a)
def pow(a, b): return scalar("POWER", a, b)
def cos(a): return scalar("COSINE", a)
def sin(a): return scalar("SINE", a)
def acos(a): return scalar("ARCCOSINE", a)
def atan2(a, b): return scalar("ARCTAN2", a, b)


def sample(picture, place):
    """A packed picture; rows run upwards in Blender."""
    flipped = vec3(place.x, 1.0 - place.y, 0.0)
    return Value(add("ShaderNodeTexImage", flipped, image=picture, interpolation="Linear", extension="REPEAT"), "vec3")


def picture(name, png):
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, name + ".png")
        with open(path, "wb") as file:
            file.write(base64.b64decode(png))
        image = bpy.data.images.load(path)
        image.colorspace_settings.name = "Non-Color"
        image.pack()
    image.name = name
    return image


def arrange(tree):
    """Nodes in columns, each right of all that it takes from."""
    column = {}

    def find(node):
        if node not in column:
            column[node] = 0
            column[node] = 1 + builtins_max([find(link.from_node) for s in node.inputs for link in s.links], default=-1)
        return column[node]

    rows = {}
    for node in tree.nodes:
        k = find(node)
        node.location = (220 * k, -190 * rows.get(k, 0))
        rows[k] = rows.get(k, 0) + 1


builtins_max = __builtins__["max"] if isinstance(__builtins__, dict) else __builtins__.max


def nodes_of(name, inputs, result, build):
    """A node group: build gets its inputs as values. Inputs are (name, type of value)."""
    global building
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    for label, kind in inputs:
        tree.interface.new_socket(label, in_out="INPUT", socket_type="NodeSocketFloat" if kind == "float" else "NodeSocketVector")
    tree.interface.new_socket("Result", in_out="OUTPUT", socket_type="NodeSocketFloat" if result == "float" else "NodeSocketVector")
    outside, building = building, tree
    given = tree.nodes.new("NodeGroupInput")
    found = build(*(Value(socket, kind) for socket, (_, kind) in zip(given.outputs, inputs)))
    tree.links.new(found.socket, tree.nodes.new("NodeGroupOutput").inputs[0])
    arrange(tree)
    building = outside
    return tree


def group(function):
    """A formula as a node group; calling it then adds that group."""
    types = [(name, "float" if entry.annotation is float else "vec3") for name, entry in inspect.signature(function).parameters.items()]
    result = "float" if inspect.signature(function).return_annotation is float else "vec3"
    tree = nodes_of("unshade " + function.__name__, types, result, function)

    def call(*values):
        return Value(add("ShaderNodeGroup", *values, node_tree=tree), result)

    return call
'''

SCENE = '''
def view():
    """The normal as the camera sees it; Blender's camera looks along +z here."""
    def build():
        geometry = building.nodes.new("ShaderNodeNewGeometry")
        turned = []
        for name, kind in (("Normal", "NORMAL"), ("Incoming", "VECTOR")):
            spaces = {"vector_type": kind, "convert_from": "WORLD", "convert_to": "CAMERA"}
            turn = add("ShaderNodeVectorTransform", Value(geometry.outputs[name], "vec3"), **spaces)
            turned.append(normalize(Value(turn, "vec3") * (1.0, 1.0, -1.0)))
        return seen(*turned)
    return nodes_of("unshade view", [], "vec3", build)


def material():
    """An emission of the tree's colour: show it with the view transform Standard."""
    global building
    made = bpy.data.materials.new("unshade")
    if made.node_tree is None:  # before Blender 5
        made.use_nodes = True
    building = made.node_tree
    building.nodes.clear()
    normal = Value(add("ShaderNodeGroup", node_tree=view()), "vec3")
    tree = add("ShaderNodeGroup", normal, node_tree=unshade)
    emission = add("ShaderNodeEmission", Value(tree, "vec3"))
    building.links.new(emission, building.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    arrange(building)
    return made


def scene(path):
    """A file with a sphere that has the material, and a camera before it."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=256, ring_count=128)
    sphere = bpy.context.object
    sphere.data.materials.append(made)
    sphere.data.shade_smooth()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 2.0, (0.0, -4.0, 0.0)
    camera.rotation_euler = (1.5707963267948966, 0.0, 0.0)
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.scene.view_settings.view_transform = "Standard"
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 512
    bpy.ops.wm.save_as_mainfile(filepath=path, check_existing=False)


made = material()
if "--" in sys.argv:
    scene(sys.argv[sys.argv.index("--") + 1])
'''
