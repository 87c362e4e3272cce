"""The mutants of a source: each is one replaced node of its syntax tree, in the order of the
text.
"""

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import takewhile

_COMPARISONS = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_TWINS = [
    ("min", "max"),
    ("any", "all"),
    ("floor", "ceil"),
    ("argmin", "argmax"),
    ("minimum", "maximum"),
    ("sin", "cos"),
    ("zeros", "ones"),
    ("union1d", "intersect1d"),
    ("logical_and", "logical_or"),
]
_OTHER_NAME = {one: other for pair in _TWINS for one, other in (pair, pair[::-1])} | {
    "round": "int",
    "rint": "floor",
    "sorted": "list",
    "abs": "float",
    "hypot": "add",
}
_KEPT_ARGUMENTS = {"strict", "dtype", "copy", "encoding"}


@dataclass(frozen=True)
class Mutant:
    """One fault that can be planted.

    Attributes:
        path: of the file, below the package's folder.
        number: which of the file's mutants.
        line: where it is.
        span: first and last line of the outermost function around it; None outside of functions.
        change: what is replaced by what.
        source: fingerprint of the file, by which results of another text are told.
    """

    path: str
    number: int
    line: int
    span: tuple[int, int] | None
    change: str
    source: str

    @property
    def key(self) -> str:
        return f"{self.path}:{self.number}:{self.source}"


Change = tuple[ast.AST, Callable[[], None], str]
"""The node, what replaces it in its tree, and in words."""


def changes(tree: ast.Module) -> Iterator[Change]:
    """All changes of a tree; each is of the tree as it is, so that one alone may be made."""
    yield from _below(tree)


def mutated(source: str, number: int) -> ast.Module:
    """The tree of a source with its change of that number made."""
    tree = ast.parse(source)
    next(change for at, change in enumerate(changes(tree)) if at == number)[1]()
    return ast.fix_missing_locations(tree)


def _below(parent: ast.AST) -> Iterator[Change]:
    for name, value in ast.iter_fields(parent):
        if _is_left_alone(parent, name):
            continue
        for at, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or _is_text(node):
                continue
            for new, words in _replacements(node):
                yield (
                    node,
                    _setting(parent, name, at if isinstance(value, list) else None, new),
                    words,
                )
            if not isinstance(node, ast.Raise):
                yield from _below(node)


def _setting(parent: ast.AST, name: str, at: int | None, new: ast.AST) -> Callable[[], None]:
    def change() -> None:
        if at is None:
            setattr(parent, name, new)
        else:
            getattr(parent, name)[at] = new

    return change


def _is_left_alone(parent: ast.AST, name: str) -> bool:
    return name in {"annotation", "returns", "decorator_list", "type_params"} or (
        isinstance(parent, ast.If) and "TYPE_CHECKING" in ast.dump(parent.test)
    )


def _is_text(node: ast.AST) -> bool:
    lone = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return lone or isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Assert)


def _replacements(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """What a node may become, and in words."""
    for new in _others(node):
        here, there = (ast.unparse(each).split("\n")[0] for each in (node, new))
        same = takewhile(lambda pair: pair[0] == pair[1], zip(here, there, strict=False))
        begin = max(0, len([*same]) - 25)
        yield (
            ast.copy_location(new, node),
            f"{here[begin : begin + 60]} → {there[begin : begin + 60]}",
        )


def _others(node: ast.AST) -> Iterator[ast.AST]:
    made = _BY_TYPE.get(type(node))
    if made is not None:
        yield from made(node)
    if isinstance(node, ast.If | ast.While | ast.IfExp) and isinstance(
        node.test, ast.Name | ast.Call | ast.Attribute
    ):
        yield _with(node, test=ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.comprehension) and node.ifs:
        yield _with(node, ifs=[])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    """A node like this one, but for some fields; what lies below is shared, since only one change
    is made.
    """
    new = copy.copy(node)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def _compare(node: ast.Compare) -> Iterator[ast.AST]:
    for at, operation in enumerate(node.ops):
        for other in _COMPARISONS[type(operation)]:
            yield _with(node, ops=[*node.ops[:at], other(), *node.ops[at + 1 :]])


def _binary(node: ast.BinOp | ast.AugAssign) -> Iterator[ast.AST]:
    if isinstance(node.op, ast.MatMult) and isinstance(node, ast.BinOp):
        yield _with(node, left=node.right, right=node.left)
    elif type(node.op) in _ARITHMETIC:
        yield _with(node, op=_ARITHMETIC[type(node.op)]())


def _augmented(node: ast.AugAssign) -> Iterator[ast.AST]:
    yield from _binary(node)
    yield ast.Pass()


def _logic(node: ast.BoolOp) -> Iterator[ast.AST]:
    yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())


def _sign(node: ast.UnaryOp) -> Iterator[ast.AST]:
    yield node.operand


def _constant(node: ast.Constant) -> Iterator[ast.AST]:
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int):
        yield ast.Constant(value + 1)
        if value:
            yield ast.Constant(value - 1)
    elif isinstance(value, float):
        yield ast.Constant(2 * value if value else 1.0)


def _call(node: ast.Call) -> Iterator[ast.AST]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in _OTHER_NAME:
        field = "attr" if isinstance(node.func, ast.Attribute) else "id"
        yield _with(node, func=_with(node.func, **{field: _OTHER_NAME[name]}))
    if name[:1].isupper() or name == "cls":  # most of what a record is made with has no default
        return
    for at, keyword in enumerate(node.keywords):
        if keyword.arg and keyword.arg not in _KEPT_ARGUMENTS:
            yield _with(node, keywords=node.keywords[:at] + node.keywords[at + 1 :])


def _returned(node: ast.Return) -> Iterator[ast.AST]:
    if node.value is not None and not isinstance(node.value, ast.Constant):
        yield _with(node, value=ast.Constant(None))


def _left_out(node: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, ast.Expr) and not isinstance(node.value, ast.Call):
        return
    if isinstance(node, ast.Assign) and not isinstance(
        node.targets[0], ast.Subscript | ast.Attribute
    ):
        return
    yield ast.Pass()


_BY_TYPE: dict[type[ast.AST], Callable[..., Iterator[ast.AST]]] = {
    ast.Compare: _compare,
    ast.BinOp: _binary,
    ast.AugAssign: _augmented,
    ast.BoolOp: _logic,
    ast.UnaryOp: _sign,
    ast.Constant: _constant,
    ast.Call: _call,
    ast.Return: _returned,
    ast.Expr: _left_out,
    ast.Assign: _left_out,
    ast.Raise: _left_out,
    ast.Break: lambda _: iter([ast.Continue()]),
    ast.Continue: lambda _: iter([ast.Break()]),
}
