"""The small changes of a module that its tests should notice: one operator, number, truth value or statement. Pure.

Changed are comparisons (their limit and their sense), `and` and `or`, arithmetic and bitwise operators, `not` and
minus, conditions without an operator, `min` and `max`, `any` and `all`, truth values, numbers (a whole or tiny one by
one, any other by a tenth), texts that are codes (one word) and not sentences for people, bytes, `break` and `continue`;
calls and assignments to attributes are left out. Not changed is what does not run or only describes: annotations,
decorators, imports, docstrings, log lines.
"""

from __future__ import annotations

import ast
import copy
import re
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator


_TINY: Final = 1e-3
"""A number below this is a tolerance, or zero: a tenth more would mean the same."""
_LIMITS: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
}  # fmt: skip
_SENSES: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OPERATORS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_CALLS: Final = {"min": "max", "max": "min", "any": "all", "all": "any"}
_CODE: Final = re.compile(r"[\w.-]+")
_WITH_TEST: Final = (ast.If, ast.While, ast.IfExp)


class Mutant(NamedTuple):
    """One change: the line, the code there, and its part before and after; `node` and `variant` find it again."""

    line: int
    code: str
    before: str
    after: str
    node: int
    variant: int


def mutants(source: str) -> list[Mutant]:
    """Return every mutant of a module's source."""
    lines = source.splitlines()
    return [
        Mutant(node.lineno, lines[node.lineno - 1].strip(), _text(node), _text(changed), number, variant)
        for number, node in enumerate(_executable(ast.parse(source)))
        for variant, changed in enumerate(_changes(node))
    ]


def mutate(source: str, mutant: Mutant) -> ast.Module:
    """Return the module with this change."""
    tree: ast.AST = ast.parse(source)
    node = list(_executable(tree))[mutant.node]
    changed = list(_changes(node))[mutant.variant]
    mutated = ast.fix_missing_locations(_Replace(node, changed).visit(tree))
    assert isinstance(mutated, ast.Module)
    return mutated


def _text(node: ast.AST) -> str:
    return " ".join(ast.unparse(node).split())


class _Replace(ast.NodeTransformer):
    """Replaces one node by another one."""

    def __init__(self, target: ast.AST, new: ast.AST) -> None:
        self._target, self._new = target, new

    def visit(self, node: ast.AST) -> ast.AST:
        if node is self._target:
            return ast.copy_location(self._new, node)
        visited: ast.AST = self.generic_visit(node)
        return visited


def _executable(tree: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield the statements and expressions that run and decide, from the outside inwards."""
    for node in _parts(tree):
        if _describes(node):
            continue
        if isinstance(node, ast.expr | ast.stmt):
            yield node
        yield from _executable(node)


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the children of a node but for annotations, decorators and the keywords of a class."""
    skipped = {"annotation", "returns", "decorator_list", "type_comment", "type_params"}
    if isinstance(node, ast.ClassDef):
        skipped |= {"bases", "keywords"}
    for name, value in ast.iter_fields(node):
        if name in skipped:
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield part


def _describes(node: ast.AST) -> bool:
    """Return whether a node only imports, documents, names a type or writes a log."""
    match node:
        case ast.Import() | ast.ImportFrom() | ast.Expr(value=ast.Constant()) | ast.JoinedStr():
            return True
        case ast.If(test=ast.Name(id="TYPE_CHECKING")) | ast.Subscript(value=ast.Name(id="Literal" | "Annotated")):
            return True
        case ast.Expr(value=ast.Call(func=ast.Name(id="log_event"))):
            return True
    return False


def _changes(node: ast.expr | ast.stmt) -> Iterator[ast.expr | ast.stmt]:
    """Yield a changed copy of one node for each way in which it can be changed."""
    if isinstance(node, ast.Compare):
        yield from _comparisons(node)
    elif isinstance(node, ast.Constant):
        yield from _constants(node)
    elif isinstance(node, _WITH_TEST) and not isinstance(node.test, ast.Compare | ast.BoolOp | ast.UnaryOp):
        changed = copy.deepcopy(node)
        changed.test = ast.UnaryOp(ast.Not(), changed.test)
        yield changed
    elif isinstance(node, ast.stmt):
        yield from _statements(node)
    else:
        yield from _operators(node)


def _comparisons(node: ast.Compare) -> Iterator[ast.expr]:
    for place, operator in enumerate(node.ops):
        for table in (_LIMITS, _SENSES):
            if type(operator) in table:
                changed = copy.deepcopy(node)
                changed.ops[place] = table[type(operator)]()
                yield changed


def _constants(node: ast.Constant) -> Iterator[ast.expr]:
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int):
        yield ast.Constant(value + 1)
    elif isinstance(value, float):
        yield ast.Constant(value + 1.0 if abs(value) < _TINY else value * 1.1)
    elif isinstance(value, bytes):
        yield ast.Constant(value + b"X")
    elif isinstance(value, str) and _CODE.fullmatch(value):
        yield ast.Constant(value + "X")


def _statements(node: ast.stmt) -> Iterator[ast.stmt]:
    match node:
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Assign(targets=[ast.Attribute()]):
            yield ast.Pass()
        case ast.Assign(targets=[ast.Tuple(elts=[ast.Attribute(), *_])]):
            yield ast.Pass()


def _operators(node: ast.expr) -> Iterator[ast.expr]:
    changed = copy.deepcopy(node)
    match changed:
        case ast.BoolOp():
            changed.op = ast.Or() if isinstance(changed.op, ast.And) else ast.And()
            yield changed
        case ast.BinOp(op=operator) if type(operator) in _OPERATORS:
            changed.op = _OPERATORS[type(operator)]()
            yield changed
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield changed.operand
        case ast.Call(func=ast.Name(id=name)) if name in _CALLS:
            changed.func = ast.Name(_CALLS[name], ast.Load())
            yield changed
