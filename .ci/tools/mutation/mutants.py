"""The mutants of a source: each replaces one node of its syntax tree, in the order of the text."""

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice, takewhile

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
_TWIN_FUNCTIONS = [
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
_REPLACED_FUNCTIONS = {
    **dict(_TWIN_FUNCTIONS),
    **{second: first for first, second in _TWIN_FUNCTIONS},
    "round": "int",
    "rint": "floor",
    "sorted": "list",
    "abs": "float",
    "hypot": "add",
}
_UNTOUCHED_ARGUMENTS = {"strict", "dtype", "copy", "encoding"}


@dataclass(frozen=True)
class Mutant:
    """One fault that can be planted.

    Attributes:
        path: Path of the file, relative to the package's folder.
        number: Number of the mutant within its file.
        line: Line of the change.
        span: First and last line of the outermost function around it; None outside of functions.
        change: Old and new code.
        source: Fingerprint of the file, which distinguishes results of another version.
    """

    path: str
    number: int
    line: int
    span: tuple[int, int] | None
    change: str
    source: str

    @property
    def key(self) -> str:
        """Identifier of the mutant of this version of the file."""
        return f"{self.path}:{self.number}:{self.source}"


Change = tuple[ast.AST, Callable[[], None], str]
"""A node, a function that replaces it within its tree, and a description."""


def changes(tree: ast.Module) -> Iterator[Change]:
    """Yield all changes of a tree; each expects the original, so only one may be made."""
    yield from _below(tree)


def mutated(source: str, number: int) -> ast.Module:
    """Return the tree of a source after its change of this number."""
    tree = ast.parse(source)
    _, make_change, _ = next(islice(changes(tree), number, None))
    make_change()
    return ast.fix_missing_locations(tree)


def _below(parent: ast.AST) -> Iterator[Change]:
    """Yield the changes of all nodes below a node."""
    for name, value in ast.iter_fields(parent):
        if _is_untouched(parent, name):
            continue
        is_list = isinstance(value, list)
        for position, node in enumerate(value if is_list else [value]):
            if not isinstance(node, ast.AST) or _is_text(node):
                continue
            for new_node, words in _replacements(node):
                yield node, _setter(parent, name, position if is_list else None, new_node), words
            if not isinstance(node, ast.Raise):
                yield from _below(node)


def _setter(parent: ast.AST, name: str, position: int | None, node: ast.AST) -> Callable[[], None]:
    """Return a function that puts a node into a field of its parent or into a list there."""

    def set_node() -> None:
        if position is None:
            setattr(parent, name, node)
        else:
            getattr(parent, name)[position] = node

    return set_node


def _is_untouched(parent: ast.AST, name: str) -> bool:
    """Return whether a field holds annotations, decorators or imports for types."""
    return name in {"annotation", "returns", "decorator_list", "type_params"} or (
        isinstance(parent, ast.If) and "TYPE_CHECKING" in ast.dump(parent.test)
    )


def _is_text(node: ast.AST) -> bool:
    """Return whether a node is a docstring, an f-string, an import or an assertion."""
    is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_docstring or isinstance(
        node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Assert
    )


def _replacements(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Yield the nodes that a node may become, each with a description of the change."""
    old_text = ast.unparse(node).split("\n")[0]
    for new_node in _others(node):
        new_text = ast.unparse(new_node).split("\n")[0]
        pairs = zip(old_text, new_text, strict=False)
        common_length = len(list(takewhile(lambda pair: pair[0] == pair[1], pairs)))
        begin = max(0, common_length - 25)
        end = begin + 60
        words = f"{old_text[begin:end]} → {new_text[begin:end]}"
        yield ast.copy_location(new_node, node), words


def _others(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that a node may become."""
    mutate = _MUTATIONS_BY_TYPE.get(type(node))
    if mutate is not None:
        yield from mutate(node)
    if isinstance(node, ast.If | ast.While | ast.IfExp) and isinstance(
        node.test, ast.Name | ast.Call | ast.Attribute
    ):
        yield _with(node, test=ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.comprehension) and node.ifs:
        yield _with(node, ifs=[])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    """Return a copy of a node with other fields; the nodes below are shared."""
    changed_node = copy.copy(node)
    for name, value in fields.items():
        setattr(changed_node, name, value)
    return changed_node


def _compare(node: ast.Compare) -> Iterator[ast.AST]:
    for position, operator in enumerate(node.ops):
        for other_operator in _COMPARISONS[type(operator)]:
            operators = [*node.ops]
            operators[position] = other_operator()
            yield _with(node, ops=operators)


def _binary(node: ast.BinOp | ast.AugAssign) -> Iterator[ast.AST]:
    if isinstance(node.op, ast.MatMult) and isinstance(node, ast.BinOp):
        yield _with(node, left=node.right, right=node.left)
    elif type(node.op) in _ARITHMETIC:
        yield _with(node, op=_ARITHMETIC[type(node.op)]())


def _augmented(node: ast.AugAssign) -> Iterator[ast.AST]:
    yield from _binary(node)
    yield ast.Pass()


def _logic(node: ast.BoolOp) -> Iterator[ast.AST]:
    other_operator = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    yield _with(node, op=other_operator)


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
    if name in _REPLACED_FUNCTIONS:
        field = "attr" if isinstance(node.func, ast.Attribute) else "id"
        yield _with(node, func=_with(node.func, **{field: _REPLACED_FUNCTIONS[name]}))
    if name[:1].isupper() or name == "cls":  # most arguments of a record have no default
        return
    for position, keyword in enumerate(node.keywords):
        if keyword.arg and keyword.arg not in _UNTOUCHED_ARGUMENTS:
            yield _with(node, keywords=node.keywords[:position] + node.keywords[position + 1 :])


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


_MUTATIONS_BY_TYPE: dict[type[ast.AST], Callable[..., Iterator[ast.AST]]] = {
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
