"""A client of `python -m runners.serve` that needs Python alone: docs/serve.md.

CHSEL_TOKEN=... python examples/serve_client.py 8765
"""

import array
import base64
import json
import os
import sys
import urllib.error
import urllib.request

SERVER = f"http://127.0.0.1:{sys.argv[1]}"
TOKEN = os.environ["CHSEL_TOKEN"]
X, Y, Z = 0.05, 0.03, 0.1  # half the sides of a box, metres; it is at (0.4, 0, 0.1)


def ask(path, **values):
    request = urllib.request.Request(SERVER + path, json.dumps(values).encode())
    request.add_header("Authorization", f"Bearer {TOKEN}")
    try:
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        sys.exit(f"{path}: {json.load(error)['error']}")


def packed(numbers, *shape):
    data = array.array("f", numbers)
    if sys.byteorder == "big":
        data.byteswap()
    return {"dtype": "float32", "shape": shape, "base64": base64.b64encode(data).decode()}


vertices = [(x, y, z) for x in (-X, X) for y in (-Y, Y) for z in (-Z, Z)]
faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
opened = ask("/sessions", target={"vertices": vertices, "faces": faces}, record="py.mcap")
session = f"/sessions/{opened['session']}"

touched = [(-X, -0.02, 0.05), (-X, 0.02, -0.07), (X, 0.01, 0.08), (X, -0.01, -0.05)]
touched += [(0.03, 0.02, Z), (-0.04, -0.02, Z)]
ask(f"{session}/add", contacts=[[x + 0.4, y, z + 0.1] for x, y, z in touched])

# A camera half a metre in front of it looks along the world's y axis, at a wall 1 m away.
width = 64
height = 48
focus = 60.0
to_box = 0.5 - Y
depth = []
for row in range(height):
    for column in range(width):
        x, z = ((column - 31.5) / focus * to_box, (23.5 - row) / focus * to_box)
        depth.append(to_box if abs(x) < X and abs(z) < Z else 1.0)
ask(
    f"{session}/add",
    depth=packed(depth, height, width),
    mask=packed((d < 0.9 for d in depth), height, width),
    camera=[[focus, 0, 31.5], [0, focus, 23.5], [0, 0, 1]],
    world_from_camera=[[1, 0, 0, 0.4], [0, 0, 1, -0.5], [0, -1, 0, 0.1], [0, 0, 0, 1]],
)
found = ask(f"{session}/register")
print("position", *(row[3] for row in found["world_from_object"][0][:3]))
print(found["trust"]["text"])
ask(f"{session}/close")
