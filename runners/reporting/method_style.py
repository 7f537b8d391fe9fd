"""How a method looks in every figure: one colour, one marker, one name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class MethodStyle:
    """color: "#rrggbb". marker, line: as matplotlib calls them. title: for people."""

    title: str
    color: str
    marker: str
    line: str


# Colours after Okabe and Ito, and Tol: apart for colour-blind eyes. Variants of a method share a
# hue, a lighter one and broken lines for the second.
_KNOWN = {
    "chsel": MethodStyle("CHSEL", "#0072b2", "o", "-"),
    "chsel_cma_me": MethodStyle("CHSEL (CMA-ME)", "#56b4e9", "s", "--"),
    "gradient_descent": MethodStyle("Gradient descent", "#009e73", "^", "-"),
    "svgd": MethodStyle("SVGD", "#e69f00", "D", "-"),
    "icp": MethodStyle("ICP", "#6b6b6b", "P", "-"),
    "cvo": MethodStyle("CVO", "#b2451c", "v", "-"),
    "cvo_no_free_space": MethodStyle("CVO (no free space)", "#f08a5d", "<", "--"),
    "medial_constraint": MethodStyle("Medial Constraint", "#882255", "X", "-"),
    "medial_constraint_cma_me": MethodStyle("Medial Constraint (QD)", "#d889b8", "p", "--"),
}
_POLICIES = {
    "grid": MethodStyle("grid", "#222222", "s", "--"),
    "random": MethodStyle("random", "#999999", "d", "--"),
    "nearest_mean": MethodStyle("nearest mean", "#56b4e9", "^", "-"),
    "hit_chance": MethodStyle("hit chance", "#e69f00", "v", "-"),
    "voxel_entropy": MethodStyle("voxel entropy", "#882255", "D", "-"),
    "hypothesis_pruning": MethodStyle("hypothesis pruning", "#009e73", "X", "-"),
    "information": MethodStyle("information", "#0072b2", "o", "-"),
    "expected_loss": MethodStyle("expected loss", "#b2451c", "P", "-"),
}
_OTHERS = ("#117733", "#332288", "#999933", "#999999", "#661100", "#44aa99")
_OTHER_MARKERS = ("h", "d", ">", "8", "*", "H")


def method_styles(methods: Sequence[str]) -> dict[str, MethodStyle]:
    """The looks of methods in the order in which all figures have them: ours, then by name.

    A variant such as "chsel@paper" and a method from outside look the same in all figures of one
    report, by their place among the names.
    """
    return _styles(methods, _KNOWN)


def policy_styles(policies: Sequence[str]) -> dict[str, MethodStyle]:
    """The looks of policies, likewise."""
    return _styles(policies, _POLICIES)


def _styles(names: Sequence[str], known: Mapping[str, MethodStyle]) -> dict[str, MethodStyle]:
    styles = {name: style for name, style in known.items() if name in names}
    for index, name in enumerate(sorted(set(names) - set(known))):
        color = _OTHERS[index % len(_OTHERS)]
        marker = _OTHER_MARKERS[(index // len(_OTHERS) + index) % len(_OTHER_MARKERS)]
        styles[name] = MethodStyle(name, color, marker, ":")
    return styles
