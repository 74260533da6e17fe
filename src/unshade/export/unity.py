"""Unity: a ShaderLab file with HLSL, every parameter in the inspector with its range, for gamma and linear colour."""

from __future__ import annotations

import re
from pathlib import Path

from unshade.export.program import Program, Uniform, program
from unshade.export.shader_text import Language, number, picture_comments, printed
from unshade.nodes import Tree

HLSL = Language(
    types={"float": "float", "vec3": "float3"},
    words={"mix": "lerp"},
    splat="(float3)({value})",
    sample="_{picture}.SampleLevel(sampler_{picture}, float2(0.0, 1.0) + float2(1.0, -1.0) * {place}.xy, 0.0).rgb",
    uniform="_{name}",
    vector="_{name}.xyz",
    color="UNSHADE_COLOR(_{name})",
)

FRAME = """\
// Made by unshade. Unity turns picked colours into linear light in projects with linear colour, so the tree converts at both ends.
Shader "unshade/tree"
{
    Properties
    {
%(properties)s
    }
    SubShader
    {
        Tags { "RenderType" = "Opaque" }
        Pass
        {
            HLSLPROGRAM
            #pragma vertex vertex
            #pragma fragment fragment
            #include "UnityCG.cginc"

%(code)s
            ENDHLSL
        }
    }
}
"""

SPACES = {
    "srgb": ("(c).rgb", "encode_color((c).rgb)", "color", "decode_color(color)"),
    "linear": ("decode_color((c).rgb)", "(c).rgb", "encode_color(color)", "color"),
}
"""How a tree reads a colour and gives its own: in a gamma project, in a linear one, then the same for what it gives."""

MACROS = """\
#ifdef UNITY_COLORSPACE_GAMMA
#define UNSHADE_COLOR(c) {0}
#define UNSHADE_SHOWN(color) {2}
#else
#define UNSHADE_COLOR(c) {1}
#define UNSHADE_SHOWN(color) {3}
#endif
"""

STAGES = """
struct Varyings
{
    float4 position : SV_Position;
    float3 normal : TEXCOORD0;
    float3 to_eye : TEXCOORD1;
};

Varyings vertex(float4 position : POSITION, float3 normal : NORMAL)
{
    Varyings found;
    float3 place = mul(UNITY_MATRIX_V, mul(unity_ObjectToWorld, position)).xyz;
    found.position = UnityObjectToClipPos(position);
    found.normal = mul((float3x3)UNITY_MATRIX_V, mul(normal, (float3x3)unity_WorldToObject));
    found.to_eye = unity_OrthoParams.w > 0.5 ? float3(0.0, 0.0, 1.0) : -place;
    return found;
}

float4 fragment(Varyings found) : SV_Target
{
    float3 color = unshade(seen(normalize(found.normal), normalize(found.to_eye)));
    return float4(UNSHADE_SHOWN(color), 1.0);
}
"""


def _property(uniform: Uniform, made: Program) -> str:
    label = f'_{uniform.name} ("{uniform.leaf} {uniform.label}"'
    if uniform.is_color:
        return f"{label}, Color) = ({', '.join(number(value) for value in made.picked(uniform, 'srgb'))}, 1.0)"
    if uniform.type == "vec3":
        return f"{label}, Vector) = ({', '.join(number(value) for value in uniform.value)}, 0.0)"
    slider = "[PowerSlider(4.0)] " if uniform.parameter.logarithmic else ""
    return f"{slider}{label}, Range({number(uniform.parameter.low)}, {number(uniform.parameter.high)})) = {number(uniform.value[0])}"


def properties(made: Program) -> list[str]:
    """The lines of the inspector."""
    lines = []
    for _, uniforms in made.by_leaf():
        lines.append(f"[Header({re.sub(r'[^A-Za-z0-9 ]+', ' ', uniforms[0].leaf).strip() or 'leaf'})]")
        lines += [_property(uniform, made) for uniform in uniforms]
    return lines + [f'[NoScaleOffset] _{picture.name} ("{picture.name.replace("_", " ")}", 2D) = "white" {{}}' for picture in made.pictures]


def hlsl(made: Program) -> str:
    """The HLSL inside: parameters, functions, and the two stages."""
    lines = ["CBUFFER_START(UnityPerMaterial)"]
    for address, uniforms in made.by_leaf():
        lines.append(f"    // {address}")
        for uniform in uniforms:
            kind = "float" if uniform.type == "float" else "float4"
            lines.append(f"    {kind} _{uniform.name};  // {uniform.summary}")
    lines += ["CBUFFER_END", ""]
    for picture in made.pictures:
        lines.append(f"// {picture.address}: bilinear, repeating, not sRGB; the PNG is at the end of this file")
        lines += [f"Texture2D _{picture.name};", f"SamplerState sampler_{picture.name};"]
    text = printed(made, HLSL, made.space, "encode_color", "decode_color", "seen")
    return "\n".join([*lines, MACROS.format(*SPACES[made.space]), text + STAGES])


def unity(made: Program) -> str:
    """The text of a .shader file."""
    shown = FRAME % {"properties": _indented(properties(made), 8), "code": _indented(hlsl(made).splitlines(), 12)}
    return shown + "".join(f"{line}\n" for line in picture_comments(made.pictures, HLSL))


def _indented(lines: list[str], spaces: int) -> str:
    return "\n".join(" " * spaces + line if line else "" for line in lines)


def write(tree: Tree, path: Path) -> None:
    """Write a .shader."""
    path.write_text(unity(program(tree)), encoding="utf-8")
