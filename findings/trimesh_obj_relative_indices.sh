#!/usr/bin/env bash
# trimesh 5.2.0: an OBJ file whose faces count vertices back from where they stand (f -4 -3 -2, as
# the format allows) is read with all of them counting from the end of the file. Of a file with two
# objects the last one comes twice, at the same place, and the first one not at all.
# Seen: two tetrahedra, 0.3 m apart; bounds from x = 0.3 in place of 0.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 trimesh==5.2.0
"$folder/venv/bin/python" - "$folder/two.obj" <<'PYTHON'
import sys

import trimesh

FACES = "f -4 -2 -3\nf -4 -3 -1\nf -4 -1 -2\nf -3 -2 -1\n"
lines = ""
for x in (0.0, 0.3):
    corners = ((x, 0, 0), (x + 0.1, 0, 0), (x, 0.1, 0), (x, 0, 0.1))
    lines += f"o at_{x:g}\n" + "".join("v {} {} {}\n".format(*corner) for corner in corners) + FACES
with open(sys.argv[1], "w") as file:
    file.write(lines)
mesh = trimesh.load(sys.argv[1], force="mesh", process=False)
corners = mesh.vertices[mesh.faces].reshape(-1, 3)
print("faces:", len(mesh.faces), "; smallest x of a corner:", corners[:, 0].min())
assert len(mesh.faces) == 8
assert corners[:, 0].min() == 0.3
PYTHON
