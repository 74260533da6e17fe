"""Programs as text: one printer for all shading languages, and what each must say in its own words."""

from __future__ import annotations

import ast
import base64
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from unshade.export.formulas import Function
from unshade.export.program import Picture, Program, Space, Uniform
from unshade.rasters import raster_to_png

_PRECEDENCE = {ast.Add: 1, ast.Sub: 1, ast.Mult: 2, ast.Div: 2}
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_UNARY = 3


@dataclass(frozen=True)
class Language:
    """The words of a shading language. Templates take the names in braces."""

    types: Mapping[str, str] = field(default_factory=lambda: {"float": "float", "vec3": "vec3"})
    words: Mapping[str, str] = field(default_factory=dict)
    """Functions that have another name here."""
    function: str = "{type} {name}({parameters}) {{"
    parameter: str = "{type} {name}"
    statement: str = "{type} {name} = {value};"
    splat: str = "vec3({value})"
    """Three times the same number."""
    sample: str = "texture({picture}, {place}.xy).rgb"
    uniform: str = "{name}"
    """How the tree's function names a uniform."""
    vector: str = ""
    """The same of a direction or a rotation, where it is another."""
    color: str = ""
    """The same of a colour, where that needs a conversion."""
    comment: str = "// {text}"

    def constant_vector(self, values: Iterable[float]) -> str:
        """A constant vector."""
        return f"{self.types['vec3']}({', '.join(number(value) for value in values)})"

    def constant(self, uniform: Uniform) -> str:
        """The value of a uniform in the tree."""
        return number(uniform.value[0]) if uniform.type == "float" else self.constant_vector(uniform.value)


def number(value: float) -> str:
    """A number with a point, exact in single precision."""
    text = f"{value:.9g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


class Printer:
    """Prints functions of `formulas` in one language."""

    def __init__(self, language: Language, uniforms: Mapping[str, str] | None = None) -> None:
        self.language = language
        self.uniforms = uniforms or {}
        """How names that stand outside of the functions are printed."""

    def function(self, function: Function, comments: Iterable[str] = (), extra: Iterable[str] = ()) -> str:
        """A whole function; ``comments`` stand over its statements, ``extra`` are further parameters, printed already."""
        language = self.language
        named = [language.parameter.format(type=language.types[kind], name=name) for name, kind in function.parameters]
        head = language.function.format(type=language.types[function.result], name=function.name, parameters=", ".join([*named, *extra]))
        lines = [language.comment.format(text=function.summary)] * bool(function.summary) + [head]
        notes = iter(comments)
        for name, kind, value in function.statements:
            note = next(notes, "")
            lines += ["    " + language.comment.format(text=note)] * bool(note)
            lines.append("    " + language.statement.format(type=language.types[kind], name=name, value=self.text(value)))
        return "\n".join([*lines, f"    return {self.text(function.value)};", "}"])

    def text(self, node: ast.expr, outer: int = 0) -> str:
        """An expression; ``outer`` says how tightly what stands around it binds."""
        match node:
            case ast.Constant(value=float(value)):
                return number(value)
            case ast.Name(id=name):
                return self.uniforms.get(name, name)
            case ast.Attribute(value=value, attr=part):
                return f"{self.text(value, _UNARY)}.{part}"
            case ast.UnaryOp(operand=operand):
                return f"-{self.text(operand, _UNARY)}"
            case ast.BinOp(left=left, op=op, right=right):
                binds = _PRECEDENCE[type(op)]
                joined = f"{self.text(left, binds)} {_SIGNS[type(op)]} {self.text(right, binds + 1)}"
                return f"({joined})" if binds < outer else joined
            case ast.Call(func=ast.Name(id=name), args=arguments):
                return self.call(name, arguments)
        raise AssertionError(ast.dump(node))

    def call(self, name: str, arguments: list[ast.expr]) -> str:
        """A call of a function of `formulas` or of the language."""
        texts = [self.text(argument) for argument in arguments]
        if name == "sample":
            return self.language.sample.format(picture=texts[0], place=texts[1])
        if name == "vec3" and len(texts) == 1:
            return self.language.splat.format(value=texts[0])
        known = self.language.types.get(name) or self.language.words.get(name, name)
        return f"{known}({', '.join(texts)})"


def parts(program: Program, language: Language, space: Space, *others: str, extra: Iterable[str] = ()) -> tuple[list[str], str]:
    """The functions that a program calls, and its own; ``others`` are functions that the frame around it calls."""
    printer = Printer(language)
    main = Printer(language, {item.name: _read(item, language) for item in program.uniforms})
    functions = [printer.function(function) for function in program.functions(space, *others)]
    comments = [statement.comment for statement in program.statements]
    return functions, main.function(program.main(space), comments, extra)


def printed(program: Program, language: Language, space: Space, *others: str, extra: Iterable[str] = ()) -> str:
    """`parts` as one text."""
    functions, main = parts(program, language, space, *others, extra=extra)
    return "\n\n".join([*functions, main]) + "\n"


def _read(uniform: Uniform, language: Language) -> str:
    special = language.color if uniform.is_color else language.vector if uniform.type == "vec3" else ""
    return (special or language.uniform).format(name=uniform.name)


def picture_comments(pictures: Iterable[Picture], language: Language) -> Iterator[str]:
    """Each picture as a PNG in a comment, since text can hold it no other way."""
    for picture in pictures:
        data = base64.b64encode(raster_to_png(picture.raster)).decode("ascii")
        yield language.comment.format(text=f"{picture.name}: data:image/png;base64,{data}")
