"""Arguments with which each verb of `replay` runs on a recording."""

from replay.verbs import VERBS

_ARGUMENTS = {
    "accept": ("FILE", "--yes"),
    "compare": ("FILE", "--methods", "icp", "--steps", "STEP", "--save-csv", "OUT.csv"),
    "diff": ("FILE", "OTHER"),
    "export": ("FILE", "--what", "points", "-o", "OUT.npz"),
    "info": ("FILE",),
    "recover": ("FILE", "-o", "OUT.mcap"),
    "step": ("FILE", "--step", "STEP", "-o", "OUT.mcap"),
    "verify": ("FILE", "--step", "STEP"),
    "view": ("FILE", "--save", "OUT.rrd"),
}
assert set(_ARGUMENTS) == set(VERBS)


def verb_arguments(verb, file, out, *, step=8, other=None):
    """The verb and its arguments. out: name of what is written, without its suffix."""
    names = {"FILE": str(file), "OTHER": str(other or file), "STEP": str(step)}
    words = (names.get(word, word) for word in _ARGUMENTS[verb])
    return [verb, *(word.replace("OUT.", f"{out}.") for word in words)]
