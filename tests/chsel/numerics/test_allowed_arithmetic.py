"""Compiled code may use only operations whose result IEEE 754 fixes, in an order that we fix."""

import ast
import re

import pytest

from tests.chsel.kernel_files import kernel_files

SOURCES = kernel_files()
ALLOWED_IN_MATH = {"sqrt", "floor", "ceil", "isfinite", "inf", "pi"}
ALLOWED_IN_MATH |= {"factorial", "prod"}  # constants, and sizes of arrays
FORBIDDEN_IN_NUMPY = re.compile(
    "exp|exp2|expm1|log|log2|log10|log1p|logaddexp|sin|cos|tan|arc(sin|cos|tan)h?|arctan2"
    "|a(sin|cos|tan)h?|atan2|sinh|cosh|tanh|power|pow|float_power|hypot|cbrt|dot|vdot|inner|matmul"
    "|tensordot|einsum|linalg|(nan)?(sum|mean|std|var|prod)|average|trace|cumsum|random"
)
FORBIDDEN_METHODS = {"dot", "sum", "mean", "std", "var", "prod", "trace", "cumsum"}
FUNCTION = "BITS = 20\nRATE = 0.5\n@compiled\ndef f(x, y):\n    "
FORBIDDEN_OPTIONS = {"fastmath", "parallel"}
COMPILED = {"compiled", "inner", "leaf", "spliced"}


class Findings(ast.NodeVisitor):
    """Collects what a source file calls that it must not, as "line: what"."""

    def __init__(self, everywhere):
        self._everywhere = everywhere
        self.found = []
        self._modules = {}
        self._integers = set()
        self._compiled = False

    def visit_Module(self, node):
        """Constants of the module that are integers stand for them."""
        for line in node.body:
            if isinstance(line, ast.Assign) and _is_integer(line.value):
                self._integers |= {name.id for name in line.targets if isinstance(name, ast.Name)}
        self.generic_visit(node)

    def _add(self, node, what):
        self.found.append(f"{node.lineno}: {what}")

    def _check(self, node, module, name):
        package, first = module.split(".")[0], [*module.split("."), name][1]
        in_math = package == "math" and name not in ALLOWED_IN_MATH
        in_numpy = package == "numpy" and FORBIDDEN_IN_NUMPY.fullmatch(first)
        in_numpy = in_numpy and (self._compiled or self._everywhere)
        if in_math or in_numpy or package == "cmath":
            self._add(node, f"{module}.{name}")

    def visit_Import(self, node):
        for alias in node.names:
            self._modules[alias.asname or alias.name.split(".")[0]] = (
                alias.name if alias.asname else alias.name.split(".")[0]
            )

    def visit_ImportFrom(self, node):
        for alias in node.names:
            self._check(node, node.module or "", alias.name)

    def visit_FunctionDef(self, node):
        names = [ast.unparse(decorator) for decorator in node.decorator_list]
        outer, self._compiled = self._compiled, bool(COMPILED.intersection(names))
        self.generic_visit(node)
        self._compiled = outer

    def visit_Attribute(self, node):
        module = self._modules.get(node.value.id) if isinstance(node.value, ast.Name) else None
        if module is not None:
            self._check(node, module, node.attr)
        self.generic_visit(node)

    def visit_Call(self, node):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        of_module = isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name)
        of_module = of_module and node.func.value.id in self._modules
        if self._compiled and name in FORBIDDEN_METHODS and not of_module:
            self._add(node, f".{name}()")
        self.generic_visit(node)

    def visit_Name(self, node):
        if node.id == "pow" or (self._compiled and node.id == "sum"):
            self._add(node, node.id)

    def visit_BinOp(self, node):
        self._check_operator(node, node.op, node.right)

    def visit_AugAssign(self, node):
        self._check_operator(node, node.op, node.value)

    def _check_operator(self, node, operator, right):
        if isinstance(operator, ast.MatMult):
            self._add(node, "@")
        named = isinstance(right, ast.Name) and right.id in self._integers
        if isinstance(operator, ast.Pow) and not (named or _is_integer(right)):
            self._add(node, f"** {ast.unparse(right)}")
        self.generic_visit(node)

    def visit_keyword(self, node):
        value = node.value
        off = isinstance(value, ast.Constant) and not value.value
        if node.arg in FORBIDDEN_OPTIONS and not off:
            self._add(value, node.arg)
        self.generic_visit(node)


def _is_integer(exponent):
    if isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub):
        exponent = exponent.operand
    return isinstance(exponent, ast.Constant) and type(exponent.value) is int


def findings(source, *, everywhere=True):
    """What a file uses; of numpy's functions, those inside of kernels alone if not everywhere."""
    visitor = Findings(everywhere)
    visitor.visit(ast.parse(source))
    return visitor.found


@pytest.mark.parametrize("path", SOURCES, ids=[path.name for path in SOURCES])
def test_kernels_use_allowed_arithmetic_alone(path):
    kernels_alone = path.parent.name == "numerics" or path.stem.endswith("_kernels")
    assert findings(path.read_text(), everywhere=kernels_alone) == []


def test_beside_python_code_kernels_alone_are_searched():
    outside = "import numpy as np\ndef f(x):\n    return np.cumsum(x)\n"
    assert findings(outside) == ["3: numpy.cumsum"]
    assert findings(outside, everywhere=False) == []
    inside = outside.replace("def", "@inner\ndef")
    assert findings(inside, everywhere=False) == ["4: numpy.cumsum"]


@pytest.mark.parametrize(
    "line",
    [
        "return math.exp(x)",
        "return math.hypot(x, x)",
        "return m.log(x)",
        "return np.exp(x)",
        "return np.log(x)",
        "return np.sin(x) + 1.0",
        "return np.linalg.norm(x)",
        "return np.dot(x, x)",
        "return x.dot(x)",
        "return x.T.sum()",
        "return sum(x)",
        "return x @ x",
        "return x**0.5",
        "return x**y",
        "return x**RATE",
        "return 2.0 ** (x + 1)",
        "x **= y",
        "return pow(x, 2)",
        "return np.power(x, 2)",
        "from math import cos",
        "from numpy import linalg",
        "from numpy.linalg import norm",
        "return inner_compiled(x, fastmath=True)",
    ],
)
def test_what_is_not_allowed_is_found(line):
    source = f"import math\nimport math as m\nimport numpy as np\n{FUNCTION}{line}\n"
    assert len(findings(source)) == 1


@pytest.mark.parametrize(
    "line",
    [
        "return math.sqrt(x) + math.floor(y) + math.inf",
        "return np.sqrt(x) + np.rint(x) + abs(x)",
        "return x**2 + 2.0**-27 + 2.0**BITS",
        "return strategy.mean[0]",
        "return exp(x) + log(y)",
        "return np.empty(3)",
    ],
)
def test_what_is_allowed_is_not_found(line):
    source = f"import math\nimport math as m\nimport numpy as np\n{FUNCTION}{line}\n"
    assert findings(source) == []
