#!/usr/bin/env bash
# libigl 2.6.3 (Python): signed_distance with SIGNED_DISTANCE_TYPE_WINDING_NUMBER returns the
# distance times 1 - 2 w, w being the winding number, and not the distance with a sign. Where two
# closed parts of one mesh overlap (w = 2), values are three times too deep, and in an open mesh
# (w between 0 and 1) they are off by any factor, even 0. Seen: two boxes with parallel sides, the
# point 40 mm below their common top: -0.120 for a distance of 0.040 m. An open box, in the middle
# of its missing side: 0 for a distance of 0.05 m.
# Whoever needs distances takes the unsigned one, and the sign from the winding number.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet libigl==2.6.3 numpy==2.4.6 trimesh==5.2.0
"$folder/venv/bin/python" - <<'PYTHON'
import igl
import numpy as np
import trimesh

KIND = igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER


def signed(mesh, point):
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)
    return float(igl.signed_distance(np.array([point]), vertices, faces, sign_type=KIND)[0][0])


wide, tall = trimesh.creation.box((0.2, 0.2, 0.08)), trimesh.creation.box((0.1, 0.1, 0.3))
alone, both = signed(wide, [0.0, 0.0, 0.0]), signed(wide + tall, [0.0, 0.0, 0.0])
print("in one box, 40 mm below its surface:", alone, "; where a second one overlaps it:", both)
box = trimesh.creation.box((0.1, 0.1, 0.1))
box.update_faces(box.triangles_center[:, 2] < 0.049)
hole = signed(box, [0.0, 0.0, 0.05])
print("in the middle of the missing side of an open box, 50 mm from its other sides:", hole)
assert abs(alone + 0.04) < 1e-9
assert abs(both + 0.12) < 1e-9
assert abs(hole) < 1e-9
PYTHON
