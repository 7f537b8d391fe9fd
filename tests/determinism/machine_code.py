"""The kernels' machine code, for this CPU and for others, and what must not be in it."""

import re
from operator import attrgetter

import llvmlite.binding as llvm

# Counting references is all for which the host's own intrinsics stand in the optimised code; it
# is left out where that code is made anew for another CPU.
_REFERENCE_COUNT = re.compile(r"(= )(?:tail )?call i8 @llvm\.x86\.atomic\.[^\n]*")
_OF_ONE_CPU = re.compile(r"llvm\.(?:x86|aarch64|arm|ppc)\.[\w.]+")
_TARGET = re.compile(r'^target (?:datalayout|triple) = ".*"\n', re.MULTILINE)
_DECLARED = re.compile(r"^declare [^@\n]*@([\w.]+)\(", re.MULTILINE)
_PYTHON = re.compile(
    r"_?(?:Py|NRT_|numba_|llvm\.(?!fma|exp(?!erimental\.noalias)|log|sin|cos|tan|pow|a(?:sin|cos|tan)))"
)
_LOOSE = re.compile(r"\b(?:fast|reassoc|contract|arcp|afn|nsz)\b(?= )|llvm\.fmuladd|llvm\.fma\b")
_FUSED = re.compile(
    r"^\s+(vfn?m(?:add|sub|addsub|subadd)\w*|fn?m(?:add|sub)|fml[as]|fml[as]l2?|bfmla\w*)\s.*$",
    re.MULTILINE,
)


def optimised(dispatcher):
    """The optimised LLVM code of each signature of a compiled function, callees included.

    Unlike numba's own way to inspect code, it also has code that was read from the cache.
    """
    libraries = map(attrgetter("library"), dispatcher.overloads.values())
    return [str(library._get_module_for_linking()) for library in libraries]


def assembly(code, cpu):
    """What a CPU is told to do. Raises ValueError for code that is for this host alone."""
    code = _TARGET.sub("", code)
    if cpu.triple != llvm.get_process_triple():
        code = _REFERENCE_COUNT.sub(r"\1add i8 0, 0", code)
        calls = "\n".join(line for line in code.splitlines() if not line.startswith("declare"))
        if foreign := set(_OF_ONE_CPU.findall(calls)):
            raise ValueError(f"the code holds {sorted(foreign)}, which {cpu.triple} lacks")
    module = llvm.parse_assembly(code)
    module.triple, module.data_layout = cpu.triple, str(cpu.target_data)
    return cpu.emit_assembly(module)


def host():
    """This CPU with all its features."""
    features = llvm.get_host_cpu_features().flatten()
    return target(llvm.get_process_triple(), llvm.get_host_cpu_name(), features)


def target(triple, cpu, features=""):
    """Any CPU that LLVM knows."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    made = llvm.Target.from_triple(triple)
    return made.create_target_machine(cpu=cpu, features=features, opt=3)


def fused(text):
    """The instructions in assembly that multiply and add with one rounding, x86-64 and ARM."""
    return _FUSED.findall(text)


def loose(code):
    """The marks in LLVM code that let a compiler change the order or number of roundings."""
    return _LOOSE.findall(code)


def called(code):
    """The functions outside of it that LLVM code calls, but for those of Python and numba."""
    return {name for name in _DECLARED.findall(code) if not _PYTHON.match(name)}
