"""Compiled code may use only operations whose result IEEE 754 fixes, in an order that we fix."""

import ast
import re

import pytest

from tests.chsel.samples import kernel_files

SOURCES = kernel_files()
ALLOWED_IN_MATH = {"sqrt", "floor", "ceil", "isfinite", "inf", "pi"}
ALLOWED_IN_MATH |= {"factorial", "prod"}  # constants, and sizes of arrays
FORBIDDEN_IN_NUMPY = re.compile(
    "exp|exp2|expm1|log|log2|log10|log1p|logaddexp|sin|cos|tan|arc(sin|cos|tan)h?|arctan2"
    "|a(sin|cos|tan)h?|atan2|sinh|cosh|tanh|power|pow|float_power|hypot|cbrt|dot|vdot|inner|matmul"
    "|tensordot|einsum|linalg|(nan)?(sum|mean|std|var|prod)|average|trace|cumsum|random"
)
FORBIDDEN_METHODS = {"dot", "sum", "mean", "std", "var", "prod", "trace", "cumsum"}
COMPILED = {"compiled", "inner", "leaf", "spliced"}


def findings(source, *, everywhere=True):
    """What a file uses and must not, as "line: what"; everywhere: numpy outside of kernels, too."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    kernels = [node for node in nodes if isinstance(node, ast.FunctionDef) and _is_kernel(node)]
    compiled = {node for kernel in kernels for node in ast.walk(kernel)}
    modules = {}
    integers = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            modules |= {alias.asname or alias.name: alias.name for alias in node.names}
    for line in tree.body:
        if isinstance(line, ast.Assign) and _is_integer(line.value):
            integers |= {name.id for name in line.targets if isinstance(name, ast.Name)}

    def used(node):
        """What of other modules, of operators and of options a node uses, as far as forbidden."""
        match node:
            case ast.ImportFrom(module=str(module)):
                names = [f"{module}.{alias.name}" for alias in node.names]
            case ast.Attribute(value=ast.Name(id=name)) if name in modules:
                names = [f"{modules[name]}.{node.attr}"]
            case ast.Call(func=ast.Attribute(value=value, attr=method)):
                of_module = isinstance(value, ast.Name) and value.id in modules
                is_summed = method in FORBIDDEN_METHODS and node in compiled and not of_module
                return [f".{method}()"] if is_summed else []
            case ast.Name(id="pow") | ast.Name(id="sum"):
                return [node.id] if node.id == "pow" or node in compiled else []
            case ast.BinOp(op=ast.MatMult()) | ast.AugAssign(op=ast.MatMult()):
                return ["@"]
            case ast.BinOp(op=ast.Pow(), right=power) | ast.AugAssign(op=ast.Pow(), value=power):
                named = isinstance(power, ast.Name) and power.id in integers
                return [] if named or _is_integer(power) else [f"** {ast.unparse(power)}"]
            case ast.keyword(arg="fastmath" | "parallel", value=value):
                return [] if isinstance(value, ast.Constant) and not value.value else [node.arg]
            case _:
                return []
        return [name for name in names if _is_forbidden(name, everywhere or node in compiled)]

    return [f"{getattr(node, 'lineno', 0)}: {what}" for node in nodes for what in used(node)]


def _is_kernel(function):
    return not COMPILED.isdisjoint(map(ast.unparse, function.decorator_list))


def _is_forbidden(name, in_kernel):
    package, first, *_ = [*name.split("."), ""]
    in_numpy = package == "numpy" and in_kernel and FORBIDDEN_IN_NUMPY.fullmatch(first)
    return in_numpy or package == "cmath" or (package == "math" and first not in ALLOWED_IN_MATH)


def _is_integer(exponent):
    if isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub):
        exponent = exponent.operand
    return isinstance(exponent, ast.Constant) and type(exponent.value) is int


@pytest.mark.parametrize("path", SOURCES, ids=[path.name for path in SOURCES])
def test_kernels_use_allowed_arithmetic_alone(path):
    kernels_alone = path.parent.name == "numerics" or path.stem.endswith("_kernels")
    assert findings(path.read_text(), everywhere=kernels_alone) == []
