"""One process of the matrix: `python -m tests.determinism.record OUT.npz` runs all cases."""

import argparse
import json
import logging
import sys
import warnings
from pathlib import Path

import numpy as np
import torch

from tests.determinism import libraries
from tests.determinism.cases import CASES
from tests.determinism.decisions import SCENES, decision_stages
from tests.determinism.problems import grid
from tests.determinism.stages import Scribbler, StageKeeper, nobody, run

WATCHES = {"stages": StageKeeper, "nobody": nobody, "scribbler": Scribbler}


def write_record(path, record):
    """Keep all arrays of all stages, with what the libraries compute here."""
    names, arrays = [], {}
    for case, stages in record.items():
        for stage, parts in stages.items():
            for part, array in parts.items():
                arrays[str(len(names))] = array
                names.append((case, stage, part))
    about = json.dumps({"names": names, "libraries": libraries.digests()})
    np.savez(path, about=np.array(about), **arrays)


def read_record(path):
    """The stages by case, and the digests of what the libraries compute."""
    record = {}
    with np.load(path) as file:
        about = json.loads(str(file["about"]))
        for i, (case, stage, part) in enumerate(about["names"]):
            record.setdefault(case, {}).setdefault(stage, {})[part] = file[str(i)]
    return record, about["libraries"]


def main():
    """Run the cases as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--watch", choices=WATCHES, default="stages")
    parser.add_argument("--again", action="store_true", help="after all cases in other order")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    warnings.filterwarnings("ignore", category=UserWarning, module="chsel")
    watch = WATCHES[arguments.watch]
    if arguments.watch == "scribbler":
        logging.getLogger("tests").setLevel(logging.DEBUG)
        logging.getLogger("chsel").setLevel(logging.DEBUG)
        logging.basicConfig(stream=sys.stderr)
    record = {}
    grids = {body: grid(body) for body in {case.body for case in CASES.values()}}
    if arguments.again:
        for case in reversed(CASES.values()):
            run(case, grids[case.body], nobody)
        for place in reversed(SCENES):
            decision_stages(place, grids[place])
    for name, case in CASES.items():
        sdf = grids[case.body] if arguments.again else grid(case.body)
        record[name] = run(case, sdf, watch)
    for place in SCENES:
        record |= decision_stages(place, grids[place] if arguments.again else grid(place))
    write_record(arguments.out, record)


if __name__ == "__main__":
    main()
