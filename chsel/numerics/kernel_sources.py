"""The files that machine code is made of, and their digest.

A file is read when it is imported: what is written to it later is not what this process runs.
"""

from __future__ import annotations

import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
from numba.core import types
from numba.core.serialize import dumps

COMPILER = "chsel.numerics.compiler"
_PACKAGE = "chsel"
_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))",
    re.MULTILINE,
)
_config: Any = numba.core.config
_TUPLE: Any = types.BaseTuple
_WORD = re.compile(rb"\w+")
_files: dict[Path, SourceFile] = {}
_replaced: set[Path] = set()


@dataclass(frozen=True)
class SourceFile:
    """A file of Python code as this process has loaded it."""

    name: str  # of the module, dotted
    path: Path
    root: Path  # the folder from which it is imported by that name
    text: bytes

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that differ if the name or the text does."""
        name = f"{self.name}\n".encode()
        return hashlib.blake2b(name + self.text, digest_size=16).digest()

    @cached_property
    def imported(self) -> frozenset[str]:
        """The dotted names of all that it imports, anywhere in it: modules, and what is in them."""
        package = self.name.split(".")
        if self.path.name != "__init__.py":
            package.pop()
        found = set()
        for module, names, modules in _IMPORT.findall(self.text):
            if modules:
                found |= {each.split()[0] for each in modules.decode().split(",") if each.split()}
                continue
            base = module.decode()
            if base.startswith("."):
                dots = len(base) - len(base.lstrip("."))
                base = ".".join([*package[: len(package) + 1 - dots], base.strip(".")]).strip(".")
            found |= {base, *(f"{base}.{word.decode()}" for word in _WORD.findall(names))}
        return frozenset(found)

    @cached_property
    def has_kernels(self) -> bool:
        """Whether it is a kernel file: one that imports the compiler, or the compiler itself."""
        return self.name == COMPILER or COMPILER in self.imported


def kernel_sources() -> list[Path]:
    """The files of this package that hold kernels: the compiler, and those that import it."""
    files = Path(__file__).parents[1].rglob("*.py")
    return sorted(path for path in files if _read(path).has_kernels)


def loaded(function: Callable[..., Any]) -> SourceFile | None:
    """The file of a function that is being defined, or None if there is no such file."""
    path = Path(inspect.unwrap(function).__code__.co_filename)
    try:
        before, now = _files.get(path), path.read_bytes()
    except OSError:
        return None
    if before is not None and before.text != now:
        _replaced.add(path)
    return _read(path)


def code_digest(function: Callable[..., Any], arguments: tuple[types.Type, ...]) -> str | None:
    """Hexadecimal digest of all source that the code of a kernel for types of arguments comes from.

    Of its file and of those with kernels that it imports, directly or through others; of the
    fields of all named tuples among the arguments, and of their files likewise, as a kernel runs
    what `implements` such a model; of the constants of these files, and of numba's options. None
    if code cannot be kept: files that have changed while this process had them, or code that is in
    no file.
    """
    state = hashlib.blake2b(digest_size=16)
    own = _files.get(Path(function.__code__.co_filename))
    if own is None or _replaced:
        return None
    starts = {own, _COMPILER}
    for model in sorted(set(_models(arguments)), key=_full_name):
        state.update(f"{_full_name(model)} {model._fields}\n".encode())
        file = getattr(sys.modules.get(model.__module__), "__file__", None)
        if file and _read(Path(file)).has_kernels:
            starts.add(_read(Path(file)))
    for file in sorted(_closure(starts), key=lambda file: file.name):
        module = sys.modules.get(file.name)
        names = function.__globals__ if file is own else vars(module) if module else {}
        state.update(file.digest + _constants(names).encode())
    state.update(f"{_config.OPT} {_config.BOUNDSCHECK}\n".encode())
    text = f"{own.name}.{function.__qualname__} {function.__code__.co_firstlineno}"
    state.update(f"{text} {signature_text(arguments)}\n".encode())
    state.update(function.__code__.co_code)
    if function.__closure__:
        state.update(dumps(tuple(cell.cell_contents for cell in function.__closure__)))
    return state.hexdigest()


def signature_text(arguments: tuple[types.Type, ...]) -> str:
    """The types of arguments in words that are the same in every process."""
    return ", ".join(_type_text(kind) for kind in arguments)


def _constants(names: dict[str, Any]) -> str:
    """The numbers among a module's names, which kernels take as constants, as they are now."""
    numbers = [(name, value) for name, value in names.items() if isinstance(value, int | float)]
    return repr(sorted(numbers))


def _type_text(kind: Any) -> str:
    if not isinstance(kind, _TUPLE):
        return repr(kind)
    name = _full_name(kind.instance_class) if hasattr(kind, "instance_class") else ""
    return f"{name}({signature_text(tuple(kind))})"


def _models(arguments: tuple[Any, ...]) -> Iterator[Any]:
    """The classes of all named tuples among types, those within others included."""
    for kind in arguments:
        if isinstance(kind, _TUPLE):
            if hasattr(kind, "instance_class"):
                yield kind.instance_class
            yield from _models(tuple(kind))


def _full_name(model: type) -> str:
    return f"{model.__module__}.{model.__qualname__}"


def _closure(starts: set[SourceFile]) -> set[SourceFile]:
    """Files, and those that their kernels can use: their imports, if these hold kernels.

    Kernels of this package take nothing from files without. Those of other packages may, so all
    files of the same package count, or all modules in the same folder.
    """
    found, left = set(), list(starts)
    while left:
        file = left.pop()
        if file in found:
            continue
        found.add(file)
        for name in file.imported:
            path = _path_of(name, file.root)
            if path is not None:
                other = _read(path)
                if other.has_kernels or _beside(file, other):
                    left.append(other)
    return found


def _beside(file: SourceFile, other: SourceFile) -> bool:
    top = file.name.split(".")[0]
    if top == _PACKAGE:
        return False
    flat = other.path == other.root / f"{other.name}.py" and file.root == other.root
    return flat or top == other.name.split(".")[0]


@cache
def _path_of(name: str, root: Path) -> Path | None:
    """The file of a module by its dotted name, as seen from modules below the folder `root`."""
    top, *rest = name.split(".")
    if not ((root / top).is_dir() or (root / f"{top}.py").is_file()):
        main = getattr(sys.modules.get(top), "__file__", None)
        if main is None:
            return None
        root = Path(main).parents[1] if Path(main).name == "__init__.py" else Path(main).parent
    place = root.joinpath(top, *rest)
    for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def _read(path: Path) -> SourceFile:
    """The file as it was when it was first asked for."""
    if path not in _files:
        folder, parts = path.parent, [] if path.name == "__init__.py" else [path.stem]
        while (folder / "__init__.py").is_file():
            parts.insert(0, folder.name)
            folder = folder.parent
        _files[path] = SourceFile(".".join(parts), path, folder, path.read_bytes())
    return _files[path]


_COMPILER = _read(Path(__file__).with_name("compiler.py"))
